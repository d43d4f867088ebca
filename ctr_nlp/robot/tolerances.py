"""Tolerances: by how much a built robot, and its motors' zeros, may differ from the description.

Differences of d tubes are a vector of 5 d entries, tube by tube in the order of DEVIATION_NAMES. A band of half
width b is a uniform distribution on [-b, b], of variance b^2 / 3; the normal one has the same variance.
"""

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
from ctr_nlp.support.value_checks import number, numbers, plain_floats, to_nested_tuples
from ctr_nlp.typing import Array

DISTRIBUTIONS = "uniform", "normal"
"""Distributions of the differences: uniform within the band, or normal with the same variance."""
MAX_TOLERANCES = {
    **dict.fromkeys(("curvature", "bending_stiffness", "torsional_ratio"), 0.5),
    "curved_length": 100.0,
    **dict.fromkeys(("motor_zero", "rotation_lag"), math.pi / 2),
    "diameter": 1.0,
}
"""Largest tolerances that are accepted: parts, mm and rad. Larger ones would hardly describe a robot."""
MAX_TOLERANCE_FORCE_N = 10.0
"""Largest force at the tip, N, more than any robot of this kind withstands."""
TOLERANCE_UNITS = {"curved_length": " mm", "motor_zero": " rad", "rotation_lag": " rad", "diameter": " mm"}
DEVIATION_NAMES = "curvature", "bending_stiffness", "torsional_ratio", "curved_length", "motor_zero"
"""Numbers that differ from robot to robot, tube by tube: parts, mm and rad."""
COVARIANCE_ROUNDING = 1e-9
"""Relative error by which a covariance may fail to be symmetric or positive semidefinite."""


