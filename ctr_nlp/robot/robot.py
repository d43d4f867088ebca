"""A robot: its tubes, and the one set of limits that every formulation, executor and check honours."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.checks import TURN, check_angle, check_pair, sequence_of_tubes
from ctr_nlp.robot.extensions import check_extensions, furthest
from ctr_nlp.robot.limits import Limits
from ctr_nlp.robot.strain import check_deployed
from ctr_nlp.robot.structure import Structure, TubeNumbers, kind_of, numbers_of, tubes_of
from ctr_nlp.robot.tolerances import Tolerances
from ctr_nlp.robot.tube import Tube
from ctr_nlp.robot.units import angle_meant, between, did_you_mean
from ctr_nlp.support.packing import packable
from ctr_nlp.support.tables import toml_text
from ctr_nlp.support.values import (
    check_keys,
    described,
    frozen,
    numbers,
    pairs,
    plain_floats,
    read_toml,
    strict_json,
)
from ctr_nlp.typing import Array

MM_PER_RAD = 10.0
"""What one radian counts as in the motion term and the roughness, in mm: the W of the design."""
KEYS = ("name", "tubes", "limits", "tolerances")
"""Of a robot file."""
UNITS = {
    "length": "mm, the whole tube, from its carriage to its tip",
    "curved_length": "mm, the part behind the tip that is pre-curved; the rest is straight transmission",
    "curvature": "1/mm; [root, tip] of the curved part, linear between them",
    "outer_diameter": "mm",
    "inner_diameter": "mm",
    "pre_torsion": "rad/mm, by how much the direction of a helix's curvature turns along it",
}
"""What a robot file says beside numbers of its tubes."""


@packable("robot")
@dataclass(frozen=True)
class Robot:
    """d nested tubes, outermost first, their limits and tolerances; q = (alpha_1..d, beta_1..d, theta_x, theta_y).

    An inner tube may be as stiff as the one around it, or stiffer: only the dominant-stiffness model asks for an
    order, and says so (Model.check). lower, upper, speed, acceleration: (2d + 2,) in the order of q. Raises
    RobotError.
    """

    tubes: tuple[Tube, ...]
    limits: Limits = field(default_factory=Limits)
    tolerances: Tolerances = field(default_factory=Tolerances)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tubes", sequence_of_tubes(self.tubes))
        if not isinstance(self.limits, Limits):
            raise RobotError(f"limits of a robot are {self.limits!r}; they must be Limits(...)")
        if not isinstance(self.tolerances, Tolerances):
            raise RobotError(f"tolerances of a robot are {self.tolerances!r:.60}; they must be Tolerances(...)")
        self.tolerances.check(self.tubes)
        for i, (outer, inner) in enumerate(zip(self.tubes, self.tubes[1:], strict=False), start=1):
            check_pair(i, outer, inner)
        self._check_limits()
        low, high = (self.split(ends)[1].tolist() for ends in (self.lower, self.upper))
        check_extensions(self.tubes, low, high, self.carriage_gap)
        check_deployed(self.tubes, self.deployed.tolist())

    def __reduce__(self) -> Any:
        return Robot, (self.tubes, self.limits, self.tolerances)

    def _check_limits(self) -> None:
        lower, upper = self.lower, self.upper
        for name, lo, hi in zip(self.axes, lower, upper, strict=True):
            if math.isnan(lo) or math.isnan(hi) or lo > hi:
                raise RobotError(f"limits of {name} are [{lo:g}, {hi:g}]; the lower must not exceed the upper")
            for end in (lo, hi):
                if name.partition("_")[0] in TURN and math.isfinite(end):
                    check_angle(f"limits of {name} are [{lo:g}, {hi:g}] rad, and {end:g}", name, end)
        for name in ("speed", "acceleration"):
            for axis, value in zip(self.axes, getattr(self, name), strict=True):
                if not value > 0:
                    raise RobotError(f"{name} of {axis} is {value:g}; it must be positive")

    @cached_property
    def deployed(self) -> Array:
        """The largest beta (d,) mm that limits, order and carriage gap allow."""
        return furthest(self.tubes, self.split(self.upper)[1], self.carriage_gap)

    @cached_property
    def carriage_gap(self) -> float | None:
        """Least distance between neighbouring carriages, mm, or None."""
        if self.limits.carriage_gap is None:
            return None
        gap = float(numbers("carriage_gap", self.limits.carriage_gap, 1)[0])
        if gap < 0:
            raise RobotError(f"carriage_gap is {gap:g} mm; it must be at least 0, or None")
        return gap

    @cached_property
    def structure(self) -> Structure:
        """What must be compiled for the robot."""
        low, high = self.d, 2 * self.d
        ends = zip(self.tubes, self.upper[low:high], strict=True)
        shown = tuple(bool(end > tube.curved_length) for tube, end in ends)
        return Structure(tuple(map(kind_of, self.tubes)), shown, self.carriage_gap is not None)

    @cached_property
    def numbers(self) -> Array:
        """What models need to know of the tubes, (d, 8), in the order of structure.NUMBERS."""
        return frozen(np.array(numbers_of(self.tubes)))

    @cached_property
    def tube_numbers(self) -> tuple[TubeNumbers, ...]:
        """The tubes as models take them."""
        return tubes_of(self.structure, self.numbers.tolist())

    @cached_property
    def most_growth(self) -> Array:
        """The largest beta_{i+1} - beta_i (d - 1,) mm that the carriage gap allows; inf without one."""
        if self.carriage_gap is None:
            return frozen(np.full(self.d - 1, np.inf))
        return frozen(np.diff([tube.length for tube in self.tubes]) - self.carriage_gap)

    @property
    def d(self) -> int:
        """Number of tubes."""
        return len(self.tubes)

    @cached_property
    def axes(self) -> tuple[str, ...]:
        """The names of q's entries, in order."""
        count = range(1, self.d + 1)
        return (*(f"alpha_{i}" for i in count), *(f"beta_{i}" for i in count), "theta_x", "theta_y")

    @cached_property
    def lower(self) -> Array:
        """Smallest q, (2d + 2,)."""
        return self._positions[:, 0]

    @cached_property
    def upper(self) -> Array:
        """Largest q, (2d + 2,)."""
        return self._positions[:, 1]

    @cached_property
    def _positions(self) -> Array:
        beta = self.limits.beta
        if beta is None:
            beta = [(0.0, tube.curved_length) for tube in self.tubes]
        rows = [
            pairs("alpha", self.limits.alpha, self.d),
            pairs("beta", beta, self.d),
            pairs("theta", self.limits.theta, 2),
        ]
        return frozen(np.vstack(rows))

    @cached_property
    def speed(self) -> Array:
        """Largest speed of q, (2d + 2,), rad/s and mm/s."""
        return self._rates("speed")

    @cached_property
    def acceleration(self) -> Array:
        """Largest acceleration of q, (2d + 2,), rad/s^2 and mm/s^2."""
        return self._rates("acceleration")

    def _rates(self, kind: str) -> Array:
        names = (f"alpha_{kind}", f"beta_{kind}", f"theta_{kind}")
        sizes = (self.d, self.d, 2)
        return frozen(
            np.concatenate(
                [numbers(n, getattr(self.limits, n), k, True) for n, k in zip(names, sizes, strict=True)]
            )
        )

    @cached_property
    def mm_per_unit(self) -> Array:
        """W, (2d + 2,): what a unit of q counts as in the motion term, mm/rad for angles and 1 for beta."""
        return frozen(mm_per_unit(self.d))

    @property
    def reach(self) -> float:
        """Largest beta_d, mm."""
        return float(self.upper[2 * self.d - 1])

    def split(self, q: Any) -> tuple[Any, Any, Any]:
        """Alpha (.., d), beta (.., d) and theta (.., 2) of q (.., 2d + 2)."""
        return q[..., : self.d], q[..., self.d : 2 * self.d], q[..., 2 * self.d :]

    def with_limits(self, **limits: Any) -> Robot:
        """The same robot with some of its Limits replaced; raises RobotError."""
        allowed = [f.name for f in fields(Limits)]
        unknown = sorted(set(limits) - set(allowed))
        if unknown:
            raise RobotError(f"limit {unknown[0]!r} is unknown; allowed are {', '.join(allowed)}")
        return replace(self, limits=replace(self.limits, **limits))

    def with_locked_tilt(self) -> Robot:
        """The same robot without an arm: theta stays 0."""
        return self.with_limits(theta=(0.0, 0.0))

    def check(self, q: npt.ArrayLike, name: str = "q", tolerance: float = 1e-6) -> Array:
        """The array of q (2d + 2,); raises RobotError unless it keeps limits and order to tolerance (rad, mm)."""
        q = configuration(name, q)
        if q.shape != (2 * self.d + 2,):
            raise RobotError(f"{name} has shape {q.shape}; it must be ({2 * self.d + 2},): {', '.join(self.axes)}")
        for axis, value, lo, hi in zip(self.axes, q, self.lower, self.upper, strict=True):
            if not (math.isfinite(value) and lo - tolerance <= value <= hi + tolerance):
                turned = math.isfinite(value) and axis.partition("_")[0] in TURN
                meant = angle_meant(value, between(lo, hi)) if turned else []
                raise RobotError(
                    f"{axis} of {name} is {value:g}; it must lie in [{lo:g}, {hi:g}]{did_you_mean(meant)}"
                )
            if axis.partition("_")[0] == "alpha":
                check_angle(f"{axis} of {name} is {value:g} rad, and it", axis, value)
        beta = self.split(q)[1]
        for i, growth in enumerate(np.diff(beta), start=1):
            if growth < -tolerance:
                raise RobotError(
                    f"beta_{i} of {name} is {beta[i - 1]:g} mm and exceeds beta_{i + 1}, {beta[i]:g} mm"
                )
            gap = self.carriage_gap
            clearance = self.tubes[i].length - self.tubes[i - 1].length - growth
            if gap is not None and clearance < gap - tolerance:
                raise RobotError(
                    f"carriages {i} and {i + 1} of {name} are {clearance:g} mm apart; carriage_gap is {gap:g} mm"
                )
        return q

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and lists as a robot file holds them, fit for strict JSON (no limit is "inf")."""
        plain = asdict(self)
        return {"tubes": list(plain["tubes"])} | {k: strict_json(plain[k]) for k in ("limits", "tolerances")}

    def to_toml(self, head: str = "") -> str:
        """The text of a robot file that from_toml reads as the same robot; head: lines of comment on top."""
        plain = self.to_dict()
        tubes = toml_text(head, [("[[tubes]]", tube) for tube in plain["tubes"]], UNITS)
        return tubes + toml_text("", [(f"[{name}]", plain[name]) for name in ("limits", "tolerances")], {})

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Robot:
        """The robot that to_dict or a robot file describes; raises RobotError."""
        if not isinstance(data, dict):
            raise RobotError(f"a robot is {data!r}; it must be a table with the keys {', '.join(KEYS)}")
        check_keys(RobotError, "a robot", data, KEYS)
        tubes = data.get("tubes")
        if not isinstance(tubes, list | tuple) or not all(isinstance(t, dict) for t in tubes):
            raise RobotError("a robot needs a list of tubes, [[tubes]] in TOML")
        return cls(
            tuple(_numbered(number, tube) for number, tube in enumerate(tubes, start=1)),
            described(Limits, data.get("limits", {})),
            described(Tolerances, data.get("tolerances", {})),
        )

    @classmethod
    def from_toml(cls, path: str | Path) -> Robot:
        """The robot of a TOML file; raises RobotError where it cannot be read or is not a robot."""
        try:
            return cls.from_dict(read_toml(path))
        except RobotError as error:
            raise RobotError(f"robot file {path}: {error}") from error


def mm_per_unit(d: int) -> Array:
    """W of d tubes, (2d + 2,), as Robot.mm_per_unit."""
    return np.concatenate([np.full(d, MM_PER_RAD), np.ones(d), np.full(2, MM_PER_RAD)])


def configuration(name: str, q: Any) -> Array:
    """Numbers that are to be a configuration, or several, as an array of any shape; raises RobotError."""
    try:
        return plain_floats(q)
    except (TypeError, ValueError, OverflowError) as error:
        raise RobotError(f"{name} is {q!r:.80}; it must be numbers, in rad and mm") from error


def _numbered(number: int, data: dict[str, Any]) -> Tube:
    """The tube of a number, from 1, that a table of a file describes."""
    try:
        tube: Tube = described(Tube, data)
    except RobotError as error:
        raise RobotError(f"tubes, number {number}: {error}") from error
    return tube
