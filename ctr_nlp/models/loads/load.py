"""A load: forces and moments at a robot's tip, a force along its body, and the weight of its tubes.

:meth:`Load.numbers` writes it as one row of 17 + 3d numbers, the only form in which models take it:

    0:3    force at the tip, base directions, N          9:12   moment at the tip, tool directions, N mm
    3:6    force at the tip, tool directions, N         12:15   force along the body, base directions, N/mm
    6:9    moment at the tip, base directions, N mm     15:17   arc lengths where that begins and ends, mm
    17:    weight per volume of every tube's material, base directions, N/mm^3, three numbers a tube
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ctr_nlp.exceptions import LoadError
from ctr_nlp.models.loads.modulus import check_moduli
from ctr_nlp.robot import Robot
from ctr_nlp.robot.units import between, did_you_mean
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import check_keys, floats, number, strict_json, to_nested_tuples
from ctr_nlp.typing import Array

LOAD_AXES = "base", "tool"
"""Frames in which a force and a moment at the tip may be given: the robot's base, or its tip."""
MAX_LOAD_FORCE_N, MAX_LOAD_MOMENT_N_MM, MAX_LOAD_FORCE_N_PER_MM = 100.0, 1000.0, 10.0
"""Largest tip force, N, moment, N mm, and force per length, N/mm: some hundred times what robots can carry."""
TUBE_DENSITY_RANGE_G_PER_CM3 = (0.5, 25.0)
"""Least and largest density of a tube, g/cm^3, from light polymers to beyond platinum."""
GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s^2."""
PER_MM3 = 1e-6
"""One g/cm^3 in kg/mm^3."""
FORCE_RANGE_COLUMNS = slice(15, 17)
"""Where a load's numbers have the arc lengths, mm, between which a force acts along the body."""
FIRST_WEIGHT_COLUMN = 17
"""How many numbers of a load come before the weights of the tubes' materials, which are three a tube."""


