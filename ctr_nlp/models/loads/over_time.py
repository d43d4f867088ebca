"""Loads that change while a robot moves, and files that hold one load or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import CtrError, LoadError
from ctr_nlp.models.loads.load import FORCE_RANGE_COLUMNS, Load
from ctr_nlp.robot import Robot
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import check_instance, floats, read_toml
from ctr_nlp.typing import Array

LOADS_OVER_TIME_KEY, LOAD_TIME_KEY = "over_time", "at"
"""Keys of files and plans: the list of loads, and the time of each as a part of the motion."""


@packable("load over time")
@dataclass(frozen=True)
class LoadOverTime:
    """Loads on a robot during a motion, one after the other, changing linearly from each to the next.

    Parameters
    ----------
    loads : (n,) sequence of Load
        The loads, at least two.
    at : (n,) sequence of float
        When each of them acts, as a part of the motion: rising from 0, its first frame, to 1, its last one.

    Raises
    ------
    LoadError
        `loads` are no loads, `at` does not rise from 0 to 1, or forces along the body act between different places
        in different loads: a place where a force ends cannot move.

    Examples
    --------
    >>> load = LoadOverTime([Load(), Load(force=(0.0, 0.2, 0.0))], [0.0, 1.0])
    >>> load.numbers_at(3, np.array([0.0, 0.5, 1.0]))[:, 1].tolist()
    [0.0, 0.1, 0.2]
    """

    loads: Sequence[Load]
    at: Any

    def __post_init__(self) -> None:
        object.__setattr__(self, "loads", tuple(self.loads))
        for number, load in enumerate(self.loads, start=1):
            check_instance(LoadError, f"load {number} of a load over time", load, Load)
        times = floats(LoadError, f"{LOAD_TIME_KEY} of a load over time", self.at, (len(self.loads),))
        object.__setattr__(self, LOAD_TIME_KEY, tuple(times.tolist()))
        if len(times) < 2 or times[0] != 0 or times[-1] != 1 or not (np.diff(times) > 0).all():
            raise LoadError(
                f"{LOAD_TIME_KEY} of a load over time is {list(self.at)}; it must be two or more parts of the "
                f"motion that "
                "rise from 0, its first frame, to 1, its last one"
            )
        if len({load.between for load in self.loads if load.has_distributed_force}) > 1:
            raise LoadError("between of the loads of a load over time differs; it must be the same places for all")

    @property
    def conservative(self) -> bool:
        """Whether the load has an energy at every time, and so the loaded robot a stability margin."""
        # Between two times the load is a mixture of both, which has an energy only if each of them has one.
        return all(load.conservative for load in self.loads)

    @property
    def has_follower_force(self) -> bool:
        """Whether at some time a force acts at the tip that turns with the tool."""
        return any(load.has_follower_force for load in self.loads)

    @property
    def has_tip_moment(self) -> bool:
        """Whether at some time a moment acts at the tip that need not be about its direction."""
        return any(load.has_tip_moment for load in self.loads)

    @property
    def has_distributed_force(self) -> bool:
        """Whether at some time a force acts along the body, apart from the tubes' weight."""
        return any(load.has_distributed_force for load in self.loads)

    @property
    def has_weight(self) -> bool:
        """Whether at some time the tubes have a weight."""
        return any(load.has_weight for load in self.loads)

    def check(self, robot: Robot) -> None:
        """Check that each of the loads fits a robot.

        Parameters
        ----------
        robot : Robot
            The robot.

        Raises
        ------
        LoadError
            A tube's Young's modulus is not in MPa, or there are densities of another number of tubes.
        """
        for load in self.loads:
            load.check(robot)

    def numbers_at(self, d: int, motion_fractions: Array) -> Array:
        """Return the load's numbers at several times of a motion, linear between the times that are given.

        Parameters
        ----------
        d : int
            Number of the robot's tubes.
        motion_fractions : (n,) array
            Times as parts of the motion, from 0, its first frame, to 1, its last one.

        Returns
        -------
        (n, 17 + 3d) array
            Rows in the order of :meth:`Load.numbers`.

        Raises
        ------
        LoadError
            There are densities of another number of tubes.
        """
        known = np.array([load.numbers(d) for load in self.loads])
        for load, row in zip(self.loads, known, strict=True):
            # A load without a force along the body has 0 for the places between which it acts. Interpolated, these
            # would wander along the body while the force grows: it has the places of the other loads.
            if self.has_distributed_force and not load.has_distributed_force:
                row[FORCE_RANGE_COLUMNS] = next(each.between for each in self.loads if each.has_distributed_force)
        # Each number is linear in time by itself: forces grow and turn along straight lines, as the motors' motion
        # does between frames.
        return np.stack([np.interp(motion_fractions, self.at, column) for column in known.T], axis=1)

    def to_dict(self) -> dict[str, Any]:
        """Return the load as a dict of numbers, strings and lists, fit for strict JSON.

        Returns
        -------
        dict
            Times as parts of the motion, and the load at each of them.
        """
        return {
            LOADS_OVER_TIME_KEY: [
                {LOAD_TIME_KEY: at} | load.to_dict() for at, load in zip(self.at, self.loads, strict=True)
            ]
        }

    def __str__(self) -> str:
        """Describe the load in words, as tables and verdicts print it."""
        told = ", ".join(f"{load} at {at:g}" for at, load in zip(self.at, self.loads, strict=True))
        return f"a load over time ({told} of the motion)"


