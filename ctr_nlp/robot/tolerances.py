"""How well a robot is known: by how much its tubes, and its motors' zeros, may differ from what is described."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import Tube
from ctr_nlp.robot.units import between
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import number, numbers, plain_floats, unchanging
from ctr_nlp.typing import Array

DISTRIBUTIONS = "uniform", "normal"
"""Of what is not quite known, within its band or with the same variance as the uniform one."""
LARGEST = {
    **dict.fromkeys(("curvature", "bending_stiffness", "torsional_ratio"), 0.5),
    "curved_length": 100.0,
    **dict.fromkeys(("motor_zero", "rotation_lag"), math.pi / 2),
    "diameter": 1.0,
}
"""Tolerances beyond which nothing is known of a robot: parts, mm and rad."""
LARGEST_FORCE = 10.0
"""N at the tip, beyond what any robot of this kind bears."""
UNITS = {"curved_length": " mm", "motor_zero": " rad", "rotation_lag": " rad", "diameter": " mm"}
NAMES = "curvature", "bending_stiffness", "torsional_ratio", "curved_length", "motor_zero"
"""What differs from robot to robot, tube by tube: parts, mm and rad."""
ROUNDING = 1e-9
"""By which part a covariance may fail to be symmetric or positive semidefinite: rounding."""


@packable("tolerances")
@dataclass(frozen=True)
class Tolerances:
    """By how much a robot may differ from its description; each a number, or one a tube, outermost first.

    curvature, bending_stiffness, torsional_ratio: as parts of themselves, half the width of the band, so that 0.02
    stands for +-2 %. curved_length: mm. motor_zero: by what angle alpha is off where the motor reads 0, rad.
    rotation_lag: by up to what angle a tube stays behind its motor when that turns, rad; a robot has a lag of its
    own in [0, rotation_lag], uniform whatever the distribution. diameter: of the outer and of the inner diameter,
    mm; they change the bending stiffness, which then differs by more than bending_stiffness says. tip_force: N, a
    single number: a force of up to so much may act at the tip in any direction, and come and go.

    distribution: uniform in the band, or normal with the variance of that. covariance: of all tubes' differences
    together, (5 d, 5 d), for the normal distribution; tube by tube, outermost first, each with its curvature,
    bending_stiffness, torsional_ratio, curved_length and motor_zero, in the units above. It takes the place of
    their bands, which are then left at their defaults. Lists and arrays are kept as tuples. Raises RobotError.
    """

    curvature: Any = 0.02
    bending_stiffness: Any = 0.02
    torsional_ratio: Any = 0.0
    curved_length: Any = 0.0
    motor_zero: Any = 0.02
    rotation_lag: Any = 0.0
    diameter: Any = 0.0
    tip_force: float = 0.0
    distribution: str = "uniform"
    covariance: Any = None

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, unchanging(getattr(self, f.name)))
        if not isinstance(self.distribution, str) or self.distribution not in DISTRIBUTIONS:
            allowed = " or ".join(DISTRIBUTIONS)
            raise RobotError(f"distribution of tolerances is {self.distribution!r}; it must be {allowed}")
        for name in LARGEST:
            value = getattr(self, name)
            for each in numbers(_of(name), value, len(value) if isinstance(value, tuple) else 1):
                if not 0 <= each <= LARGEST[name]:
                    unit = UNITS.get(name, "")
                    raise RobotError(
                        f"{_of(name)} is {each:g}{unit}; it must lie in [0, {LARGEST[name]:.4g}]{unit}"
                    )
        most = f"lie in [0, {LARGEST_FORCE:g}] N"
        number(RobotError, _of("tip_force"), self.tip_force, between(0.0, LARGEST_FORCE), most, " N")
        if self.covariance is not None:
            self._check_covariance()

    def _check_covariance(self) -> None:
        name, found = _of("covariance"), self._covariance()
        if self.distribution != "normal":
            raise RobotError(f'{name} needs distribution = "normal"; it is {self.distribution!r}')
        for f in fields(self):
            if f.name in (*NAMES, "diameter") and getattr(self, f.name) != f.default:
                raise RobotError(
                    f"{_of(f.name)} is {getattr(self, f.name)}; leave it out where a covariance is given"
                )
        scale = max(float(abs(found).max(initial=0.0)), 1e-300)
        if found.diagonal().min() < 0 or abs(found - found.T).max() > ROUNDING * scale:
            raise RobotError(f"{name} is not symmetric with variances of at least 0; it must be")
        least = float(np.linalg.eigvalsh(found / scale)[0])
        if least < -ROUNDING * len(found):
            raise RobotError(f"{name} has an eigenvalue {least * scale:.3g}; all must be at least 0")

    def _covariance(self) -> Array:
        """(5 d, 5 d), as it was given."""
        try:
            found = plain_floats(self.covariance)
        except (TypeError, ValueError):
            found = np.empty(0)
        if found.ndim != 2 or found.shape[0] != found.shape[1] or len(found) % len(NAMES) or not len(found):
            told = f"shape {found.shape}" if found.size else f"{self.covariance!r:.60}"
            raise RobotError(
                f"{_of('covariance')} is of {told}; it must be a square of {len(NAMES)} rows a tube: "
                f"{', '.join(NAMES)}"
            )
        if not np.isfinite(found).all():
            raise RobotError(f"{_of('covariance')} has entries that are not finite; all must be")
        return found

    def check(self, tubes: Sequence[Tube]) -> None:
        """Raise RobotError unless these are tolerances that so many tubes, and these, may have."""
        d = len(tubes)
        for name in LARGEST:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != d:
                raise RobotError(
                    f"{_of(name)} has {len(value)} numbers; it must be one, or one for each of {d} tubes"
                )
        if self.covariance is not None and len(self.covariance) != len(NAMES) * d:
            rows = len(self.covariance)
            raise RobotError(f"{_of('covariance')} has {rows} rows; it must have {len(NAMES) * d}, for {d} tubes")
        for i, (tube, off) in enumerate(zip(tubes, self.diameters(d).tolist(), strict=True), start=1):
            wall = (tube.outer_diameter - tube.inner_diameter) / 2
            if off > 0 and off >= wall:
                raise RobotError(
                    f"{_of('diameter')} is {off:g} mm and the wall of tube {i} {wall:.3g} mm thick; of a robot "
                    "within such tolerances it may be gone"
                )

    def stated(self, d: int) -> Array:
        """Half the widths (d, 5) of the bands of d tubes as they are given, in the order of NAMES."""
        if self.covariance is not None:
            return np.sqrt(3 * np.maximum(self._covariance().diagonal(), 0.0)).reshape(d, len(NAMES))
        return np.stack([numbers(_of(name), getattr(self, name), d) for name in NAMES], axis=1)

    def bands(self, tubes: Sequence[Tube]) -> Array:
        """Half the widths (d, 5) of tubes' bands, in the order of NAMES; of the same variance.

        To the bending stiffness's is added, to first order, what diameters within their tolerances make of it.
        """
        found = self.stated(len(tubes))
        slopes = np.array([tube.stiffness_slopes for tube in tubes])
        stiffness = NAMES.index("bending_stiffness")
        found[:, stiffness] = np.hypot(found[:, stiffness], self.diameters(len(tubes)) * np.hypot(*slopes.T))
        return found

    def root(self, tubes: Sequence[Tube]) -> Array:
        """A square root (5 d, 5 d) of the covariance of d tubes."""
        bands = self.bands(tubes)
        if self.covariance is None:
            return np.diag(bands.ravel() / math.sqrt(3))
        found, root = self._covariance(), np.zeros((bands.size, bands.size))
        differs = np.flatnonzero(found.diagonal() > 0)  # by rounding, nothing else may differ either
        among = np.ix_(differs, differs)
        sizes, axes = np.linalg.eigh((found + found.T)[among] / 2)
        root[among] = axes * np.sqrt(np.maximum(sizes, 0.0))
        return root

    def lags(self, d: int) -> Array:
        """The largest lags (d,) of d tubes, rad."""
        return numbers(_of("rotation_lag"), self.rotation_lag, d)

    def diameters(self, d: int) -> Array:
        """By how much the outer and the inner diameters of d tubes may differ, (d,) mm."""
        return numbers(_of("diameter"), self.diameter, d)


def _of(name: str) -> str:
    return f"{name} of tolerances"
