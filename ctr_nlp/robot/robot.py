"""A robot: its tubes, and the one set of limits that every formulation, executor and check respects.

The configuration is q = (alpha_1 .. alpha_d, beta_1 .. beta_d, theta_x, theta_y), eq. (5) of the paper: rotations
of the tubes at their motors in rad, extensions beyond the insertion point in mm, and the tilt of the base in rad.
Tube 1 is the outermost.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.checks import MAX_MOTOR_ANGLES_RAD, check_angle, check_pair, sequence_of_tubes
from ctr_nlp.robot.extensions import check_extensions, compute_max_extensions
from ctr_nlp.robot.limits import Limits
from ctr_nlp.robot.strain import check_deployed
from ctr_nlp.robot.structure import Structure, TubeNumbers, helix_pieces, kind_of, numbers_of, tubes_of
from ctr_nlp.robot.tolerances import Tolerances
from ctr_nlp.robot.tube import Tube
from ctr_nlp.robot.units import between, did_you_mean, suggest_angle
from ctr_nlp.support.mistaken_files import ROBOT_FILE, name_other_kind
from ctr_nlp.support.packing import packable
from ctr_nlp.support.tables import toml_text
from ctr_nlp.support.value_checks import (
    build_from_table,
    check_keys,
    frozen,
    numbers,
    pairs,
    plain_floats,
    read_toml,
    strict_json,
)
from ctr_nlp.typing import Array

MM_PER_RAD = 10.0
"""Length in mm that one radian equals in the motion term of eq. (9) and in the roughness: the weights W of
docs/method.md. A tube turned by 1 rad is as costly as one pushed by 10 mm.
"""
MAX_SUMMARY_LENGTH = 120
"""Largest number of characters of a robot's summary, its repr."""
ROBOT_FILE_KEYS = ("name", "tubes", "limits", "tolerances")
"""Keys of a robot file."""
TUBE_UNIT_COMMENTS = {
    "length": "mm, the whole tube, from its carriage to its tip",
    "curved_length": "mm, the part behind the tip that is pre-curved; the rest is straight transmission",
    "curvature": "1/mm; [root, tip] of the curved part, linear between them",
    "outer_diameter": "mm",
    "inner_diameter": "mm",
    "pre_torsion": "rad/mm, by how much the direction of a helix's curvature turns along it",
    "max_strain": "largest strain of the material, as a part: 0.17 is 17 %",
}
"""Comments that a robot file has beside the numbers of its tubes."""