def load_from_dict(data: Any) -> Load | LoadOverTime:
    """Make the load, constant or over time, that ``to_dict`` of it wrote.

    Parameters
    ----------
    data : mapping
        Fields of a :class:`Load` by name; or under the only key ``"over_time"`` a list of such mappings, each with
        the further key ``"at"``, a part of the motion.

    Returns
    -------
    Load or LoadOverTime
        The load.

    Raises
    ------
    LoadError
        `data` describes no load.
    """
    if not isinstance(data, Mapping) or LOADS_OVER_TIME_KEY not in data:
        return Load.from_dict(data)
    # Of two descriptions of one load it would be open which is meant.
    if len(data) > 1:
        raise LoadError(
            f"a load has {LOADS_OVER_TIME_KEY} and other keys; write these into each table of "
            f"{LOADS_OVER_TIME_KEY}"
        )
    tables = data[LOADS_OVER_TIME_KEY]
    if not isinstance(tables, Sequence) or not all(
        isinstance(table, Mapping) and LOAD_TIME_KEY in table for table in tables
    ):
        raise LoadError(
            f"{LOADS_OVER_TIME_KEY} of a load is {tables!r:.60}; it must be tables, each with {LOAD_TIME_KEY} "
            f"and keys of a load"
        )
    loads = [
        Load.from_dict({key: value for key, value in table.items() if key != LOAD_TIME_KEY}) for table in tables
    ]
    return LoadOverTime(loads, [table[LOAD_TIME_KEY] for table in tables])


def read_load(path: str | Path) -> Load | LoadOverTime:
    """Read a load, constant or over time, from a TOML file.

    Parameters
    ----------
    path : str or Path
        A file with the fields of a :class:`Load` as keys, or with tables ``[[over_time]]``, each with such keys
        and ``at``, a part of the motion. ``ctr-nlp new load FILE`` writes one with every key explained.

    Returns
    -------
    Load or LoadOverTime
        The load.

    Raises
    ------
    LoadError
        The file cannot be read, or describes no load; the message names the file.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "load.toml")
    ...     _ = path.write_text("force = [0.0, 0.1, 0.0]")
    ...     print(read_load(path))
    a tip force of (0, 0.1, 0) N
    """
    try:
        return load_from_dict(read_toml(path))
    except CtrError as error:
        raise LoadError(f"load file {path}: {error}") from error


def require_constant_load(load: Load | LoadOverTime | None, what: str) -> Load:
    """Return a load that does not change over time.

    Parameters
    ----------
    load : Load or LoadOverTime, optional
        The load; None stands for none.
    what : str
        What needs such a load, as the beginning of a message: "a Steerer".

    Returns
    -------
    Load
        The load itself, or one that is zero.

    Raises
    ------
    LoadError
        The load changes over time.
    """
    if isinstance(load, LoadOverTime):
        raise LoadError(f"{what} needs a load that stays the same; this one changes over time")
    return load or Load()
