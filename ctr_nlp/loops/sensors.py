"""Sensors: what each would measure of a shape, and how that changes as the shape does.

A sensor looks at places of the robot of its own. Its values come in groups that are right or wrong together, as
the three coordinates of a point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.values import floats, number
from ctr_nlp.typing import Array, Index


class Seen(NamedTuple):
    """A robot's shape at n places, and its slopes over k variables.

    points (n, 3) mm, tangents (n, 3); of_points, of_tangents (k, n, 3). length: of the robot, mm, which the
    variables do not change.
    """

    points: Array
    tangents: Array
    of_points: Array
    of_tangents: Array
    length: float


class Sensor(ABC):
    """One sensor. sigma (n,): the places it looks at. noise (m,): standard deviations of its values, in their
    units.

    group: how many of its values, one after the other, are right or wrong together.
    """

    group = 3

    @property
    @abstractmethod
    def sigma(self) -> Array:
        """The places, from 0 at the insertion point to 1 at the tip."""

    @property
    @abstractmethod
    def noise(self) -> Array:
        """Standard deviations (m,)."""

    @abstractmethod
    def values(self, seen: Seen) -> Array:
        """What it measures, without noise, (m,)."""

    @abstractmethod
    def slopes(self, seen: Seen) -> Array:
        """How that changes with the variables, (m, k)."""


def _positive(name: str, value: float, unit: str) -> None:
    number(OptionError, name, value, lambda x: 0 < x < np.inf, "be a finite number > 0", unit)


def _places(sigma: Sequence[float]) -> Array:
    found = floats(OptionError, "sigma of a sensor", sigma, (None,))
    if not len(found) or found.min() < 0 or found.max() > 1:
        raise OptionError(f"sigma of a sensor is {sigma}; it must be one or more numbers in [0, 1]")
    return found


@dataclass(frozen=True, eq=False)
class ShapePoints(Sensor):
    """Points of the robot at known sigma, mm; deviation: of each coordinate, mm. Raises OptionError."""

    places: Sequence[float]
    deviation: float = 0.5

    def __post_init__(self) -> None:
        _positive("deviation of shape points", self.deviation, " mm")
        _places(self.places)

    @property
    def sigma(self) -> Array:
        """As Sensor."""
        return _places(self.places)

    @property
    def noise(self) -> Array:
        """As Sensor."""
        return np.full(3 * len(self.places), self.deviation)

    def values(self, seen: Seen) -> Array:
        """x, y and z of one point after the other."""
        return seen.points.ravel()

    def slopes(self, seen: Seen) -> Array:
        """As Sensor."""
        return seen.of_points.reshape(len(seen.of_points), -1).T


class TipPosition(ShapePoints):
    """The tip's position, as an electromagnetic tracker tells it; deviation: of each coordinate, mm."""

    def __init__(self, deviation: float = 0.5) -> None:
        super().__init__((1.0,), deviation)


@dataclass(frozen=True, eq=False)
class TipPose(Sensor):
    """The tip's position, mm, and its direction as a unit vector; turn: deviation of the direction, rad."""

    deviation: float = 0.5
    turn: float = 0.02

    def __post_init__(self) -> None:
        _positive("deviation of the tip's position", self.deviation, " mm")
        _positive("deviation of the tip's direction", self.turn, " rad")

    @property
    def sigma(self) -> Array:
        """As Sensor."""
        return np.ones(1)

    @property
    def noise(self) -> Array:
        """As Sensor."""
        return np.repeat([self.deviation, self.turn], 3)

    def values(self, seen: Seen) -> Array:
        """Position, then direction."""
        return np.concatenate([seen.points[0], seen.tangents[0]])

    def slopes(self, seen: Seen) -> Array:
        """As Sensor."""
        return np.concatenate([seen.of_points[:, 0], seen.of_tangents[:, 0]], axis=1).T


@dataclass(frozen=True, eq=False)
class Views(Sensor):
    """Points of the robot at known sigma in pictures of known geometry, as of two fluoroscopes.

    projections (v, 3, 4): of homogeneous points, mm, to homogeneous places in each picture, in its units.
    deviation: of each coordinate there. Raises OptionError.
    """

    places: Sequence[float]
    projections: Array
    deviation: float = 0.5
    group = 2

    def __post_init__(self) -> None:
        _positive("deviation of views", self.deviation, "")
        _places(self.places)
        floats(OptionError, "projections of views", np.asarray(self.projections), (None, 3, 4))

    @property
    def sigma(self) -> Array:
        """As Sensor."""
        return _places(self.places)

    @property
    def noise(self) -> Array:
        """As Sensor."""
        return np.full(2 * len(self.projections) * len(self.places), self.deviation)

    def _homogeneous(self, points: Array) -> Array:
        """Of points (.., 3), (v, .., 3)."""
        turned: Array = np.einsum("vij,...j->v...i", self.projections[:, :, :3], points)
        return turned

    def values(self, seen: Seen) -> Array:
        """Picture by picture, point by point."""
        found = self._homogeneous(seen.points) + self.projections[:, None, :, 3]
        return (found[..., :2] / found[..., 2:]).ravel()

    def slopes(self, seen: Seen) -> Array:
        """As Sensor."""
        found = self._homogeneous(seen.points) + self.projections[:, None, :, 3]
        turned, depth = self._homogeneous(seen.of_points), found[:, None, :, 2:]
        places = (found[..., :2] / found[..., 2:])[:, None]
        slopes = (turned[..., :2] - places * turned[..., 2:]) / depth
        return slopes.swapaxes(0, 1).reshape(len(seen.of_points), -1).T