@packable("robot")
@dataclass(frozen=True)
class Robot:
    """A concentric tube robot of d nested tubes, outermost first, with limits and tolerances.

    An inner tube may be as stiff as the one around it, or stiffer: only the dominant-stiffness model requires an
    order of stiffnesses, and checks it itself (``Model.check``).

    Attributes
    ----------
    tubes : sequence of Tube
        The d tubes, outermost first; stored as a tuple.
    limits : Limits
        Limits of the motors.
    tolerances : Tolerances
        By how much built robots differ from this description.

    Raises
    ------
    RobotError
        Tubes do not nest, limits leave no configuration, a tube of the deployed robot would be strained by more
        than 6 %, or by more than its own max_strain, or tolerances do not fit the tubes.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> outer = ctr.Tube(90, 50, 1 / 130, outer_diameter=5.7, inner_diameter=4.3)
    >>> inner = ctr.Tube(202, 107, 1 / 60, outer_diameter=3.7, inner_diameter=2.9)
    >>> robot = ctr.Robot((outer, inner), ctr.Limits(theta=(0, 0)))
    >>> robot.axes
    ('alpha_1', 'alpha_2', 'beta_1', 'beta_2', 'theta_x', 'theta_y')
    >>> robot.max_extensions
    array([ 50., 107.])
    >>> robot
    Robot(2 tubes: diameters 5.7, 3.7 mm, bend radii 130, 60 mm, reach 107 mm)
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
        # From the parts to the whole: later checks rely on what earlier ones found.
        self.tolerances.check(self.tubes)
        for i, (outer, inner) in enumerate(zip(self.tubes, self.tubes[1:], strict=False), start=1):
            check_pair(i, outer, inner)
        self._check_limits()
        low, high = (self.split(ends)[1].tolist() for ends in (self.lower, self.upper))
        check_extensions(self.tubes, low, high, self.carriage_gap)
        check_deployed(self.tubes, self._strained_extensions())

    def __repr__(self) -> str:
        diameters = ", ".join(f"{tube.outer_diameter:g}" for tube in self.tubes)
        bends = ", ".join("straight" if t.is_straight else f"{1 / t.largest_curvature:.0f}" for t in self.tubes)
        tubes = f"{self.d} tube{'s' if self.d > 1 else ''}"
        full = f"Robot({tubes}: diameters {diameters} mm, bend radii {bends} mm, reach {self.reach:g} mm)"
        return full if len(full) <= MAX_SUMMARY_LENGTH else f"Robot({tubes}, reach {self.reach:g} mm)"

    def __reduce__(self) -> Any:
        # Rebuilt from its fields, so that cached arrays are not pickled and stay read-only.
        return Robot, (self.tubes, self.limits, self.tolerances)

    def _check_limits(self) -> None:
        """Raise RobotError unless lower limits lie below upper ones, angles can be turned, and rates
        are positive.
        """
        lower = self.lower
        upper = self.upper
        for name, lo, hi in zip(self.axes, lower, upper, strict=True):
            if math.isnan(lo) or math.isnan(hi) or lo > hi:
                raise RobotError(f"limits of {name} are [{lo:g}, {hi:g}]; the lower must not exceed the upper")
            for end in (lo, hi):
                if name.partition("_")[0] in MAX_MOTOR_ANGLES_RAD and math.isfinite(end):
                    check_angle(f"limits of {name} are [{lo:g}, {hi:g}] rad, and {end:g}", name, end)
        for name in ("speed", "acceleration"):
            for axis, value in zip(self.axes, getattr(self, name), strict=True):
                if not value > 0:
                    raise RobotError(f"{name} of {axis} is {value:g}; it must be positive")

    def _strained_extensions(self) -> list[float]:
        """Return the extensions beta (d,), mm, at which the strain of the deployed robot is checked.

        Where no limits are given, straight tubes around all curved ones cover the others by their curved_length at
        most: a tube held straight throughout has the strain of its pre-curvature, which each tube checks.
        """
        beta = self.max_extensions.tolist()
        if self.limits.beta is None:
            for i, _ in itertools.takewhile(lambda each: each[1].is_straight, enumerate(self.tubes)):
                beta[i] = min(beta[i], self.tubes[i].curved_length)
        return beta

    @cached_property
    def max_extensions(self) -> Array:
        """Largest beta (d,), mm, that limits, order and carriage gap allow together."""
        return compute_max_extensions(self.tubes, self.split(self.upper)[1], self.carriage_gap)

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
        """Structure of the robot, for which programs are compiled; the tubes' numbers are their parameters."""
        low = self.d
        high = 2 * self.d
        ends = zip(self.tubes, self.upper[low:high], strict=True)
        kinds = tuple(map(kind_of, self.tubes))
        # A tube extended beyond its curved part shows its straight transmission: one section more in every model.
        # A straight tube is alike along its whole length.
        shown = tuple(
            bool(end > tube.curved_length) and kind != "straight"
            for kind, (tube, end) in zip(kinds, ends, strict=True)
        )
        return Structure(kinds, shown, self.carriage_gap is not None, helix_pieces(self.tubes))

    @cached_property
    def numbers(self) -> Array:
        """Numbers of the tubes that models use, (d, 8), in the order of `structure.TUBE_NUMBER_NAMES`."""
        return frozen(np.array(numbers_of(self.tubes)))

    @cached_property
    def tube_numbers(self) -> tuple[TubeNumbers, ...]:
        """The tubes as models take them, outermost first."""
        return tubes_of(self.structure, self.numbers.tolist())

    @cached_property
    def max_extension_differences(self) -> Array:
        """Largest beta_{i+1} - beta_i (d - 1,), mm, that the carriage gap allows; inf without one."""
        if self.carriage_gap is None:
            return frozen(np.full(self.d - 1, np.inf))
        # The gap (L_{i+1} - beta_{i+1}) - (L_i - beta_i) >= g, solved for beta_{i+1} - beta_i.
        return frozen(np.diff([tube.length for tube in self.tubes]) - self.carriage_gap)

    @property
    def d(self) -> int:
        """Number of tubes."""
        return len(self.tubes)

    @cached_property
    def axes(self) -> tuple[str, ...]:
        """Names of the entries of q, in order."""
        count = range(1, self.d + 1)
        return (*(f"alpha_{i}" for i in count), *(f"beta_{i}" for i in count), "theta_x", "theta_y")

    @cached_property
    def lower(self) -> Array:
        """Lower limits of q, (2d + 2,), rad and mm."""
        return self._positions[:, 0]

    @cached_property
    def upper(self) -> Array:
        """Upper limits of q, (2d + 2,), rad and mm."""
        return self._positions[:, 1]

    @cached_property
    def _positions(self) -> Array:
        """Lower and upper limits of q, (2d + 2, 2), rad and mm."""
        beta = self.limits.beta
        if beta is None:
            beta = [(0.0, tube.usual_extension) for tube in self.tubes]
        rows = [
            pairs("alpha", self.limits.alpha, self.d),
            pairs("beta", beta, self.d),
            pairs("theta", self.limits.theta, 2),
        ]
        return frozen(np.vstack(rows))

    @cached_property
    def speed(self) -> Array:
        """Largest speed of each entry of q, (2d + 2,), rad/s and mm/s."""
        return self._rates("speed")

    @cached_property
    def acceleration(self) -> Array:
        """Largest acceleration of each entry of q, (2d + 2,), rad/s^2 and mm/s^2."""
        return self._rates("acceleration")

    def _rates(self, kind: str) -> Array:
        """Return the limits of one kind, "speed" or "acceleration", in the order of q, (2d + 2,)."""
        names = (f"alpha_{kind}", f"beta_{kind}", f"theta_{kind}")
        sizes = (self.d, self.d, 2)
        return frozen(
            np.concatenate(
                [numbers(n, getattr(self.limits, n), k, True) for n, k in zip(names, sizes, strict=True)]
            )
        )

    @cached_property
    def mm_per_unit(self) -> Array:
        """Weights W of the motion term, eq. (9), (2d + 2,): MM_PER_RAD mm/rad for angles and 1 for beta."""
        return frozen(mm_per_unit(self.d))

    @property
    def reach(self) -> float:
        """Upper limit of beta_d, mm: how long the robot can be."""
        return float(self.upper[2 * self.d - 1])

    def split(self, q: Any) -> tuple[Any, Any, Any]:
        """Split configurations into rotations, extensions and tilt.

        Parameters
        ----------
        q : ndarray
            Configurations (.., 2d + 2), or anything else with such a last axis.

        Returns
        -------
        alpha : ndarray
            Rotations (.., d), rad.
        beta : ndarray
            Extensions (.., d), mm.
        theta : ndarray
            Tilt of the base (.., 2), rad. All three are views.

        Examples
        --------
        >>> import numpy as np
        >>> from ctr_nlp.robot import table_i_robot
        >>> alpha, beta, theta = table_i_robot().split(np.array([0, 0, 0, 20, 40, 60, 0, 0]))
        >>> beta
        array([20, 40, 60])
        """
        return q[..., : self.d], q[..., self.d : 2 * self.d], q[..., 2 * self.d :]

    def with_limits(self, **limits: Any) -> Robot:
        """Return a copy of the robot with some of its limits replaced.

        Parameters
        ----------
        **limits : Any
            New values, by the names of the attributes of :class:`Limits`.

        Returns
        -------
        Robot
            The robot with these limits; all others stay.

        Raises
        ------
        RobotError
            A name is unknown, or the limits leave no configuration.

        Examples
        --------
        >>> from ctr_nlp.robot import table_i_robot
        >>> table_i_robot().with_limits(beta_speed=20.0).speed[3:6]
        array([20., 20., 20.])
        """
        allowed = [f.name for f in fields(Limits)]
        unknown = sorted(set(limits) - set(allowed))
        if unknown:
            raise RobotError(f"limit {unknown[0]!r} is unknown; allowed are {', '.join(allowed)}")
        return replace(self, limits=replace(self.limits, **limits))

    def with_locked_tilt(self) -> Robot:
        """Return a copy of the robot whose base cannot tilt (theta stays 0), as one that no arm carries.

        Returns
        -------
        Robot
            The same tubes and limits, with both limits of theta 0.
        """
        return self.with_limits(theta=(0.0, 0.0))

    def check(self, q: npt.ArrayLike, name: str = "q", tolerance: float = 1e-6) -> Array:
        """Check a configuration against limits, order and carriage gap, eqs. (2) and (3).

        Speeds are not checked here, since they belong to a step between two configurations.

        Parameters
        ----------
        q : array_like
            Configuration (2d + 2,), rad and mm.
        name : str
            What messages call it.
        tolerance : float
            By how much a limit may be exceeded, rad or mm.

        Returns
        -------
        ndarray
            The configuration as an array of floats (2d + 2,), unchanged.

        Raises
        ------
        RobotError
            It has another shape, is not finite or violates a limit. The message names the entry, and offers an
            angle in rad that was likely meant in degrees.

        Examples
        --------
        >>> from ctr_nlp.robot import table_i_robot
        >>> table_i_robot().check([0, 0, 0, 20, 60, 50, 0, 0])
        Traceback (most recent call last):
            ...
        ctr_nlp.exceptions.RobotError: beta_2 of q is 60 mm and exceeds beta_3, 50 mm
        """
        q = configuration(name, q)
        if q.shape != (2 * self.d + 2,):
            raise RobotError(f"{name} has shape {q.shape}; it must be ({2 * self.d + 2},): {', '.join(self.axes)}")
        for axis, value, lo, hi in zip(self.axes, q, self.lower, self.upper, strict=True):
            if not (math.isfinite(value) and lo - tolerance <= value <= hi + tolerance):
                turned = math.isfinite(value) and axis.partition("_")[0] in MAX_MOTOR_ANGLES_RAD
                meant = suggest_angle(value, between(lo, hi)) if turned else []
                unit = "mm" if axis.startswith("beta") else "rad"
                raise RobotError(
                    f"{axis} of {name} is {value:g} {unit}; it must lie in [{lo:g}, {hi:g}] {unit}"
                    f"{did_you_mean(meant)}"
                )
            # Limits of alpha may be infinite, but no drive turns on for ever.
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
        """Return the robot as numbers, strings and lists, as a robot file holds them.

        Returns
        -------
        dict
            ``tubes``, ``limits`` and ``tolerances``, fit for strict JSON: no limit is written as ``"inf"``.
        """
        plain = asdict(self)
        # Only what is given: files of robots without a strain limit stay as they were.
        tubes = [{key: value for key, value in tube.items() if value is not None} for tube in plain["tubes"]]
        return {"tubes": tubes} | {k: strict_json(plain[k]) for k in ("limits", "tolerances")}

    def to_toml(self, head: str = "") -> str:
        """Return the text of a robot file.

        Parameters
        ----------
        head : str
            Comment on top of the file, without comment marks; it may have several lines.

        Returns
        -------
        str
            TOML that :meth:`from_toml` reads as an equal robot, with units as comments.

        Examples
        --------
        >>> from ctr_nlp.robot import table_i_robot
        >>> table_i_robot().to_toml("Table I").splitlines()[:3]
        ['# Table I', '', '[[tubes]]']
        """
        plain = self.to_dict()
        tubes = toml_text(head, [("[[tubes]]", tube) for tube in plain["tubes"]], TUBE_UNIT_COMMENTS)
        return tubes + toml_text("", [(f"[{name}]", plain[name]) for name in ("limits", "tolerances")], {})

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Robot:
        """Build a robot from what :meth:`to_dict` or a robot file holds.

        Parameters
        ----------
        data : dict
            A list of tables ``tubes``, and optionally ``limits``, ``tolerances`` and a ``name``, which is ignored.

        Returns
        -------
        Robot
            The robot that it describes.

        Raises
        ------
        RobotError
            A key is unknown or missing, or the values describe no robot.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> robot = ctr.table_i_robot()
        >>> ctr.Robot.from_dict(robot.to_dict()) == robot
        True
        """
        if not isinstance(data, dict):
            raise RobotError(f"a robot is {data!r}; it must be a table with the keys {', '.join(ROBOT_FILE_KEYS)}")
        check_keys(RobotError, "a robot", data, ROBOT_FILE_KEYS)
        tubes = data.get("tubes")
        if not isinstance(tubes, list | tuple) or not all(isinstance(t, dict) for t in tubes):
            raise RobotError("a robot needs a list of tubes, [[tubes]] in TOML")
        return cls(
            tuple(_tube_from_table(number, tube) for number, tube in enumerate(tubes, start=1)),
            build_from_table(Limits, data.get("limits", {})),
            build_from_table(Tolerances, data.get("tolerances", {})),
        )

    @classmethod
    def from_toml(cls, path: str | Path) -> Robot:
        """Read a robot from a TOML file.

        Parameters
        ----------
        path : str or Path
            The file; ``ctr-nlp new robot FILE.toml`` writes one in which every entry is explained.

        Returns
        -------
        Robot
            The robot that it describes.

        Raises
        ------
        RobotError
            The file cannot be read or does not describe a robot.
        """
        try:
            return cls.from_dict(read_toml(path))
        except RobotError as error:
            raise RobotError(f"robot file {path}: {name_other_kind(path, ROBOT_FILE) or error}") from error


