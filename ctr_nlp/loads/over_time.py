"""Loads that change while a robot moves, and files that hold one load or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import CtrError, LoadError
from ctr_nlp.loads.load import BETWEEN, Load
from ctr_nlp.robot import Robot
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import floats, instance, read_toml
from ctr_nlp.typing import Array

KEY, AT = "over_time", "at"
"""The list of loads in a file or a plan, and when each of them acts."""


@packable("load over time")
@dataclass(frozen=True)
class LoadOverTime:
    """Loads that a robot bears one after the other during a motion, changing linearly from each to the next.

    loads: (n,) of Load. at: (n,) when each of them acts, as parts of the motion: 0 is its first frame, 1 its last
    one. Forces along the body must act between the same places in all loads that have one. Raises LoadError.
    """

    loads: Sequence[Load]
    at: Any

    def __post_init__(self) -> None:
        object.__setattr__(self, "loads", tuple(self.loads))
        for number, load in enumerate(self.loads, start=1):
            instance(LoadError, f"load {number} of a load over time", load, Load)
        times = floats(LoadError, f"{AT} of a load over time", self.at, (len(self.loads),))
        object.__setattr__(self, AT, tuple(times.tolist()))
        if len(times) < 2 or times[0] != 0 or times[-1] != 1 or not (np.diff(times) > 0).all():
            raise LoadError(
                f"{AT} of a load over time is {list(self.at)}; it must be two or more parts of the motion that "
                "rise from 0, its first frame, to 1, its last one"
            )
        if len({load.between for load in self.loads if load.distributed}) > 1:
            raise LoadError("between of the loads of a load over time differs; it must be the same places for all")

    @property
    def conservative(self) -> bool:
        """As Load.conservative, at every time."""
        return all(load.conservative for load in self.loads)

    @property
    def follows(self) -> bool:
        """As Load.follows, at some time."""
        return any(load.follows for load in self.loads)

    @property
    def bends(self) -> bool:
        """As Load.bends, at some time."""
        return any(load.bends for load in self.loads)

    @property
    def distributed(self) -> bool:
        """As Load.distributed, at some time."""
        return any(load.distributed for load in self.loads)

    @property
    def weighs(self) -> bool:
        """As Load.weighs, at some time."""
        return any(load.weighs for load in self.loads)

    def check(self, robot: Robot) -> None:
        """As Load.check."""
        for load in self.loads:
            load.check(robot)

    def over(self, d: int, part: Array) -> Array:
        """As Load.over: numbers (n, 17 + 3 d) at parts (n,) of the motion; raises LoadError."""
        known = np.array([load.numbers(d) for load in self.loads])
        for load, row in zip(self.loads, known, strict=True):
            if self.distributed and not load.distributed:
                row[BETWEEN] = next(each.between for each in self.loads if each.distributed)
        return np.stack([np.interp(part, self.at, column) for column in known.T], axis=1)

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and lists for strict JSON."""
        return {KEY: [{AT: at} | load.to_dict() for at, load in zip(self.at, self.loads, strict=True)]}

    def __str__(self) -> str:
        """In words, as tables and verdicts tell it."""
        told = ", ".join(f"{load} at {at:g}" for at, load in zip(self.at, self.loads, strict=True))
        return f"a load over time ({told} of the motion)"


def load_from_dict(data: Any) -> Load | LoadOverTime:
    """The load, constant or over time, that to_dict wrote; raises LoadError."""
    if not isinstance(data, Mapping) or KEY not in data:
        return Load.from_dict(data)
    if len(data) > 1:
        raise LoadError(f"a load has {KEY} and other keys; write these into each table of {KEY}")
    tables = data[KEY]
    if not isinstance(tables, Sequence) or not all(isinstance(table, Mapping) and AT in table for table in tables):
        raise LoadError(f"{KEY} of a load is {tables!r:.60}; it must be tables, each with {AT} and keys of a load")
    loads = [Load.from_dict({key: value for key, value in table.items() if key != AT}) for table in tables]
    return LoadOverTime(loads, [table[AT] for table in tables])


def read_load(path: str | Path) -> Load | LoadOverTime:
    """The load, constant or over time, of a TOML file; raises LoadError."""
    try:
        return load_from_dict(read_toml(path))
    except CtrError as error:
        raise LoadError(f"load file {path}: {error}") from error


def steady(load: Load | LoadOverTime | None, what: str) -> Load:
    """The load, or one that is none; raises LoadError where it changes over time, which something does not know.

    what: the beginning of a sentence about it, such as "a Steerer".
    """
    if isinstance(load, LoadOverTime):
        raise LoadError(f"{what} needs a load that stays the same; this one changes over time")
    return load or Load()
