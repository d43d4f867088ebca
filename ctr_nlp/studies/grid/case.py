"""One plan of a study: its inputs, and the row of results that describes it."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from ctr_nlp.anatomy.problem_files import problem_from_file
from ctr_nlp.exceptions import CtrError, OptionError, OutputError
from ctr_nlp.models import model_named, model_with_load
from ctr_nlp.models.loads import load_from_dict, with_modulus
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.named_problems import PROBLEM_NAMES, named_problem
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.metrics import summary, verdict_columns
from ctr_nlp.plan.plan import Plan, versions
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.per_frame import solve_per_frame
from ctr_nlp.robot import Robot
from ctr_nlp.robust import solve_robust, solve_robust_per_frame
from ctr_nlp.studies.airways import SYNTHETIC, synthetic_problem
from ctr_nlp.studies.grid.measures import MEASURES
from ctr_nlp.support.value_checks import strict_json

STUDY_METHODS = "horizon", "joint", "two-stage", "robust-horizon", "robust-joint"
"""Planning methods of a case."""
CASE_DONE, CASE_FAILED, CASE_LATE, CASE_LOST = "done", "failed", "late", "lost"
"""Status of a row: there is a plan, solved or not; planning failed; it took too long; its workers died."""
NO_LOAD = "none"
"""Name in tables of cases without a load."""
TIME_LIMIT_COLUMN = "patience_s"
"""Column of cases that took too long: the time limit that they exceeded, s."""


@dataclass(frozen=True)
class Case:
    """The inputs of one plan of a study; cases can be compared, pickled and written as JSON.

    Attributes
    ----------
    problem : str
        A problem's name, the path of a centreline file, or ``synthetic:SEED``.
    content : str
        Digest of the file; empty for other problems.
    robot_name : str
        Name of the robot in tables.
    robot : str or None
        The robot as JSON of :meth:`Robot.to_dict`; None for the problem's own.
    model : str
        Name of the kinematic model.
    method : str
        How the motion is planned, of STUDY_METHODS.
    frames : int
        Number of frames.
    settings : tuple of (str, value)
        Fields of :class:`Settings` that differ from their defaults.
    draws : int
        Number of Monte Carlo samples of the robot on which the plan is evaluated; 0 for none.
    seed : int
        Seed of these samples.
    options : tuple of (str, value)
        Arguments of :func:`problem_from_file`.
    walled : bool
        Whether the problem keeps its lumen's wall, where it has one.
    measures : tuple of str
        Further figures of the plan beside its summary, of MEASURES.
    load_name : str
        Name of the load in tables.
    load : str or None
        The load as JSON of its ``to_dict``; None for none.
    youngs_modulus : float or None
        Young's modulus, MPa, for a robot that has only ratios of moduli.
    """

    problem: str
    content: str
    robot_name: str
    robot: str | None
    model: str
    method: str
    frames: int
    settings: tuple[tuple[str, Any], ...] = ()
    draws: int = 0
    seed: int = 0
    options: tuple[tuple[str, Any], ...] = ()
    walled: bool = True
    measures: tuple[str, ...] = ()
    load_name: str = NO_LOAD
    load: str | None = None
    youngs_modulus: float | None = None

    @cached_property
    def digest(self) -> str:
        """Digest of all that the row depends on: the case, and the versions of the software that computes it."""
        # Another version of the solver or of numpy may find another plan: its rows are not mixed with these.
        # Sorted keys, since equal cases must have equal text.
        told = json.dumps([asdict(self), versions()], sort_keys=True)
        return hashlib.sha256(told.encode()).hexdigest()[:32]

    @property
    def kind(self) -> tuple[str, ...]:
        """Method, model, frames, and whether there are samples: cases of one kind take about the same time."""
        return self.method, self.model, str(self.frames), str(self.draws > 0)

    @property
    def columns(self) -> dict[str, Any]:
        """First columns of the row: the digest and the inputs of the case."""
        named_so = {f"set_{name}": value for name, value in self.settings}
        own = ("problem", "robot_name", "model", "method", "frames", "draws", "seed")
        found = {"digest": self.digest} | {name: getattr(self, name) for name in own}
        return found | {"load": self.load_name} | named_so

    def load_problem(self) -> Problem:
        """Make the problem, with its robot.

        Returns
        -------
        Problem
            Without a wall where the case has none, and with Young's moduli in MPa where it gives one.

        Raises
        ------
        CtrError
            The problem's file or the robot is none, or they do not go together.
        """
        problem = self._load_source_problem()
        if self.youngs_modulus is not None:
            problem = replace(problem, robot=with_modulus(problem.robot, self.youngs_modulus))
        return problem if self.walled else replace(problem, lumen=None)

    def _load_source_problem(self) -> Problem:
        """Make the problem as its source has it, with the case's robot."""
        robot = None if self.robot is None else Robot.from_dict(json.loads(self.robot))
        if self.problem.startswith(SYNTHETIC):
            problem = synthetic_problem(int(self.problem.removeprefix(SYNTHETIC)), self.frames)
            return problem if robot is None else replace(problem, robot=robot)
        if self.problem in PROBLEM_NAMES:
            return named_problem(self.problem, self.frames, robot=robot)
        return problem_from_file(self.problem, frames=self.frames, robot=robot, **dict(self.options))

    def plan_motion(self, problem: Problem) -> Plan:
        """Plan the motion, and evaluate it on samples of the robot where the case asks for them.

        Parameters
        ----------
        problem : Problem
            The problem of :meth:`load_problem`.

        Returns
        -------
        Plan
            The plan; frames may have failed.

        Raises
        ------
        CtrError
            There is no plan for these options.
        """
        settings = Settings(**dict(self.settings))
        model = model_named(self.model)
        if self.load is not None:
            model = model_with_load(model, load_from_dict(json.loads(self.load)))
        made: dict[str, Callable[[], Plan]] = {
            "horizon": lambda: solve_horizon(problem, model=model, settings=settings),
            "robust-horizon": lambda: solve_robust(problem, model=model, settings=settings),
            "robust-joint": lambda: solve_robust_per_frame(problem, model=model, settings=settings),
        }
        by_frame = partial(solve_per_frame, problem, self.method, model=model, settings=settings)
        plan = made.get(self.method, by_frame)()
        return plan.check(self.draws, self.seed) if self.draws else plan

    def row(self, keep: Path | None = None) -> dict[str, Any]:
        """Plan the motion and describe it, or why there is no plan, in a row.

        Parameters
        ----------
        keep : Path, optional
            Folder into which the plan is written, too.

        Returns
        -------
        dict
            Columns by name. ``status`` is ``"done"`` where there is a plan, solved or not, else ``"failed"``, and
            then ``reason`` says why; ``process_s`` is the time it took the process, s.

        Raises
        ------
        OutputError
            The plan cannot be written.
        """
        begin = time.process_time()
        columns = self.columns
        try:
            problem = self.load_problem()
            plan = self.plan_motion(problem)
            found = _plan_columns(plan) | {"status": CASE_DONE, "reason": ""}
            for name in self.measures:
                found |= MEASURES[name](plan, problem)
        except Exception as error:
            # A study of thousands continues whatever one of them fails with; the row reports it.
            told = str(error) if isinstance(error, CtrError) else f"{type(error).__name__}: {error}"
            return row_without_plan(self, CASE_FAILED, told, time.process_time() - begin)
        if keep is not None:
            self.save_plan(plan, keep)
        # A plan calls its problem by a name of its own; rows of plans and of failures have the same one.
        return columns | found | columns | {"process_s": time.process_time() - begin}

    def save_plan(self, plan: Plan, folder: Path) -> None:
        """Write the plan into a folder, under the case's digest.

        Parameters
        ----------
        plan : Plan
            The plan of this case.
        folder : Path
            The folder, which is made where it is not there.

        Raises
        ------
        OutputError
            The plan cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"a folder of plans cannot be made at {folder}: {error}") from error
        plan.save(self.plan_path(folder))

    def plan_path(self, folder: Path) -> Path:
        """Return the path of the case's plan in a folder."""
        return folder / f"{self.digest}.npz"


