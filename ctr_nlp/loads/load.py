"""A load: what pulls at a robot's tip, turns it, and weighs on its tubes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import CtrError, LoadError
from ctr_nlp.loads.modulus import check_moduli
from ctr_nlp.robot import Robot
from ctr_nlp.robot.units import between, did_you_mean
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import floats, number, read_toml, strict_json, unchanging
from ctr_nlp.typing import Array

AXES = "base", "tool"
"""In which a tip force may be given."""
FORCE, MOMENT = 100.0, 1000.0
"""Largest tip force, N, and axial moment, N mm: some hundred times what these robots bear."""
DENSITIES = (0.5, 25.0)
"""Least and largest density of a tube, g/cm^3, from light polymers to beyond platinum."""
GRAVITY = 9.80665
"""m/s^2."""
PER_MM3 = 1e-6
"""kg/mm^3 that one g/cm^3 is."""
OF_TIP = 7
"""Numbers of a load that act at the tip; three a tube follow."""


@packable("load")
@dataclass(frozen=True)
class Load:
    """What acts on a robot all the time.

    force: (3,) N at the tip, in the directions of the base frame, or of the tool: z along the tip, x where the
    pre-curvature of the innermost tube bends it. axial_moment: N mm about the tip's direction, which turns the
    innermost tube. densities: of the tubes, g/cm^3, a number or one a tube, outermost first (nitinol has 6.45);
    down: (3,) the direction of gravity in the base frame, of any length, needed where there are densities.
    Lists and arrays are kept as tuples. Raises LoadError.

    A force that turns with the tool, and a moment that turns with the tip, have no energy: robots that bear them
    have shapes and snaps, but no stability margin (Ziegler, Principles of Structural Stability, 1968).
    """

    force: Any = (0.0, 0.0, 0.0)
    axes: str = "base"
    axial_moment: float = 0.0
    densities: Any = None
    down: Any = None

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, unchanging(getattr(self, f.name)))
        if self.axes not in AXES:
            raise LoadError(f"axes of a load are {self.axes!r}; they must be {' or '.join(AXES)}")
        vector = floats(LoadError, "force of a load", self.force, (3,))
        _limited("force of a load", float(np.linalg.norm(vector)), FORCE, ("N", "mN", "µN", "nN"))
        moment = number(
            LoadError, "axial_moment of a load", self.axial_moment, math.isfinite, "be finite", " N mm"
        )
        _limited("axial_moment of a load", moment, MOMENT, ("N mm", "mN mm", "µN mm", "nN mm"))
        object.__setattr__(self, "force", tuple(vector.tolist()))
        self._check_gravity()

    def _check_gravity(self) -> None:
        if (self.densities is None) != (self.down is None):
            given, missing = ("down", "densities") if self.densities is None else ("densities", "down")
            raise LoadError(f"{given} of a load needs {missing}: gravity is told by both")
        if self.densities is None:
            return
        down = floats(LoadError, "down of a load", self.down, (3,))
        if not np.linalg.norm(down) > 0:
            raise LoadError(f"down of a load is {self.down}; it must be a direction, not zero")
        several = isinstance(self.densities, tuple)
        low, high = DENSITIES
        for each in self.densities if several else (self.densities,):
            meant = [f"{each / 1e3:g} g/cm³ ({each:g} kg/m³)"] if _plausible(each, 1e-3, DENSITIES) else []
            allowed = f"lie in [{low:g}, {high:g}] g/cm³{did_you_mean(meant)}"
            number(LoadError, "densities of a load", each, between(low, high), allowed, " g/cm³")

    @property
    def conservative(self) -> bool:
        """Whether the load has an energy, and so a robot that bears it a stability margin."""
        return not self.axial_moment and not self.follows

    @property
    def follows(self) -> bool:
        """Whether a force turns with the tool."""
        return self.axes == "tool" and any(self.force)

    def numbers(self, robot: Robot) -> Array:
        """What models need to know, (7 + 3 d,), linear in the load.

        The force of base axes, that of tool axes, the axial moment, and the weight of every tube, N/mm, as a
        vector. Raises LoadError where a robot cannot be told to bear the load.
        """
        check_moduli(robot)
        return np.concatenate([self._of_tip(), self._weights(robot).ravel()])

    def numbers_apart(self, d: int) -> Array:
        """The same of any robot of d tubes; raises LoadError where their weights count, which are not known."""
        if self.densities is not None:
            raise LoadError("a load with densities weighs on described tubes alone; leave them out for other ones")
        return np.concatenate([self._of_tip(), np.zeros(3 * d)])

    def _of_tip(self) -> Array:
        none = (0.0, 0.0, 0.0)
        in_base, in_tool = (none, self.force) if self.follows else (self.force, none)
        return np.array([*in_base, *in_tool, self.axial_moment])

    def _weights(self, robot: Robot) -> Array:
        """Weight of every tube, (d, 3) N/mm."""
        if self.densities is None:
            return np.zeros((robot.d, 3))
        if isinstance(self.densities, tuple) and len(self.densities) != robot.d:
            raise LoadError(
                f"densities of a load has {len(self.densities)} numbers; it must be one, or one for each of the "
                f"robot's {robot.d} tubes"
            )
        area = [math.pi / 4 * (tube.outer_diameter**2 - tube.inner_diameter**2) for tube in robot.tubes]
        weight = np.array(area) * np.broadcast_to(self.densities, robot.d) * PER_MM3 * GRAVITY
        down = np.array(self.down, dtype=float)
        return np.outer(weight, down / np.linalg.norm(down))

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and lists for strict JSON."""
        plain: dict[str, Any] = strict_json(asdict(self))
        return plain

    @classmethod
    def from_dict(cls, data: Any) -> Load:
        """The load that to_dict wrote; raises LoadError."""
        allowed = [f.name for f in fields(cls)]
        if not isinstance(data, dict):
            raise LoadError(f"a load is {data!r:.60}; it must be a table with the keys {', '.join(allowed)}")
        unknown = sorted(set(map(str, data)) - set(allowed))
        if unknown:
            raise LoadError(f"unknown key {unknown[0]!r} in a load; allowed are {', '.join(allowed)}")
        return cls(**data)

    @classmethod
    def from_toml(cls, path: str | Path) -> Load:
        """The load of a TOML file; raises LoadError where it cannot be read or is not a load."""
        try:
            return cls.from_dict(read_toml(path))
        except CtrError as error:
            raise LoadError(f"load file {path}: {error}") from error

    def __str__(self) -> str:
        """In words, as tables and verdicts tell it."""
        told = []
        if any(self.force):
            x, y, z = self.force
            told.append(f"a tip force of ({x:g}, {y:g}, {z:g}) N" + " in the tool's axes" * self.follows)
        if self.axial_moment:
            told.append(f"an axial moment of {self.axial_moment:g} N mm")
        if self.densities is not None:
            told.append("its weight")
        return " and ".join(told) or "no load"


def _limited(name: str, value: float, most: float, units: tuple[str, ...]) -> None:
    """Raise LoadError where a value is larger than any robot of this kind bears; units: each a thousandth."""
    if abs(value) > most:
        smaller = [(value / 1e3**k, f"{value:g} {unit}") for k, unit in enumerate(units) if k]
        meant = [f"{there:g} {units[0]} ({written})" for there, written in smaller if 1e-3 < abs(there) <= most]
        raise LoadError(
            f"{name} is {value:g} {units[0]}; it must be at most {most:g} {units[0]}{did_you_mean(meant)}"
        )


def _plausible(value: Any, factor: float, allowed: tuple[float, float]) -> bool:
    return isinstance(value, int | float) and allowed[0] <= factor * value <= allowed[1]