@packable("tolerances")
@dataclass(frozen=True)
class Tolerances:
    """Tolerances of a robot: by how much a built one may differ from its description.

    Each is one number, or one a tube, outermost first, half the width of a band around the nominal value: 0.02 of
    curvature is +-2 %. Lists and arrays are stored as tuples.

    Attributes
    ----------
    curvature, bending_stiffness, torsional_ratio : float or sequence of float
        Relative tolerances of the pre-curvature, of EI and of EI / GJ.
    curved_length : float or sequence of float
        Tolerance of the length of the curved part, mm.
    motor_zero : float or sequence of float
        Angle by which alpha may be off where the motor reads 0, rad.
    rotation_lag : float or sequence of float
        Largest backlash, rad: difference between the angles of a tube and of its motor while that turns. The
        backlash of a robot is uniform in [0, rotation_lag], whatever the distribution.
    diameter : float or sequence of float
        Tolerance of the outer and of the inner diameter, mm. Diameters change the bending stiffness, which then
        varies by more than `bending_stiffness`.
    tip_force : float
        Largest force at the tip, N; it may act in any direction, and come and go.
    distribution : str
        ``"uniform"`` within the bands, or ``"normal"`` with the same variance.
    covariance : array_like or None
        Covariance (5 d, 5 d) of all differences, for the normal distribution: tube by tube, outermost first, each
        with its curvature, bending_stiffness, torsional_ratio, curved_length and motor_zero, in the units above.
        It replaces their bands and that of the diameters, which must then be left at their defaults.

    Raises
    ------
    RobotError
        A tolerance is out of range, or the covariance is not symmetric and positive semidefinite.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> tolerances = ctr.Tolerances(curvature=0.05, motor_zero=(0.01, 0.01, 0.03))
    >>> tolerances.bands(ctr.table_i_robot().tubes).shape
    (3, 5)
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
            object.__setattr__(self, f.name, to_nested_tuples(getattr(self, f.name)))
        if not isinstance(self.distribution, str) or self.distribution not in DISTRIBUTIONS:
            allowed = " or ".join(DISTRIBUTIONS)
            raise RobotError(f"distribution of tolerances is {self.distribution!r}; it must be {allowed}")
        for name in MAX_TOLERANCES:
            value = getattr(self, name)
            for each in numbers(_of(name), value, len(value) if isinstance(value, tuple) else 1):
                if not 0 <= each <= MAX_TOLERANCES[name]:
                    unit = TOLERANCE_UNITS.get(name, "")
                    raise RobotError(
                        f"{_of(name)} is {each:g}{unit}; it must lie in [0, {MAX_TOLERANCES[name]:.4g}]{unit}"
                    )
        most = f"lie in [0, {MAX_TOLERANCE_FORCE_N:g}] N"
        number(RobotError, _of("tip_force"), self.tip_force, between(0.0, MAX_TOLERANCE_FORCE_N), most, " N")
        if self.covariance is not None:
            self._check_covariance()

    def _check_covariance(self) -> None:
        """Raise RobotError unless the covariance is symmetric, positive semidefinite and given in
        place of bands.
        """
        name = _of("covariance")
        found = self._covariance()
        if self.distribution != "normal":
            raise RobotError(f'{name} needs distribution = "normal"; it is {self.distribution!r}')
        for f in fields(self):
            if f.name in (*DEVIATION_NAMES, "diameter") and getattr(self, f.name) != f.default:
                raise RobotError(
                    f"{_of(f.name)} is {getattr(self, f.name)}; leave it out where a covariance is given"
                )
        scale = max(float(abs(found).max(initial=0.0)), 1e-300)
        if found.diagonal().min() < 0 or abs(found - found.T).max() > COVARIANCE_ROUNDING * scale:
            raise RobotError(f"{name} is not symmetric with variances of at least 0; it must be")
        # Scaled to entries of at most 1, so that variances in rad^2 and mm^2 share one threshold of rounding.
        least = float(np.linalg.eigvalsh(found / scale)[0])
        if least < -COVARIANCE_ROUNDING * len(found):
            raise RobotError(f"{name} has an eigenvalue {least * scale:.3g}; all must be at least 0")

    def _covariance(self) -> Array:
        """Return the covariance (5 d, 5 d) as an array; raise RobotError where it is no square of five rows a
        tube.
        """
        try:
            found = plain_floats(self.covariance)
        except (TypeError, ValueError):
            found = np.empty(0)
        if (
            found.ndim != 2
            or found.shape[0] != found.shape[1]
            or len(found) % len(DEVIATION_NAMES)
            or not len(found)
        ):
            told = f"shape {found.shape}" if found.size else f"{self.covariance!r:.60}"
            raise RobotError(
                f"{_of('covariance')} is of {told}; it must be a square of {len(DEVIATION_NAMES)} rows a tube: "
                f"{', '.join(DEVIATION_NAMES)}"
            )
        if not np.isfinite(found).all():
            raise RobotError(f"{_of('covariance')} has entries that are not finite; all must be")
        return found

    def check(self, tubes: Sequence[Tube]) -> None:
        """Check that these tolerances fit the tubes of a robot.

        Parameters
        ----------
        tubes : sequence of Tube
            The d tubes, outermost first.

        Raises
        ------
        RobotError
            A tolerance has another number of entries than there are tubes, the covariance has another size, or the
            tolerance of a diameter is as large as the wall of a tube.
        """
        d = len(tubes)
        for name in MAX_TOLERANCES:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != d:
                raise RobotError(
                    f"{_of(name)} has {len(value)} numbers; it must be one, or one for each of {d} tubes"
                )
        if self.covariance is not None and len(self.covariance) != len(DEVIATION_NAMES) * d:
            rows = len(self.covariance)
            raise RobotError(
                f"{_of('covariance')} has {rows} rows; it must have {len(DEVIATION_NAMES) * d}, for {d} tubes"
            )
        for i, (tube, off) in enumerate(zip(tubes, self.diameters(d).tolist(), strict=True), start=1):
            wall = (tube.outer_diameter - tube.inner_diameter) / 2
            if off > 0 and off >= wall:
                raise RobotError(
                    f"{_of('diameter')} is {off:g} mm; it must be less than the wall of tube {i}, {wall:.3g} mm"
                )

    def bands_without_diameters(self, d: int) -> Array:
        """Return the half widths of the bands as they were given, without the effect of diameters.

        Parameters
        ----------
        d : int
            Number of tubes.

        Returns
        -------
        ndarray
            Half widths (d, 5), in the order of `DEVIATION_NAMES`; sqrt(3 variance) of each where a covariance is
            given.
        """
        if self.covariance is not None:
            # The band of a uniform distribution with this variance, so that both kinds of tolerances can be
            # treated alike.
            return np.sqrt(3 * np.maximum(self._covariance().diagonal(), 0.0)).reshape(d, len(DEVIATION_NAMES))
        return np.stack([numbers(_of(name), getattr(self, name), d) for name in DEVIATION_NAMES], axis=1)

    def bands(self, tubes: Sequence[Tube]) -> Array:
        """Return the half widths of the bands of all numbers that differ, with the effect of diameters.

        Parameters
        ----------
        tubes : sequence of Tube
            The d tubes, outermost first, whose sections say how diameters change the stiffness.

        Returns
        -------
        ndarray
            Half widths (d, 5), in the order of `DEVIATION_NAMES`, of uniform bands with the same variances. The
            variance that diameters give the bending stiffness is added to first order.
        """
        found = self.bands_without_diameters(len(tubes))
        slopes = np.array([tube.stiffness_slopes for tube in tubes])
        stiffness = DEVIATION_NAMES.index("bending_stiffness")
        # Variances of independent errors add up: those of the band, and of both diameters by d(EI)/EI = slope *
        # d(diameter).
        found[:, stiffness] = np.hypot(found[:, stiffness], self.diameters(len(tubes)) * np.hypot(*slopes.T))
        return found

    def covariance_root(self, tubes: Sequence[Tube]) -> Array:
        """Return a square root of the covariance of all differences.

        Parameters
        ----------
        tubes : sequence of Tube
            The d tubes, outermost first.

        Returns
        -------
        ndarray
            R (5 d, 5 d) with R R^T the covariance; columns of zeros for directions in which nothing differs.
        """
        bands = self.bands(tubes)
        if self.covariance is None:
            return np.diag(bands.ravel() / math.sqrt(3))
        found = self._covariance()
        root = np.zeros((bands.size, bands.size))
        # By rounding, an eigenvector of the whole matrix would let numbers differ that have no variance; rows
        # without variance are left out.
        differs = np.flatnonzero(found.diagonal() > 0)
        among = np.ix_(differs, differs)
        # R = V sqrt(S) from the eigenvalues S, not Cholesky's factor: that does not exist for a singular
        # covariance, such as one that a calibration leaves.
        sizes, axes = np.linalg.eigh((found + found.T)[among] / 2)
        root[among] = axes * np.sqrt(np.maximum(sizes, 0.0))
        return root

    def max_backlash(self, d: int) -> Array:
        """Return the largest backlash of each tube.

        Parameters
        ----------
        d : int
            Number of tubes.

        Returns
        -------
        ndarray
            (d,), rad.
        """
        return numbers(_of("rotation_lag"), self.rotation_lag, d)

    def diameters(self, d: int) -> Array:
        """Return the tolerance of the diameters of each tube.

        Parameters
        ----------
        d : int
            Number of tubes.

        Returns
        -------
        ndarray
            (d,), mm, for the outer and the inner diameter alike.
        """
        return numbers(_of("diameter"), self.diameter, d)


def _of(name: str) -> str:
    """Return what messages call a tolerance."""
    return f"{name} of tolerances"