def mm_per_unit(d: int) -> Array:
    """Return the weights W of the motion term, eq. (9), for d tubes.

    Parameters
    ----------
    d : int
        Number of tubes.

    Returns
    -------
    ndarray
        (2d + 2,): MM_PER_RAD mm/rad for angles and 1 for beta, so that all steps are lengths in mm.
    """
    return np.concatenate([np.full(d, MM_PER_RAD), np.ones(d), np.full(2, MM_PER_RAD)])


def configuration(name: str, q: Any) -> Array:
    """Return one or several configurations as an array of floats.

    Parameters
    ----------
    name : str
        What messages call them.
    q : Any
        Numbers in rad and mm, of any shape.

    Returns
    -------
    ndarray
        The same numbers.

    Raises
    ------
    RobotError
        Some of them are no numbers.
    """
    try:
        return plain_floats(q)
    except (TypeError, ValueError, OverflowError) as error:
        raise RobotError(f"{name} is {q!r:.80}; it must be numbers, in rad and mm") from error


def _tube_from_table(number: int, data: dict[str, Any]) -> Tube:
    """Return the tube that a table of a file describes; messages call it by its number, from 1."""
    try:
        tube: Tube = build_from_table(Tube, data)
    except RobotError as error:
        raise RobotError(f"tubes, number {number}: {error}") from error
    return tube
