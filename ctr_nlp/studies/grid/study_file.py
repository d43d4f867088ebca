"""The study file, which lists problems, robots and settings, and the cases that are their combinations."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.anatomy.files import centrelines_in
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.named_problems import PROBLEM_NAMES
from ctr_nlp.robot import Robot, table_i_robot
from ctr_nlp.robot.samples import build_calibrated_robot, sample_robots
from ctr_nlp.studies.airways import SYNTHETIC
from ctr_nlp.studies.grid.case import Case, file_digest
from ctr_nlp.studies.grid.measures import CHECK_MEASURE
from ctr_nlp.studies.grid.reports import REPORTS
from ctr_nlp.studies.grid.setups import SETUP_KEYS, check_table, planner_setups
from ctr_nlp.support.value_checks import (
    check_choice,
    check_instance,
    floats,
    number,
    read_toml,
    text,
    texts,
    whole_number,
)

STUDY_KEYS = (
    *("name", "problems", "robots", "youngs_modulus", *SETUP_KEYS, "ways"),
    *("frames", "walls", "draws", "seed", "check", "report"),
)
STUDY_PROBLEM_KEYS = ("names", "files", "folder", "synthetic", "options")
STUDY_ROBOT_KEYS = ("files", "drawn")
STUDY_SAMPLED_ROBOT_KEYS = ("of", "count", "seed")
STUDY_FILE_OPTION_KEYS = ("branch", "entry", "target", "reverse", "smoothing", "trim", "insertion", "tilt")
MAX_STUDY_CASES = 1_000_000
"""Largest number of plans of a study; a file that asks for more most likely has a typing error."""
OWN_ROBOT_NAME = "its own"
"""Name in tables of the robot that a problem brings with it."""


@dataclass(frozen=True)
class Study:
    """A study of many plans: its name and its cases.

    Parameters
    ----------
    name : str
        Name of its output folder.
    cases : tuple of Case
        At least one, and no two alike.
    report : str, optional
        Page that the study ends with, of ``studies.grid.reports.REPORTS``.

    Raises
    ------
    OptionError
        There are no cases, or one of them is there twice.
    """

    name: str
    cases: tuple[Case, ...]
    report: str | None = None

    def __post_init__(self) -> None:
        if not self.cases:
            raise OptionError(f"study {self.name!r} has no cases; name problems in [problems]")
        known = {case.digest for case in self.cases}
        if len(known) < len(self.cases):
            raise OptionError(
                f"study {self.name!r} names {len(self.cases) - len(known)} cases twice; name each once"
            )

    def __len__(self) -> int:
        return len(self.cases)

    @classmethod
    def from_toml(cls, path: str | Path) -> Study:
        """Read a study from a TOML file.

        Parameters
        ----------
        path : str or Path
            The file; names of files in it are relative to its folder. ``examples/study.toml`` explains every key.

        Returns
        -------
        Study
            Every combination of what the file lists.

        Raises
        ------
        OptionError
            The file cannot be read, or does not describe a study; the message names the file.
        """
        try:
            return cls.from_dict(read_toml(path), Path(path).resolve().parent)
        except CtrError as error:
            raise OptionError(f"study {path}: {error}") from error

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], folder: Path) -> Study:
        """Make the study that a mapping describes.

        Parameters
        ----------
        data : mapping
            Keys and values of a study's file; see ``examples/study.toml``.
        folder : Path
            Folder to which names of files are relative.

        Returns
        -------
        Study
            Every combination of problems, robots, models, methods, loads and settings. Every problem has its own
            seed of Monte Carlo samples.

        Raises
        ------
        CtrError
            A key is unknown, or a value is out of its range.

        Examples
        --------
        >>> described = {"problems": {"names": ["arc", "cos"]}, "methods": ["joint", "horizon"], "frames": 5}
        >>> study = Study.from_dict(described, Path("."))
        >>> [(case.problem, case.method) for case in study.cases]
        [('arc', 'joint'), ('arc', 'horizon'), ('cos', 'joint'), ('cos', 'horizon')]
        """
        check_table(data, STUDY_KEYS, "a study")
        problems = tuple(_problems(data.get("problems", {}), folder))
        robots = tuple(_robots(data.get("robots", {}), folder))
        every_way = tuple(planner_setups(data, folder))
        name = text(OptionError, "name of a study", data.get("name", "study"))
        draws, seed = (
            whole_number(OptionError, f"{key} of a study", data.get(key, 0), 0) for key in ("draws", "seed")
        )
        frames = whole_number(OptionError, "frames of a study", data.get("frames", 100), 1)
        walled = data.get("walls", True)
        report = data.get("report")
        modulus = data.get("youngs_modulus")
        if modulus is not None:
            with_modulus(table_i_robot(), modulus)  # a number that is none is refused here, not in every row
        check_instance(OptionError, "walls of a study", walled, bool)
        checked = data.get("check", False)
        check_instance(OptionError, "check of a study", checked, bool)
        if report is not None:
            check_choice("report of a study", report, REPORTS)
        options = _options(data.get("problems", {}).get("options", {}))
        count = len(problems) * len(robots) * len(every_way)
        if count > MAX_STUDY_CASES:
            raise OptionError(f"study {name!r} has {count} cases; it must have at most {MAX_STUDY_CASES}")
        # seed + place: all plans of a problem meet the same sampled robots, and problems have independent ones.
        # Without samples the seed is 0, since it is part of the digest: a plan is not made again for another seed.
        cases = (
            Case(
                problem,
                content,
                robot_name,
                robot,
                way.model,
                way.method,
                frames,
                way.settings,
                draws,
                seed + place if draws else 0,
                options if content else (),
                walled,
                (*way.measures, *([CHECK_MEASURE] if checked and CHECK_MEASURE not in way.measures else [])),
                way.load_name,
                way.load,
                modulus,
            )
            for (place, (problem, content)), (robot_name, robot), way in itertools.product(
                enumerate(problems), robots, every_way
            )
        )
        return cls(name, tuple(cases), report)


def _problems(table: Any, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the problems of the table [problems], each with the digest of its file, or "" where it has none."""
    check_table(table, STUDY_PROBLEM_KEYS, "problems of a study")
    for name in texts(OptionError, "names of problems of a study", table.get("names", [])):
        check_choice("a problem of a study", name, PROBLEM_NAMES)
        yield name, ""
    files = [folder / name for name in texts(OptionError, "files of problems of a study", table.get("files", []))]
    if "folder" in table:
        files += centrelines_in(folder / text(OptionError, "folder of problems of a study", table["folder"]))
    for path in files:
        yield str(path), file_digest(str(path))
    for airway in range(_count("synthetic of problems of a study", table.get("synthetic", 0), 0)):
        yield f"{SYNTHETIC}{airway}", ""