def view(source: Array, centre: Array, up: Array, magnification: float = 1.0) -> Array:
    """The projection (3, 4) from a source (3,), mm, onto the plane through centre (3,) that faces it.

    up (3,): the picture's second direction, as far as that lies in the plane. A mm at the centre is magnification
    in the picture. Raises OptionError where these make no picture.
    """
    away = np.asarray(centre, dtype=float) - source
    distance, right = float(np.linalg.norm(away)), np.cross(away, up)
    if not distance > 0 or not np.linalg.norm(right) > 0:
        raise OptionError(
            "a view needs a source away from its centre, and an up that does not point along the ray"
        )
    across = right / np.linalg.norm(right)
    turned = np.stack([across, np.cross(across, away / distance), away / distance])
    scaled = np.diag([magnification * distance, magnification * distance, 1.0]) @ turned
    return np.column_stack([scaled, -scaled @ source])


@dataclass(frozen=True, eq=False)
class Fibre(Sensor):
    """The bending of a fibre in the robot, 1/mm: by how much the tangent turns from place to place, unsigned.

    places: between neighbouring ones of these, the curvature is measured as their tangents' distance over the
    length between them. deviation: 1/mm.
    """

    places: Sequence[float] = field(default_factory=lambda: tuple(np.linspace(0.0, 1.0, 11).tolist()))
    deviation: float = 5e-4
    group = 1

    def __post_init__(self) -> None:
        _positive("deviation of a fibre", self.deviation, " 1/mm")
        if len(_places(self.places)) < 2:
            raise OptionError("a fibre needs two places at least")

    @property
    def sigma(self) -> Array:
        """As Sensor."""
        return _places(self.places)

    @property
    def noise(self) -> Array:
        """As Sensor."""
        return np.full(len(self.places) - 1, self.deviation)

    def values(self, seen: Seen) -> Array:
        """Between one place and the next."""
        turned = np.diff(seen.tangents, axis=0)
        return np.linalg.norm(turned, axis=1) / (np.diff(self.sigma) * seen.length)

    def slopes(self, seen: Seen) -> Array:
        """As Sensor."""
        turned, of_turned = np.diff(seen.tangents, axis=0), np.diff(seen.of_tangents, axis=1)
        size = np.maximum(np.linalg.norm(turned, axis=1), 1e-9)
        slopes = np.einsum("kni,ni->kn", of_turned, turned / size[:, None]) / (np.diff(self.sigma) * seen.length)
        return slopes.T


class Sensors:
    """Several sensors as one. sigma (n,), noise (m,): of all.

    grouped: the places (groups, size) of values that are right or wrong together, an array for every size of
    groups.
    """

    def __init__(self, *sensors: Sensor) -> None:
        if not sensors or not all(isinstance(each, Sensor) for each in sensors):
            raise OptionError(f"sensors are {sensors!r:.80}; give one Sensor or more")
        self._sensors = sensors
        counts = [len(each.sigma) for each in sensors]
        ends = np.cumsum(counts)
        self._places = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self.sigma = np.concatenate([each.sigma for each in sensors])
        self.noise = np.concatenate([each.noise for each in sensors])
        begins = np.cumsum([0, *(len(each.noise) for each in sensors)])
        rows: dict[int, list[Index]] = {}
        for each, begin in zip(sensors, begins, strict=False):
            own = begin + np.arange(len(each.noise)).reshape(-1, each.group)
            rows.setdefault(each.group, []).append(own)
        self.grouped = [np.concatenate(some) for some in rows.values()]

    def __len__(self) -> int:
        """How many values there are in a reading."""
        return len(self.noise)

    def _parts(self, seen: Seen) -> list[Seen]:
        points, tangents, of_points, of_tangents, length = seen
        return [
            Seen(points[at], tangents[at], of_points[:, at], of_tangents[:, at], length) for at in self._places
        ]

    def values(self, seen: Seen) -> Array:
        """What they measure, without noise, (m,)."""
        return np.concatenate([s.values(part) for s, part in zip(self._sensors, self._parts(seen), strict=True)])

    def slopes(self, seen: Seen) -> Array:
        """How that changes, (m, k)."""
        return np.concatenate([s.slopes(part) for s, part in zip(self._sensors, self._parts(seen), strict=True)])


class Reading(NamedTuple):
    """What sensors told: values (m,), NaN where one is missing, of the moment `time`, s, as they say."""

    time: float
    values: Array
