"""What the robot is to follow: a curve and a length for every frame, sampled once for all users."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.support.equal import Kept, Value
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import floats, frozen, instance, number, whole_number
from ctr_nlp.target.curve import Curve
from ctr_nlp.typing import Array

SIGMA = frozen(np.linspace(0.0, 1.0, 101))
"""Normalised arc lengths at which targets and shapes are sampled and errors measured."""
QUADRATURE = frozen(np.r_[0.005, np.full(99, 0.01), 0.005])
"""Trapezoidal weights on SIGMA; they sum to 1."""


@dataclass(frozen=True, eq=False)
class Frame(Kept):
    """The target of one frame at SIGMA.

    points (101, 3) mm; tangents (101, 3); length mm; radius (101,) mm of the lumen, or None; curve: that of which
    it is the first part of this length; number: from 0, in its target; part: of the motion that has passed there,
    from 0 to 1. Arrays are read-only.
    """

    points: Array
    tangents: Array
    length: float
    radius: Array | None
    curve: Curve
    number: int = 0
    part: float = 0.0

    def at(self, sigma: Array) -> Array:
        """Points (n, 3) in mm at any sigma (n,), by the cubic through points and tangents."""
        return CubicHermiteSpline(SIGMA, self.points, self.tangents * self.length)(sigma)

    @cached_property
    def curvature(self) -> Array:
        """(101,) 1/mm, read-only; raises ProblemError where it is not known all along."""
        return self._curvature(SIGMA * self.length)

    @cached_property
    def turning(self) -> Array:
        """The integral of curvature over arc length from 0, (101,) rad, read-only; raises as curvature."""
        steps = np.linspace(0.0, self.length, FINER * (len(SIGMA) - 1) + 1)
        turned = np.cumsum(self._curvature((steps[1:] + steps[:-1]) / 2) * np.diff(steps))
        return frozen(np.append(0.0, turned)[::FINER])

    def _curvature(self, s: Array) -> Array:
        name = f"curvature of frame {self.number + 1} of the target"
        return floats(ProblemError, name, self.curve.curvature(s), (len(s),))


@packable("target")
@dataclass(frozen=True, eq=False, repr=False)
class Target(Value):
    """For frame j = 1..T a curve and the arc length in mm to which it is to be followed."""

    curves: tuple[Curve, ...]
    lengths: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("curves", "lengths"):
            object.__setattr__(self, name, _listed(name, getattr(self, name)))
        if not self.curves:
            raise ProblemError("a target has no frames; give at least one")
        if len(self.curves) != len(self.lengths):
            raise ProblemError(
                f"the number of curves of a target is {len(self.curves)} and that of its lengths "
                f"{len(self.lengths)}; they must be equal"
            )
        for frame, (curve, length) in enumerate(zip(self.curves, self.lengths, strict=True), start=1):
            instance(ProblemError, f"curve {frame} of a target", curve, Curve)
            allowed = f"be a number of mm in (0, {curve.length:g}], the length of its curve"
            within = functools.partial(_within, curve.length * (1 + ROUNDING))
            number(ProblemError, f"length {frame} of a target", length, within, allowed)

    def __len__(self) -> int:
        return len(self.curves)

    def __repr__(self) -> str:
        return f"Target({len(self)} frames of {min(self.lengths):.2f} to {max(self.lengths):.2f} mm)"

    def __getitem__(self, frames: slice) -> Target:
        """A stretch of frames, counted from 0; raises ProblemError where there is none."""
        return Target(self.curves[frames], self.lengths[frames])

    def sample(self) -> tuple[Frame, ...]:
        """The target at SIGMA, frame by frame; raises ProblemError where a curve is not known all along."""
        found, frames = list[Frame](), range(len(self))
        for _, run in itertools.groupby(frames, lambda frame: id(self.curves[frame])):
            found += _sampled(
                self.curves[len(found)], np.array([self.lengths[frame] for frame in run]), len(found), len(self)
            )
        return tuple(found)


def growing(path: Curve, frames: int = 100) -> Target:
    """A path followed as it grows, eq. (7): frame j has the part with parameter <= j / frames of its range."""
    instance(ProblemError, "path", path, Curve)
    check_frames(frames)
    lengths = tuple(path.length_at(j / frames) for j in range(1, frames + 1))
    return Target((path,) * frames, lengths)


def sequence(shapes: Sequence[Curve]) -> Target:
    """A target whose frames are whole curves, one each."""
    shapes = _listed("shapes", shapes)
    for frame, shape in enumerate(shapes, start=1):
        instance(ProblemError, f"shape {frame}", shape, Curve)
    return Target(shapes, tuple(shape.length for shape in shapes))


def check_frames(frames: int) -> None:
    """Raise ProblemError unless frames is a whole number of at least 1."""
    whole_number(ProblemError, "frames", frames)


def _listed(name: str, given: Any) -> tuple[Any, ...]:
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ProblemError(f"{name} of a target is {given!r:.80}; give a sequence with one entry for each frame")
    return tuple(given)


ROUNDING = 1e-9
"""Part of a curve by which a length may exceed it."""
TURNED_BACK = 0.01
"""Part by which straight lines between samples may exceed the arc length; on a smooth curve they never do."""
FINER = 8
"""Steps of the curvature's quadrature between two neighbours of SIGMA."""


def _sampled(curve: Curve, lengths: Array, first: int, total: int) -> list[Frame]:
    """Frames of these lengths (n,), mm, along one curve, which is evaluated for all of them at once.

    first: the number of the first one, from 0; total: how many frames the target has.
    """
    frames = range(first, first + len(lengths))
    s = SIGMA * lengths[:, None]

    def known(name: str, function: Callable[[Array], Any], *shape: int) -> list[Array]:
        """A function of arc length in every frame, finite and read-only; raises ProblemError."""
        whole = np.asarray(function(s.ravel()))
        if whole.shape == (s.size, *shape) and whole.dtype == float and np.isfinite(whole).all():
            return list(frozen(whole).reshape(*s.shape, *shape))
        parts = whole.reshape(*s.shape, *shape) if whole.shape == (s.size, *shape) else map(function, s)
        names = (f"{name} of frame {frame + 1} of the target" for frame in frames)
        return [floats(ProblemError, *each, (len(SIGMA), *shape)) for each in zip(names, parts, strict=True)]

    points, tangents = known("point", curve.point, 3), known("tangent", curve.tangent, 3)
    _check_direction(np.array(points), lengths, frames)
    radii = [None] * len(lengths) if curve.radius is None else known("radius", curve.radius)
    each = zip(points, tangents, lengths.tolist(), radii, frames, strict=True)
    last = max(total - 1, 1)
    return [
        Frame(point, tangent, length, radius, curve, k, k / last) for point, tangent, length, radius, k in each
    ]


def _check_direction(points: Array, lengths: Array, frames: range) -> None:
    """Raise ProblemError where a curve through points (n, 101, 3), as long as lengths (n,), turns back."""
    chords = np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
    for frame, chord, length in zip(frames, chords, lengths, strict=True):
        if chord > length * (1 + TURNED_BACK):
            raise ProblemError(
                f"frame {frame + 1} of the target has {chord:.2f} mm between points that should be "
                f"{length:.2f} mm apart along its curve: it turns back on itself and has no direction there"
            )


def _within(most: float, length: float) -> bool:
    return 0 < length <= most
