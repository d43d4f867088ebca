"""Planning to every end of a tree for several robots: what :func:`ctr_nlp.reach_tree` does."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ctr_nlp.anatomy.branch import checked_point
from ctr_nlp.anatomy.lumen_tree import LumenTree
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.paths.target import check_frames
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLES
from ctr_nlp.robot import Robot
from ctr_nlp.studies.grid.case import file_digest
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.reach.cases import END_COLUMN, EndCase, TreeSource, bound_cases, end_cases
from ctr_nlp.studies.reach.outcomes import (
    UNPLANNED,
    EndOutcome,
    best_outcome,
    count_outcomes,
    outcome_before_planning,
    outcome_of_plan,
    with_bound,
)
from ctr_nlp.studies.workers.running import DEFAULT_CASE_TIMEOUT_S, StudyCallback, run_study
from ctr_nlp.support.value_checks import check_instance, number, whole_number

REACH_SAMPLE_SEED = 20_550_000
"""Seed of the simulated robots; planning takes others, so that none was seen."""

DEFAULT_BOUND_S = 5.0
"""Processor time of the search for a bound at an end, s."""


@dataclass(frozen=True, eq=False)
class Reach:
    """Which ends of a tree which robots reach.

    Attributes
    ----------
    tree : LumenTree
        The tree.
    robots : tuple of str
        Names of the robots.
    outcomes : tuple of EndOutcome
        One for each end and robot, end by end.
    robust : bool
        Whether plans are for all robots within the tolerances.

    Examples
    --------
    See :func:`reach_tree`.
    """

    tree: LumenTree
    robots: tuple[str, ...]
    outcomes: tuple[EndOutcome, ...]
    robust: bool

    @cached_property
    def by_end(self) -> tuple[tuple[EndOutcome, ...], ...]:
        """The outcomes of each end, a robot each."""
        count = len(self.robots)
        return tuple(self.outcomes[k : k + count] for k in range(0, len(self.outcomes), count))

    @cached_property
    def best(self) -> tuple[EndOutcome, ...]:
        """The best outcome of each end, over all robots."""
        return tuple(map(best_outcome, self.by_end))

    @property
    def complete(self) -> bool:
        """Whether no end is left to be planned."""
        return all(one.outcome != UNPLANNED for one in self.outcomes)

    def counts(self) -> dict[str, dict[str, int]]:
        """Count the ends by outcome, for each robot and, as ``"any"``, for the best of them.

        Returns
        -------
        dict
            For each, ``wide_enough``, ``as_described`` (all checks but that on built robots) and every outcome.
        """
        found = {name: count_outcomes([one for one in self.outcomes if one.robot == name]) for name in self.robots}
        any_robot = count_outcomes(self.best)
        any_robot["as_described"] = sum(any(one.nominal for one in end) for end in self.by_end)
        return found | {"any": any_robot}


def reach_tree(
    path: str | Path,
    robots: Mapping[str, Robot],
    folder: str | Path,
    *,
    entry: npt.ArrayLike | None = None,
    from_carina: bool = False,
    robust: bool = True,
    frames: int = 100,
    samples: int = DEFAULT_PLAN_SAMPLES,
    bound_s: float = DEFAULT_BOUND_S,
    trim: bool = False,
    smoothing: float | None = None,
    options: ReadOptions | None = None,
    pieces: Sequence[str | Path] = (),
    client: Any = None,
    patience: float = DEFAULT_CASE_TIMEOUT_S,
    callback: StudyCallback = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Reach:
    r"""Plan to every end of a tree that is wide enough, for every robot.

    Rows of the plans are kept in `folder` as they come: called again with the same folder, only what is missing is
    planned.

    Parameters
    ----------
    path : str or Path
        A mask of the lumen, or a centreline file with a tree.
    robots : mapping
        Robots by name.
    folder : str or Path
        Where rows are kept.
    entry : (3,) array_like, optional
        Where the robot enters, mm in the file's coordinates; by default where the tree begins.
    from_carina : bool
        Whether the robot is inserted at the main bifurcation, up to which a rigid tube guides it; see
        :func:`ctr_nlp.anatomy.lumen_tree.find_carina`.
    robust : bool
        Whether plans are for all robots within the tolerances; otherwise for the robots as described.
    frames : int
        Number of frames of each plan.
    samples : int
        Number of robots within the tolerances on which each plan is simulated; with 0, no end counts as reached.
    bound_s : float
        Processor time, s, of the search for a lower bound on the miss at each end that a plan does not arrive at,
        or only with too much contact; see :func:`ctr_nlp.planning.miss_bound.bound_miss`. None with 0.
    trim : bool
        Whether the robot's base is moved inwards where a path is longer than the robot reaches; otherwise such an
        end is missed.
    smoothing : float, optional
        How far the followed curves may be from the paths, mm; see :meth:`Curve.smooth`. By default 2 mm in a mask,
        and 0 otherwise.
    options : ReadOptions, optional
        What a person states about the file.
    pieces : sequence of str or Path
        Further files with pieces of the same tree.
    client : distributed.Client, optional
        Of a Dask cluster; None for processes of this machine, as in :func:`run_study`.
    patience : float
        Time limit of a plan, s.
    callback : callable
        Called with the progress, as in :func:`run_study`.
    stop : callable
        Called regularly; after it has returned True nothing more is planned.

    Returns
    -------
    Reach
        The outcome of each end and robot.

    Raises
    ------
    CurveError
        The tree cannot be read, no branch passes the entry, or there is no carina.
    RobotError
        There is no robot.
    OptionError
        An option is out of its range.
    OutputError
        Rows cannot be written, or another program adds rows to the folder.
    ClusterError
        The cluster is lost.

    Examples
    --------
    A straight lumen with a radius of 4 mm, which is too narrow for a robot of 10 mm:

    >>> import tempfile
    >>> import ctr_nlp as ctr
    >>> wide = ctr.Robot((ctr.Tube(90, 50, 1 / 130, outer_diameter=10, inner_diameter=9.6),))
    >>> rows = [f"0,0,{z},4" for z in range(0, 41, 5)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "line.csv")
    ...     _ = file.write_text("\n".join(["x_mm,y_mm,z_mm,radius_mm", *rows]))
    ...     found = reach_tree(file, {"wide": wide}, folder)
    >>> found.outcomes[0].outcome
    'too narrow'
    """
    check_frames(frames)
    whole_number(OptionError, "samples", samples, 0)
    number(OptionError, "bound_s", bound_s, lambda x: 0 <= x < math.inf, "be at least 0 s", " s")
    if not robots:
        raise RobotError("robots are empty; give at least one")
    for name, robot in robots.items():
        check_instance(RobotError, f"robot {name!r}", robot, Robot)
    at = None if entry is None else tuple(checked_point("entry", entry).tolist())
    others = tuple(str(Path(piece).resolve()) for piece in pieces)
    source = TreeSource(str(Path(path).resolve()), at, from_carina, options or ReadOptions(), others)
    tree = source.read()
    before = [
        outcome_before_planning(tree, end, name, robot, trim)
        for end in tree.ends
        for name, robot in robots.items()
    ]
    wanted = [(one.end, one.robot) for one in before if one.outcome == UNPLANNED]
    rows = dict[tuple[int, str], dict[str, Any]]()
    cases: tuple[EndCase, ...] = ()
    if wanted:
        content = "".join(map(file_digest, (source.path, *others)))
        cases = end_cases(
            source,
            hashlib.sha256(content.encode()).hexdigest(),
            wanted,
            robots,
            robust=robust,
            frames=frames,
            samples=samples,
            seed=REACH_SAMPLE_SEED,
            trim=trim,
            smoothing=smoothing,
        )
        run_study(Study("reach", cases), folder, client, patience=patience, callback=callback, stop=stop)
        rows = _rows_of(cases, folder)
    outcomes = [
        outcome_of_plan(one, row) if (row := rows.get((one.end, one.robot))) is not None else one for one in before
    ]
    failed = {(one.end, one.robot) for one in outcomes if one.failed in ("arrives", "within_wall")}
    bounded = [case for case, key in zip(cases, wanted, strict=True) if key in failed]
    if bound_s and bounded and not stop():
        searches = bound_cases(bounded, bound_s)
        run_study(Study("bounds", searches), folder, client, patience=patience, callback=callback, stop=stop)
        bounds = _rows_of(searches, folder)
        outcomes = [with_bound(one, bounds.get((one.end, one.robot))) for one in outcomes]
    return Reach(tree, tuple(robots), tuple(outcomes), robust)


def _rows_of(cases: Sequence[EndCase], folder: str | Path) -> dict[tuple[int, str], dict[str, Any]]:
    """Return the rows of some cases in a folder, by end and robot."""
    found = Results(Path(folder))
    known = {case.digest for case in cases}
    every = found.frame().to_dict("records") if found.read_digests() else []
    return {(int(row[END_COLUMN]), row["robot_name"]): row for row in every if row["digest"] in known}
