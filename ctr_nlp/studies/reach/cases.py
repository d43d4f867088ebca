"""Cases of a study that plans to the ends of a tree, which each process reads once."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ctr_nlp.anatomy.lumen_tree import LumenTree, read_lumen_tree
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.exceptions import CtrError
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.miss_bound import bound_miss
from ctr_nlp.robot import Robot
from ctr_nlp.studies.grid.case import CASE_DONE, CASE_FAILED, Case, row_without_plan

END_COLUMN = "end"
"""Column with the number of the end that a plan leads to."""


@dataclass(frozen=True)
class TreeSource:
    """A tree in files, and where the robot enters it.

    Attributes
    ----------
    path : str
        The file.
    entry : tuple of float or None
        Where the robot enters, mm in the file's coordinates.
    from_carina : bool
        Whether the robot is inserted at the main bifurcation.
    options : ReadOptions
        What a person states about the file.
    pieces : tuple of str
        Further files with pieces of the same tree.
    """

    path: str
    entry: tuple[float, float, float] | None = None
    from_carina: bool = False
    options: ReadOptions = AS_THE_FILE_SAYS
    pieces: tuple[str, ...] = ()

    def read(self) -> LumenTree:
        """Return the tree; raise CurveError where it cannot be read."""
        return read_lumen_tree(
            self.path, self.entry, from_carina=self.from_carina, options=self.options, pieces=self.pieces
        )

    def to_json(self) -> str:
        """Return the source as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> TreeSource:
        """Return the source that `to_json` wrote."""
        data = json.loads(text)
        entry = None if data["entry"] is None else tuple(data["entry"])
        reading: dict[str, Any] = data["options"]
        # JSON has no tuples.
        reading |= {name: tuple(value) for name, value in reading.items() if isinstance(value, list)}
        return cls(data["path"], entry, data["from_carina"], ReadOptions(**reading), tuple(data["pieces"]))


@dataclass(frozen=True)
class EndCase(Case):
    """The inputs of one plan to an end of a tree.

    Its options are ``source``, JSON of the TreeSource, ``end``, the number of the end, and arguments of
    :meth:`LumenTree.problem`.
    """

    @property
    def columns(self) -> dict[str, Any]:
        """First columns of the row: those of a case, and the number of the end."""
        return super().columns | {END_COLUMN: dict(self.options)["end"]}

    def _load_source_problem(self) -> Problem:
        """Make the problem of the end, with the case's robot."""
        options = dict(self.options)
        tree = TreeSource.from_json(options.pop("source")).read()
        assert self.robot is not None
        robot = Robot.from_dict(json.loads(self.robot))
        return tree.problem(options.pop("end"), robot, self.frames, **options)


@dataclass(frozen=True)
class BoundCase(EndCase):
    """The inputs of a bound on how near a robot comes to an end; options as of EndCase, and ``time_limit``, s."""

    def row(self, keep: Path | None = None) -> dict[str, Any]:
        """Compute the bound, and describe it, or why there is none, in a row; keep: not used."""
        begin = time.process_time()
        try:
            limit = dict(self.options)["time_limit"]
            found = bound_miss(
                replace(self, options=_without(self.options, "time_limit")).load_problem(), time_limit=limit
            )
        except CtrError as error:
            return row_without_plan(self, CASE_FAILED, str(error), time.process_time() - begin)
        described = {"bound": found.miss, "bound_cells": found.cells, "status": CASE_DONE, "reason": ""}
        return self.columns | described | {"process_s": time.process_time() - begin}


def bound_cases(plans: Sequence[EndCase], time_limit: float) -> tuple[BoundCase, ...]:
    """Make a case of a bound for each of some plans.

    Parameters
    ----------
    plans : sequence of EndCase
        The plans.
    time_limit : float
        Processor time of each search, s.

    Returns
    -------
    tuple of BoundCase
        In the order of the plans.
    """
    return tuple(
        BoundCase(
            plan.problem,
            plan.content,
            plan.robot_name,
            plan.robot,
            plan.model,
            "bound",
            1,
            options=tuple(sorted([*plan.options, ("time_limit", time_limit)])),
        )
        for plan in plans
    )


def _without(options: tuple[tuple[str, Any], ...], name: str) -> tuple[tuple[str, Any], ...]:
    """Return options without that of a name."""
    return tuple(pair for pair in options if pair[0] != name)


def end_cases(
    source: TreeSource,
    content: str,
    ends: Sequence[tuple[int, str]],
    robots: Mapping[str, Robot],
    *,
    robust: bool,
    frames: int,
    samples: int,
    seed: int,
    trim: bool,
    smoothing: float | None,
) -> tuple[EndCase, ...]:
    """Make a case for each of some ends and robots.

    Parameters
    ----------
    source : TreeSource
        The tree.
    content : str
        Digest of its files.
    ends : sequence of (int, str)
        Numbers of the ends, from 1, each with the name of a robot of `robots`.
    robots : mapping
        Robots by name.
    robust : bool
        Whether plans are for all robots within the tolerances.
    frames, samples, seed : int
        Number of frames, of simulated robots, and their seed.
    trim, smoothing : bool, and float or None
        As in :meth:`LumenTree.problem`.

    Returns
    -------
    tuple of EndCase
        In the order of `ends`.
    """
    options = {"source": source.to_json(), "trim": trim, "smoothing": smoothing}
    return tuple(
        EndCase(
            source.path,
            content,
            name,
            json.dumps(robots[name].to_dict(), sort_keys=True),
            "elastic",
            "robust-horizon" if robust else "horizon",
            frames,
            draws=samples,
            seed=seed if samples else 0,
            options=tuple(sorted((options | {"end": end}).items())),
            measures=("binding",),
        )
        for end, name in ends
    )