def _options(table: Any) -> tuple[tuple[str, Any], ...]:
    """Check options of problem_from_file, and return them in the order of their names."""
    check_table(table, STUDY_FILE_OPTION_KEYS, "options of problems of a study")
    if table.get("trim") is not None:
        check_choice("trim of options of problems of a study", table["trim"], ("start", "end"))
    for name in ("smoothing", "tilt"):
        if name in table:
            number(
                OptionError, f"{name} of options of problems of a study", table[name], math.isfinite, "be finite"
            )
    for name in ("entry", "target", "insertion"):
        if name in table:
            floats(OptionError, f"{name} of options of problems of a study", table[name], (3,))
    if "reverse" in table:
        check_instance(OptionError, "reverse of options of problems of a study", table["reverse"], bool)
    if "branch" in table:
        check_instance(OptionError, "branch of options of problems of a study", table["branch"], str, int)
    return tuple(sorted(table.items()))


def _count(name: str, value: Any, least: int) -> int:
    """Return a whole number from `least` to MAX_STUDY_CASES; raises OptionError, in which `name` names it."""
    if (count := whole_number(OptionError, name, value, least)) > MAX_STUDY_CASES:
        raise OptionError(f"{name} is {count}; it must be at most {MAX_STUDY_CASES}")
    return count


def _robots(table: Any, folder: Path) -> Iterator[tuple[str, str | None]]:
    """Yield names and JSON of the robots of the table [robots]; None, the problem's own, where there is none."""
    check_table(table, STUDY_ROBOT_KEYS, "robots of a study")
    if not table:
        yield OWN_ROBOT_NAME, None
    for name in texts(OptionError, "files of robots of a study", table.get("files", [])):
        yield Path(name).stem, _as_json(Robot.from_toml(folder / name))
    if "drawn" in table:
        asked = table["drawn"]
        check_table(asked, STUDY_SAMPLED_ROBOT_KEYS, "drawn robots of a study")
        if not {"of", "count"} <= asked.keys():
            raise OptionError("drawn robots of a study need of, a robot file, and count")
        of = text(OptionError, "of of drawn robots", asked["of"])
        base = Robot.from_toml(folder / of)
        count = _count("count of drawn robots", asked["count"], 1)
        seed = whole_number(OptionError, "seed of drawn robots", asked.get("seed", 0), 0)
        # Each robot is built with its sampled deviations, and has the same tolerances as the one it was sampled
        # from.
        none = np.zeros((5 * base.d, 5 * base.d))
        for draw, parts in enumerate(sample_robots(base, count, seed).deviations):
            robot = build_calibrated_robot(base, parts, none, 0.0)
            yield f"{Path(of).stem} {draw}", _as_json(replace(robot, tolerances=base.tolerances))


def _as_json(robot: Robot) -> str:
    """Write a robot as JSON with sorted keys, so that equal robots have equal text."""
    return json.dumps(robot.to_dict(), sort_keys=True)