def row_without_plan(case: Case, status: str, reason: str, process_s: float) -> dict[str, Any]:
    """Make the row of a case that has no plan.

    Parameters
    ----------
    case : Case
        The case.
    status : str
        CASE_FAILED, CASE_LATE or CASE_LOST.
    reason : str
        Why there is no plan, in a sentence.
    process_s : float
        Time that it took, s.

    Returns
    -------
    dict
        Columns by name.
    """
    return case.columns | {"status": status, "reason": reason, "process_s": process_s}


def file_digest(path: str) -> str:
    """Return the digest of the file at a path; raise OptionError where it cannot be read."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise OptionError(f"problem file {path} cannot be read: {error}") from error


def _plan_columns(plan: Plan) -> dict[str, Any]:
    """Return the summary and the verdicts of a plan as columns, and the versions of what computed them."""
    found = dict(_flatten(strict_json(summary(plan))))
    found |= verdict_columns(plan)
    found["complete"] = plan.complete
    return found | {f"version_{name}": value for name, value in versions().items()}


def _flatten(mapping: Mapping[str, Any], before: str = "") -> list[tuple[str, Any]]:
    """Return pairs of names and values of nested mappings, with names joined by underscores; lists are left out.

    before: prefix of the names.
    """
    found = list[tuple[str, Any]]()
    for name, value in mapping.items():
        if isinstance(value, Mapping):
            found += _flatten(value, f"{before}{name}_")
        elif value is None or isinstance(value, bool | int | float | str):
            found.append((f"{before}{name}", value))
    return found