@packable("load")
@dataclass(frozen=True)
class Load:
    """A load that acts on a robot all the time.

    Lists and arrays are kept as tuples, so that loads are equal where their values are.

    A force that turns with the tool has no energy, nor has any moment, be it one that keeps its direction in
    space: under these a robot has shapes and can snap, but has no stability margin (Ziegler, Principles of
    Structural Stability, 1968).

    Parameters
    ----------
    force : (3,) sequence
        Force at the tip, N, at most 100 N.
    axes : str
        Directions in which `force` and `moment` are given: ``"base"``, those of the base frame, or ``"tool"``,
        which turn with the tip: z along the tip, x where the pre-curvature of the innermost tube bends it.
    axial_moment : float
        Moment about the tip's direction, which twists the innermost tube, N mm.
    densities : float or (d,) sequence, optional
        Densities of the tubes' materials, g/cm^3: one for all, or one a tube, outermost first. Nitinol has 6.45.
        By default tubes weigh nothing.
    down : (3,) sequence, optional
        Direction of gravity in the base frame, of any length; given exactly where `densities` are.
    distributed_force : (3,) sequence, optional
        Force per length along the body in the directions of the base frame, N/mm, at most 10 N/mm.
    between : (2,) sequence, optional
        Arc lengths from the opening between which `distributed_force` acts, mm; given exactly where it is. On a
        robot that ends before the second one, the force acts up to the tip.
    moment : (3,) sequence
        Moment at the tip in the directions of `axes`, N mm, at most 1000 N mm.

    Raises
    ------
    LoadError
        A value is no number, of the wrong shape, out of its range, or given without the one that belongs to it.

    Examples
    --------
    >>> load = Load(force=(0.0, 0.1, 0.0), densities=6.45, down=(0, 0, -1))
    >>> print(load)
    a tip force of (0, 0.1, 0) N and its weight
    >>> load.conservative, Load(force=(0.0, 0.1, 0.0), axes="tool").conservative
    (True, False)
    """

    force: Any = (0.0, 0.0, 0.0)
    axes: str = "base"
    axial_moment: float = 0.0
    densities: Any = None
    down: Any = None
    distributed_force: Any = None
    between: Any = None
    moment: Any = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # The dataclass is frozen: its own fields can be normalised only this way.
        for f in fields(self):
            object.__setattr__(self, f.name, to_nested_tuples(getattr(self, f.name)))
        if self.axes not in LOAD_AXES:
            raise LoadError(f"axes of a load are {self.axes!r}; they must be {' or '.join(LOAD_AXES)}")
        vector = floats(LoadError, "force of a load", self.force, (3,))
        _check_size("force of a load", math.hypot(*vector), MAX_LOAD_FORCE_N, ("N", "mN", "µN", "nN"))
        axial = number(LoadError, "axial_moment of a load", self.axial_moment, math.isfinite, "be finite", " N mm")
        moment = floats(LoadError, "moment of a load", self.moment, (3,))
        for name, size in ("axial_moment", axial), ("moment", math.hypot(*moment)):
            _check_size(f"{name} of a load", size, MAX_LOAD_MOMENT_N_MM, ("N mm", "mN mm", "µN mm", "nN mm"))
        object.__setattr__(self, "force", tuple(vector.tolist()))
        object.__setattr__(self, "moment", tuple(moment.tolist()))
        self._check_distributed()
        self._check_gravity()

    def _check_distributed(self) -> None:
        """Raise LoadError unless distributed_force and between are both given and sound, or neither is."""
        if (self.distributed_force is None) != (self.between is None):
            given, missing = ("between", "distributed_force")[:: 1 if self.between is not None else -1]
            raise LoadError(f"{given} of a load needs {missing}; a force along the body needs both")
        if self.distributed_force is None:
            return
        vector = floats(LoadError, "distributed_force of a load", self.distributed_force, (3,))
        size = math.hypot(*vector)
        _check_size("distributed_force of a load", size, MAX_LOAD_FORCE_N_PER_MM, ("N/mm", "N/m"))
        begin, end = floats(LoadError, "between of a load", self.between, (2,)).tolist()
        if not 0 <= begin < end:
            raise LoadError(
                f"between of a load is [{begin:g}, {end:g}] mm; it must be two places from the opening on, the "
                "first before the second"
            )

    def _check_gravity(self) -> None:
        """Raise LoadError unless densities and down are both given and sound, or neither is."""
        if (self.densities is None) != (self.down is None):
            given, missing = ("down", "densities") if self.densities is None else ("densities", "down")
            raise LoadError(f"{given} of a load needs {missing}; gravity needs both")
        if self.densities is None:
            return
        down = floats(LoadError, "down of a load", self.down, (3,))
        if not math.hypot(*down) > 0:
            raise LoadError(f"down of a load is {self.down}; it must be a direction, not zero")
        # How many densities there must be is known only where a robot is: numbers() looks.
        several = isinstance(self.densities, tuple)
        low, high = TUBE_DENSITY_RANGE_G_PER_CM3
        for each in self.densities if several else (self.densities,):
            meant = (
                [f"{each / 1e3:g} g/cm³ ({each:g} kg/m³)"]
                if _plausible(each, 1e-3, TUBE_DENSITY_RANGE_G_PER_CM3)
                else []
            )
            allowed = f"lie in [{low:g}, {high:g}] g/cm³{did_you_mean(meant)}"
            number(LoadError, "densities of a load", each, between(low, high), allowed, " g/cm³")

    @property
    def conservative(self) -> bool:
        """Whether the load has an energy, and so the loaded robot a stability margin."""
        return not (self.axial_moment or self.has_tip_moment or self.has_follower_force)

    @property
    def has_follower_force(self) -> bool:
        """Whether a force acts at the tip that turns with the tool."""
        return self.axes == "tool" and any(self.force)

    @property
    def has_tip_moment(self) -> bool:
        """Whether a moment acts at the tip that need not be about its direction."""
        return any(self.moment)

    @property
    def has_distributed_force(self) -> bool:
        """Whether a force acts along the body, apart from the tubes' weight."""
        return self.distributed_force is not None and any(self.distributed_force)

    @property
    def has_weight(self) -> bool:
        """Whether the tubes have a weight."""
        return self.densities is not None

    def check(self, robot: Robot) -> None:
        """Check that the load fits a robot.

        Parameters
        ----------
        robot : Robot
            The robot.

        Raises
        ------
        LoadError
            A tube's Young's modulus is not in MPa (:func:`ctr_nlp.models.loads.with_modulus` gives it one), or
            there are densities of another number of tubes.
        """
        check_moduli(robot)
        self.numbers(robot.d)

    def numbers(self, d: int) -> Array:
        """Write the load as the row of numbers that models take as parameters.

        Parameters
        ----------
        d : int
            Number of the robot's tubes.

        Returns
        -------
        (17 + 3d,) array
            In this order: the tip force in base directions and the one in tool directions, N; the tip moments
            likewise, N mm; the distributed force, N/mm; the two arc lengths between which it acts, mm; and for
            each tube the weight per volume of its material as a vector, N/mm^3. All are 0 where nothing acts.

        Raises
        ------
        LoadError
            There are densities of another number of tubes.

        Examples
        --------
        >>> Load(force=(0.0, 0.1, 0.0)).numbers(3).shape
        (26,)
        >>> weighing = Load(densities=6.45, down=(0, 0, -1)).numbers(1)
        >>> f"{weighing[-1]:.3g} N/mm^3"
        '-6.33e-05 N/mm^3'
        """
        # Forces and moments, each in base and in tool directions: those that are not given are 0. A load over time
        # may change from one directions to the other, and then both count for a while.
        at_tip = np.zeros((2, len(LOAD_AXES), 3))
        at_tip[:, LOAD_AXES.index(self.axes)] = self.force, self.moment
        # The moment about the tip's direction is one about z of the tool, whatever `axes` says of the others.
        at_tip[1, LOAD_AXES.index("tool"), 2] += self.axial_moment
        along = (*self.distributed_force, *self.between) if self.has_distributed_force else np.zeros(5)
        return np.array([*at_tip.flat, *along, *self._weights(d).flat])

    def numbers_at(self, d: int, motion_fractions: Array) -> Array:
        """Return the load's numbers at several times of a motion; they are the same at all.

        Parameters
        ----------
        d : int
            Number of the robot's tubes.
        motion_fractions : (n,) array
            Times as parts of the motion, from 0, its first frame, to 1, its last one. Only their number counts
            here; a load over time differs from one to the next.

        Returns
        -------
        (n, 17 + 3d) array
            Rows of :meth:`numbers`.

        Raises
        ------
        LoadError
            There are densities of another number of tubes.
        """
        # A row for each time all the same, so that callers need not know which kind of load they have.
        return np.repeat(self.numbers(d)[None], len(motion_fractions), axis=0)

    def _weights(self, d: int) -> Array:
        """Weights per volume of the materials of d tubes as vectors in the base frame, (d, 3) N/mm^3."""
        if self.densities is None:
            return np.zeros((d, 3))
        if isinstance(self.densities, tuple) and len(self.densities) != d:
            raise LoadError(
                f"densities of a load has {len(self.densities)} numbers; it must be one, or one for each of the "
                f"robot's {d} tubes"
            )
        # g/cm^3 times m/s^2 is 1e-6 N/mm^3. Models multiply by the area of a tube's cross-section, which a design
        # may change, and get a force per length.
        down = np.array(self.down, dtype=float)
        return np.outer(np.broadcast_to(self.densities, d) * PER_MM3 * GRAVITY, down / np.linalg.norm(down))

    def to_dict(self) -> dict[str, Any]:
        """Return the load as a dict of numbers, strings and lists, fit for strict JSON.

        Returns
        -------
        dict
            Fields of the load by name; forces in N, moments in N mm, places in mm.
        """
        plain: dict[str, Any] = strict_json(asdict(self))
        return plain

    @classmethod
    def from_dict(cls, data: Any) -> Load:
        """Make the load that :meth:`to_dict` wrote.

        Parameters
        ----------
        data : dict
            Fields of a load by name; those that are missing have their defaults.

        Returns
        -------
        Load
            The load.

        Raises
        ------
        LoadError
            `data` is no dict, has an unknown key, or describes no load.

        Examples
        --------
        >>> load = Load(force=(0.0, 0.1, 0.0))
        >>> Load.from_dict(load.to_dict()) == load
        True
        """
        allowed = [f.name for f in fields(cls)]
        if not isinstance(data, dict):
            raise LoadError(f"a load is {data!r:.60}; it must be a table with the keys {', '.join(allowed)}")
        check_keys(LoadError, "a load", data, allowed)
        return cls(**data)

    def __str__(self) -> str:
        """Describe the load in words, as tables and verdicts print it."""
        told = []
        tool = " in the tool's axes" * (self.axes == "tool")
        if any(self.force):
            x, y, z = self.force
            told.append(f"a tip force of ({x:g}, {y:g}, {z:g}) N{tool}")
        if self.axial_moment:
            told.append(f"an axial moment of {self.axial_moment:g} N mm")
        if self.has_tip_moment:
            x, y, z = self.moment
            told.append(f"a tip moment of ({x:g}, {y:g}, {z:g}) N mm{tool}")
        if self.has_distributed_force:
            (x, y, z), (begin, end) = self.distributed_force, self.between
            told.append(f"({x:g}, {y:g}, {z:g}) N/mm between {begin:g} and {end:g} mm from the opening")
        if self.densities is not None:
            told.append("its weight")
        return " and ".join(told) or "no load"


def _check_size(name: str, value: float, most: float, units: tuple[str, ...]) -> None:
    """Raise LoadError where a value is larger than any robot of this kind can carry.

    name: of the value in the message; most: the largest size allowed; units: that of the value first, then smaller
    ones, each a thousandth of the one before, of which the message offers those that make the value plausible.
    """
    if abs(value) > most:
        smaller = [(value / 1e3**k, f"{value:g} {unit}") for k, unit in enumerate(units) if k]
        meant = [f"{there:g} {units[0]} ({written})" for there, written in smaller if 1e-3 < abs(there) <= most]
        raise LoadError(
            f"{name} is {value:g} {units[0]}; it must be at most {most:g} {units[0]}{did_you_mean(meant)}"
        )


def _plausible(value: Any, factor: float, allowed: tuple[float, float]) -> bool:
    """Whether a value times a factor is a number between the two ends allowed."""
    return isinstance(value, int | float) and allowed[0] <= factor * value <= allowed[1]
