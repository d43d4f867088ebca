"""Targets: a curve and a length for every frame, eqs. (6) and (7), sampled once for all users."""

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
from ctr_nlp.paths.curve import Curve
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import check_instance, floats, frozen, number, whole_number
from ctr_nlp.support.value_objects import ReadOnlyValue, Value
from ctr_nlp.typing import Array

SIGMA_GRID = frozen(np.linspace(0.0, 1.0, 101))
"""Normalised arc lengths sigma at which targets and shapes are sampled and errors measured."""
QUADRATURE = frozen(np.r_[0.005, np.full(99, 0.01), 0.005])
"""Trapezoidal weights on SIGMA_GRID for the integral of eq. (8); they sum to 1."""


@dataclass(frozen=True, eq=False)
class Frame(ReadOnlyValue):
    """The target of one frame at SIGMA_GRID; arrays are read-only.

    Attributes
    ----------
    points : ndarray
        Points (101, 3), mm.
    tangents : ndarray
        Unit tangents (101, 3).
    length : float
        Length of the shape to follow, mm.
    radius : ndarray or None
        Radius of the lumen at the points (101,), mm.
    curve : Curve
        The curve of which the shape is the first part of this length.
    number : int
        Number of the frame in its target, from 0.
    motion_fraction : float
        Part of the motion that has passed there, from 0 to 1.
    """

    points: Array
    tangents: Array
    length: float
    radius: Array | None
    curve: Curve
    number: int = 0
    motion_fraction: float = 0.0

    def at(self, sigma: Array) -> Array:
        """Return points (n, 3), mm, at any sigma (n,), by the cubic Hermite interpolant of points and tangents."""
        # dx/dsigma = length dx/ds, with dx/ds the unit tangent.
        return CubicHermiteSpline(SIGMA_GRID, self.points, self.tangents * self.length)(sigma)

    @cached_property
    def curvature(self) -> Array:
        """Curvature (101,), 1/mm, read-only; raises ProblemError where it is not known all along."""
        return self._curvature(SIGMA_GRID * self.length)

    @cached_property
    def turning(self) -> Array:
        """Integral of the curvature over arc length from 0 (101,), rad, read-only; raises ProblemError as
        `curvature`.
        """
        # Midpoint rule on a grid finer than SIGMA_GRID: curvature may change much, or jump, between two samples.
        steps = np.linspace(0.0, self.length, CURVATURE_QUADRATURE_STEPS * (len(SIGMA_GRID) - 1) + 1)
        turned = np.cumsum(self._curvature((steps[1:] + steps[:-1]) / 2) * np.diff(steps))
        return frozen(np.append(0.0, turned)[::CURVATURE_QUADRATURE_STEPS])

    def _curvature(self, s: Array) -> Array:
        """Return the curvature (n,), 1/mm, at arc lengths s (n,), mm; raise ProblemError where it is
        not finite.
        """
        name = f"curvature of frame {self.number + 1} of the target"
        return floats(ProblemError, name, self.curve.curvature(s), (len(s),))


@packable("target")
@dataclass(frozen=True, eq=False, repr=False)
class Target(Value):
    """The shapes that a robot is to follow: for each of T frames a curve, and the arc length up to which it
    counts.

    Attributes
    ----------
    curves : sequence of Curve
        One a frame; stored as a tuple.
    lengths : sequence of float
        Lengths in (0, length of the curve], mm; stored as a tuple.

    Raises
    ------
    ProblemError
        There are no frames, not as many lengths as curves, or a length that its curve does not have.

    See Also
    --------
    growing : A path that is followed as it grows.
    sequence : Whole curves, one a frame.
    """

    curves: tuple[Curve, ...]
    lengths: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("curves", "lengths"):
            object.__setattr__(self, name, _as_tuple(name, getattr(self, name)))
        if not self.curves:
            raise ProblemError("a target has no frames; give at least one")
        if len(self.curves) != len(self.lengths):
            raise ProblemError(
                f"the number of curves of a target is {len(self.curves)} and that of its lengths "
                f"{len(self.lengths)}; they must be equal"
            )
        for frame, (curve, length) in enumerate(zip(self.curves, self.lengths, strict=True), start=1):
            check_instance(ProblemError, f"curve {frame} of a target", curve, Curve)
            allowed = f"be a number of mm in (0, {curve.length:g}], the length of its curve"
            within = functools.partial(_within, curve.length * (1 + TARGET_LENGTH_ROUNDING))
            number(ProblemError, f"length {frame} of a target", length, within, allowed)

    def __len__(self) -> int:
        return len(self.curves)

    def __repr__(self) -> str:
        return f"Target({len(self)} frames of {min(self.lengths):.2f} to {max(self.lengths):.2f} mm)"

    def __getitem__(self, frames: slice) -> Target:
        """Return some of the frames, as ``target[first:stop]``, counted from 0; raise ProblemError where there are
        none.
        """
        return Target(self.curves[frames], self.lengths[frames])

    def sample(self) -> tuple[Frame, ...]:
        """Sample all frames at SIGMA_GRID.

        Returns
        -------
        tuple of Frame
            One a frame; neighbouring frames on one curve are evaluated in one call.

        Raises
        ------
        ProblemError
            A curve has no finite point, tangent or radius somewhere, or turns back on itself.
        """
        found = list[Frame]()
        frames = range(len(self))
        # By identity: frames of a growing target share one curve object, and comparing curves by value is slow.
        for _, run in itertools.groupby(frames, lambda frame: id(self.curves[frame])):
            found += _sample_frames(
                self.curves[len(found)], np.array([self.lengths[frame] for frame in run]), len(found), len(self)
            )
        return tuple(found)


