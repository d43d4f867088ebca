"""Tubes, and the one set of limits that every formulation, executor and check honours."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import RobotError
from ctr_nlp.values import described, frozen, numbers, pairs, read_toml, strict_json

Array = npt.NDArray[np.float64]

MM_PER_RAD = 10.0
"""What one radian counts as in the motion term and the roughness, in mm: the W of the design."""


@dataclass(frozen=True)
class Tube:
    """One pre-curved tube: a straight transmission, then a curved part that ends at its tip.

    length, curved_length: mm. curvature: 1/mm, constant, or (root, tip) of the curved part and linear in
    the distance from the tip between them. Diameters: mm. youngs_modulus: any unit, since only ratios
    between tubes matter for an unloaded robot. Raises RobotError.
    """

    length: float
    curved_length: float
    curvature: float | tuple[float, float]
    outer_diameter: float
    inner_diameter: float
    poisson_ratio: float = 0.3
    youngs_modulus: float = 1.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "curvature":
                pair = tuple(numbers(f.name, value, 2).tolist())
                object.__setattr__(self, "curvature", pair[0] if pair[0] == pair[1] else pair)
            else:
                object.__setattr__(self, f.name, float(numbers(f.name, value, 1)[0]))
        if self.length <= 0:
            raise RobotError(f"tube length is {self.length:g} mm; it must be positive")
        if not 0 <= self.curved_length <= self.length:
            raise RobotError(
                f"tube curved_length is {self.curved_length:g} mm; it must lie in [0, length = {self.length:g}]"
            )
        if min(self.root_curvature, self.tip_curvature) < 0:
            raise RobotError(f"tube curvature is {self.curvature}; it is unsigned (turn the tube instead)")
        if not 0 <= self.inner_diameter < self.outer_diameter:
            raise RobotError(
                f"tube inner_diameter is {self.inner_diameter:g} mm; it must lie in "
                f"[0, outer_diameter = {self.outer_diameter:g})"
            )
        if not -1 < self.poisson_ratio <= 0.5:
            raise RobotError(f"tube poisson_ratio is {self.poisson_ratio:g}; it must lie in (-1, 0.5]")
        if self.youngs_modulus <= 0:
            raise RobotError(f"tube youngs_modulus is {self.youngs_modulus:g}; it must be positive")

    @property
    def root_curvature(self) -> float:
        """Curvature where the curved part begins, 1/mm."""
        return self.curvature[0] if isinstance(self.curvature, tuple) else self.curvature

    @property
    def tip_curvature(self) -> float:
        """Curvature at the tip, 1/mm."""
        return self.curvature[1] if isinstance(self.curvature, tuple) else self.curvature

    @property
    def bending_stiffness(self) -> float:
        """EI, in units of youngs_modulus x mm^4."""
        return self.youngs_modulus * math.pi / 64 * (self.outer_diameter**4 - self.inner_diameter**4)


@dataclass(frozen=True)
class Limits:
    """What the hardware allows: position, speed and acceleration of alpha, beta and theta.

    Positions are (lower, upper), or one such pair a tube (theta: one for x, one for y); speeds and
    accelerations are a number, or one a tube. beta = None means [0, curved_length] for every tube.
    Units: rad, mm, s. carriage_gap: least (L_{i+1} - beta_{i+1}) - (L_i - beta_i) in mm, None for no such
    limit. Steering frame by frame keeps positions and speeds; how much of the acceleration it uses is in the
    plan's summary (acceleration_used, more than 1 where it is too much). The default speeds are 0.2 rad,
    9 mm and 0.08 rad a frame for 100 frames in 10 s.
    """

    alpha: Any = (-math.inf, math.inf)
    beta: Any = None
    theta: Any = (-math.pi, math.pi)
    alpha_speed: Any = 2.0
    beta_speed: Any = 90.0
    theta_speed: Any = 0.8
    alpha_acceleration: Any = math.inf
    beta_acceleration: Any = math.inf
    theta_acceleration: Any = math.inf
    carriage_gap: float | None = None


@dataclass(frozen=True)
class Robot:
    """d nested tubes, outermost first, and their limits; q = (alpha_1..d, beta_1..d, theta_x, theta_y), eq. (5).

    lower, upper, speed, acceleration: (2d + 2,) in the order of q. Raises RobotError.
    """

    tubes: tuple[Tube, ...]
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tubes", tuple(self.tubes))
        if not self.tubes:
            raise RobotError("a robot without tubes; give at least one")
        for i, (outer, inner) in enumerate(zip(self.tubes, self.tubes[1:], strict=False), start=1):
            self._check_pair(i, outer, inner)
        self._check_limits()
        self._check_extensions()

    def _check_pair(self, i: int, outer: Tube, inner: Tube) -> None:
        order = f"tubes {i} and {i + 1} are in the wrong order (outermost and stiffest first)"
        if outer.inner_diameter < inner.outer_diameter:
            if inner.inner_diameter >= outer.outer_diameter:
                raise RobotError(order)
            raise RobotError(
                f"tubes {i} and {i + 1} do not nest: inner_diameter of tube {i} is {outer.inner_diameter:g} mm, "
                f"outer_diameter of tube {i + 1} is {inner.outer_diameter:g} mm"
            )
        if outer.length > inner.length:
            raise RobotError(
                f"length of tube {i} is {outer.length:g} mm and of tube {i + 1} {inner.length:g} mm: "
                "an inner tube must be at least as long as the one around it"
            )
        if outer.bending_stiffness < inner.bending_stiffness:
            raise RobotError(f"{order}: EI is {outer.bending_stiffness:.3g} and {inner.bending_stiffness:.3g}")

    def _check_limits(self) -> None:
        lower, upper = self.lower, self.upper
        for name, lo, hi in zip(self.axes, lower, upper, strict=True):
            if math.isnan(lo) or math.isnan(hi) or lo > hi:
                raise RobotError(f"limits of {name} are [{lo:g}, {hi:g}]; the lower must not exceed the upper")
        for name in ("speed", "acceleration"):
            for axis, value in zip(self.axes, getattr(self, name), strict=True):
                if not value > 0:
                    raise RobotError(f"{name} of {axis} is {value:g}; it must be positive")

    def _check_extensions(self) -> None:
        """Some beta must keep limits, order and carriage gap; low to high is what those before leave to beta_i."""
        gap, low, high = self.carriage_gap, 0.0, math.inf
        for i, tube in enumerate(self.tubes):
            name, lo, hi = f"beta_{i + 1}", self.lower[self.d + i], self.upper[self.d + i]
            if lo < 0 or hi > tube.length:
                raise RobotError(
                    f"limits of {name} are [{lo:g}, {hi:g}] mm; they must lie in [0, {tube.length:g}], "
                    "the tube's length"
                )
            longer = tube.length - self.tubes[i - 1].length if i and gap is not None else math.inf
            if gap is not None and gap > longer:
                raise RobotError(
                    f"carriage_gap is {gap:g} mm and tube {i + 1} only {longer:g} mm longer than tube {i}: with "
                    f"beta_{i} <= {name}, it must be at most that"
                )
            low, high = max(low, lo), min(high + longer - (gap or 0.0), hi)
            if low > high:
                raise RobotError(
                    f"limits of {name} leave no room: it must be at least {low:g} mm (order, lower limits) "
                    f"and at most {high:g} mm (upper limits and carriage gap)"
                )

    @cached_property
    def carriage_gap(self) -> float | None:
        """Least distance between neighbouring carriages, mm, or None."""
        if self.limits.carriage_gap is None:
            return None
        gap = float(numbers("carriage_gap", self.limits.carriage_gap, 1)[0])
        if gap < 0:
            raise RobotError(f"carriage_gap is {gap:g} mm; it must be at least 0, or None")
        return gap

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
        return frozen(np.concatenate([np.full(self.d, MM_PER_RAD), np.ones(self.d), np.full(2, MM_PER_RAD)]))

    @property
    def reach(self) -> float:
        """Largest beta_d, mm."""
        return float(self.upper[2 * self.d - 1])

    def split(self, q: Any) -> tuple[Any, Any, Any]:
        """Alpha (.., d), beta (.., d) and theta (.., 2) of q (.., 2d + 2)."""
        return q[..., : self.d], q[..., self.d : 2 * self.d], q[..., 2 * self.d :]

    def with_limits(self, **limits: Any) -> Robot:
        """The same robot with some of its Limits replaced; raises RobotError."""
        return replace(self, limits=replace(self.limits, **limits))

    def with_locked_tilt(self) -> Robot:
        """The same robot without an arm: theta stays 0."""
        return self.with_limits(theta=(0.0, 0.0))

    def check(self, q: Array, name: str = "q", tolerance: float = 1e-6) -> None:
        """Raise RobotError unless q (2d + 2,) is finite and keeps limits and order to tolerance (rad, mm)."""
        if q.shape != (2 * self.d + 2,):
            raise RobotError(f"{name} has shape {q.shape}; it must be ({2 * self.d + 2},): {', '.join(self.axes)}")
        for axis, value, lo, hi in zip(self.axes, q, self.lower, self.upper, strict=True):
            if not (math.isfinite(value) and lo - tolerance <= value <= hi + tolerance):
                raise RobotError(f"{axis} of {name} is {value:g}; it must lie in [{lo:g}, {hi:g}]")
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

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and lists as a robot file holds them, fit for strict JSON (no limit is "inf")."""
        plain = asdict(self)
        return {"tubes": list(plain["tubes"]), "limits": strict_json(plain["limits"])}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Robot:
        """The robot that to_dict or a robot file describes; raises RobotError."""
        unknown = set(data) - {"name", "tubes", "limits"}
        if unknown:
            raise RobotError(f"unknown key {sorted(unknown)[0]!r} in a robot; allowed are name, tubes, limits")
        tubes = data.get("tubes")
        if not isinstance(tubes, list) or not all(isinstance(t, dict) for t in tubes):
            raise RobotError("a robot needs a list of tubes, [[tubes]] in TOML")
        return cls(tuple(described(Tube, t) for t in tubes), described(Limits, data.get("limits", {})))

    @classmethod
    def from_toml(cls, path: str | Path) -> Robot:
        """The robot of a TOML file; raises RobotError where it cannot be read or is not a robot."""
        try:
            return cls.from_dict(read_toml(path))
        except RobotError as error:
            raise RobotError(f"robot file {path}: {error}") from error


def seed_robot(literal: bool = False) -> Robot:
    """The seed's robot, Table I, read so that only curved parts are deployed: 50, 107 and 150 mm.

    literal=True takes the table at its word: those lengths are straight and 40, 95, 240 mm are curved.
    """
    curved = (40.0, 95.0, 240.0) if literal else (50.0, 107.0, 150.0)
    return Robot(
        (
            Tube(90.0, curved[0], 1 / 130, outer_diameter=5.7, inner_diameter=4.3),
            Tube(202.0, curved[1], 1 / 60, outer_diameter=3.7, inner_diameter=2.9),
            Tube(390.0, curved[2], 1 / 80, outer_diameter=2.1, inner_diameter=1.0),
        )
    )