def growing(path: Curve, frames: int = 100) -> Target:
    """Follow a path as it grows, eq. (7): in frame j the part whose parameter is at most j / frames of its range.

    Parameters
    ----------
    path : Curve
        The path, in the robot's frame.
    frames : int
        Number of frames T, at least 1.

    Returns
    -------
    Target
        T frames on the one curve; the last is the whole path.

    Raises
    ------
    ProblemError
        `path` is no curve, or `frames` no whole number of at least 1.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> path = ctr.curve_from_formula(lambda u: (0, 0, u), 0, 80)
    >>> [round(length, 6) for length in ctr.growing(path, frames=4).lengths]
    [20.0, 40.0, 60.0, 80.0]
    """
    check_instance(ProblemError, "path", path, Curve)
    check_frames(frames)
    lengths = tuple(path.length_at(j / frames) for j in range(1, frames + 1))
    return Target((path,) * frames, lengths)


def sequence(shapes: Sequence[Curve]) -> Target:
    """Follow whole curves, one a frame: a target that changes in any way over time, eq. (6).

    Parameters
    ----------
    shapes : sequence of Curve
        One curve a frame, in the robot's frame.

    Returns
    -------
    Target
        As many frames as there are curves.

    Raises
    ------
    ProblemError
        `shapes` is no sequence of curves, or empty.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> lines = [ctr.curve_from_formula(lambda u: (0, 0, u), 0, length) for length in (40, 50, 60)]
    >>> ctr.sequence(lines)
    Target(3 frames of 40.00 to 60.00 mm)
    """
    shapes = _as_tuple("shapes", shapes)
    for frame, shape in enumerate(shapes, start=1):
        check_instance(ProblemError, f"shape {frame}", shape, Curve)
    return Target(shapes, tuple(shape.length for shape in shapes))


def check_frames(frames: int) -> None:
    """Raise ProblemError unless frames is a whole number of at least 1."""
    whole_number(ProblemError, "frames", frames)


def _as_tuple(name: str, given: Any) -> tuple[Any, ...]:
    """Return a field of a target as a tuple; raise ProblemError where it is no sequence."""
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ProblemError(f"{name} of a target is {given!r:.80}; give a sequence with one entry for each frame")
    return tuple(given)


TARGET_LENGTH_ROUNDING = 1e-9
"""Part of a curve by which a length may exceed it."""
MAX_RELATIVE_CHORD_EXCESS = 0.01
"""Part by which straight lines between samples may exceed the arc length; on a smooth curve they never do."""
CURVATURE_QUADRATURE_STEPS = 8
"""Steps of the curvature's quadrature between two neighbours of SIGMA_GRID."""


def _sample_frames(curve: Curve, lengths: Array, first: int, total: int) -> list[Frame]:
    """Return the frames of given lengths (n,), mm, along one curve, which is evaluated for all of them at once.

    `first` is the number of the first of them, from 0, and `total` the number of frames of the target.
    """
    frames = range(first, first + len(lengths))
    s = SIGMA_GRID * lengths[:, None]

    def known(name: str, function: Callable[[Array], Any], *shape: int) -> list[Array]:
        """Evaluate a function of arc length in every frame; raise ProblemError where it is not finite."""
        whole = np.asarray(function(s.ravel()))
        if whole.shape == (s.size, *shape) and whole.dtype == float and np.isfinite(whole).all():
            return list(frozen(whole).reshape(*s.shape, *shape))
        # Something is wrong: frame by frame, so that the message can name the first frame where it is.
        parts = whole.reshape(*s.shape, *shape) if whole.shape == (s.size, *shape) else map(function, s)
        names = (f"{name} of frame {frame + 1} of the target" for frame in frames)
        return [floats(ProblemError, *each, (len(SIGMA_GRID), *shape)) for each in zip(names, parts, strict=True)]

    points = known("point", curve.point, 3)
    tangents = known("tangent", curve.tangent, 3)
    _check_direction(np.array(points), lengths, frames)
    radii = [None] * len(lengths) if curve.radius is None else known("radius", curve.radius)
    each = zip(points, tangents, lengths.tolist(), radii, frames, strict=True)
    # A motion of one frame is at its end: the arrival counts.
    part = np.linspace(0.0, 1.0, total) if total > 1 else np.ones(1)
    return [
        Frame(point, tangent, length, radius, curve, k, float(part[k]))
        for point, tangent, length, radius, k in each
    ]


def _check_direction(points: Array, lengths: Array, frames: range) -> None:
    """Raise ProblemError where a curve through points (n, 101, 3), as long as lengths (n,), mm, turns back.

    Where it does, its tangent has no direction and its samples are further apart than its arc length says.
    """
    # A polyline through points of a curve is never longer than the curve between them.
    chords = np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
    for frame, chord, length in zip(frames, chords, lengths, strict=True):
        if chord > length * (1 + MAX_RELATIVE_CHORD_EXCESS):
            raise ProblemError(
                f"frame {frame + 1} of the target has {chord:.2f} mm between points that should be "
                f"{length:.2f} mm apart along its curve: it turns back on itself and has no direction there"
            )


def _within(most: float, length: float) -> bool:
    return 0 < length <= most
