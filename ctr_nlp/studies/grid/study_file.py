"""A study's file, which names problems, robots and settings, and the cases to which these combine."""

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
from ctr_nlp.loads import with_modulus
from ctr_nlp.problems import NAMES
from ctr_nlp.robot import Robot, table_i_robot
from ctr_nlp.robot.draws import drawn, known_robot
from ctr_nlp.studies.airways import SYNTHETIC
from ctr_nlp.studies.grid.case import Case, content_of
from ctr_nlp.studies.grid.reports import REPORTS
from ctr_nlp.studies.grid.ways import OF_WAYS, check_table, ways
from ctr_nlp.support.values import check_choice, floats, instance, number, read_toml, text, texts, whole_number

KEYS = (
    *("name", "problems", "robots", "youngs_modulus", *OF_WAYS, "ways"),
    *("frames", "walls", "draws", "seed", "report"),
)
OF_PROBLEMS = ("names", "files", "folder", "synthetic", "options")
OF_ROBOTS = ("files", "drawn")
OF_DRAWN = ("of", "count", "seed")
OF_OPTIONS = ("branch", "entry", "target", "reverse", "smoothing", "trim", "insertion", "tilt")
MOST_CASES = 1_000_000
"""Plans of one study; a file that asks for more has a slip of the pen in it."""
OWN = "its own"
"""The name of a problem's own robot."""


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
    def from_dict(cls, told: Mapping[str, Any], folder: Path) -> Study:
        """Make the study that a mapping describes.

        Parameters
        ----------
        told : mapping
            Keys and values of a study's file; see ``examples/study.toml``.
        folder : Path
            Folder to which names of files are relative.

        Returns
        -------
        Study
            Every combination of problems, robots, models, methods, loads and settings. Of Monte Carlo samples
            every problem has a seed of its own.

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
        check_table(told, KEYS, "a study")
        problems = tuple(_problems(told.get("problems", {}), folder))
        robots, every_way = tuple(_robots(told.get("robots", {}), folder)), tuple(ways(told, folder))
        name = text(OptionError, "name of a study", told.get("name", "study"))
        draws, seed = (
            whole_number(OptionError, f"{key} of a study", told.get(key, 0), 0) for key in ("draws", "seed")
        )
        frames = whole_number(OptionError, "frames of a study", told.get("frames", 100), 1)
        walled, report, modulus = told.get("walls", True), told.get("report"), told.get("youngs_modulus")
        if modulus is not None:
            with_modulus(table_i_robot(), modulus)  # a number that is none is refused here, not in every row
        instance(OptionError, "walls of a study", walled, bool)
        if report is not None:
            check_choice("report of a study", report, REPORTS)
        options = _options(told.get("problems", {}).get("options", {}))
        count = len(problems) * len(robots) * len(every_way)
        if count > MOST_CASES:
            raise OptionError(f"study {name!r} has {count} cases; it must have at most {MOST_CASES}")
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
                way.measures,
                way.load_name,
                way.load,
                modulus,
            )
            for (place, (problem, content)), (robot_name, robot), way in itertools.product(
                enumerate(problems), robots, every_way
            )
        )
        return cls(name, tuple(cases), report)


def _problems(told: Any, folder: Path) -> Iterator[tuple[str, str]]:
    """Problems of the table [problems], each with the digest of its file, which is empty where it has none."""
    check_table(told, OF_PROBLEMS, "problems of a study")
    for name in texts(OptionError, "names of problems of a study", told.get("names", [])):
        check_choice("a problem of a study", name, NAMES)
        yield name, ""
    files = [folder / name for name in texts(OptionError, "files of problems of a study", told.get("files", []))]
    if "folder" in told:
        files += centrelines_in(folder / text(OptionError, "folder of problems of a study", told["folder"]))
    for path in files:
        yield str(path), content_of(str(path))
    for airway in range(_count("synthetic of problems of a study", told.get("synthetic", 0), 0)):
        yield f"{SYNTHETIC}{airway}", ""


def _options(told: Any) -> tuple[tuple[str, Any], ...]:
    """How files become problems: options of problem_from_file, in the order of their names."""
    check_table(told, OF_OPTIONS, "options of problems of a study")
    if told.get("trim") is not None:
        check_choice("trim of options of problems of a study", told["trim"], ("start", "end"))
    for name in ("smoothing", "tilt"):
        if name in told:
            number(
                OptionError, f"{name} of options of problems of a study", told[name], math.isfinite, "be finite"
            )
    for name in ("entry", "target", "insertion"):
        if name in told:
            floats(OptionError, f"{name} of options of problems of a study", told[name], (3,))
    if "reverse" in told:
        instance(OptionError, "reverse of options of problems of a study", told["reverse"], bool)
    if "branch" in told:
        instance(OptionError, "branch of options of problems of a study", told["branch"], str, int)
    return tuple(sorted(told.items()))


def _count(name: str, value: Any, least: int) -> int:
    """A number of things that are gone through one by one; raises OptionError."""
    if (count := whole_number(OptionError, name, value, least)) > MOST_CASES:
        raise OptionError(f"{name} is {count}; it must be at most {MOST_CASES}")
    return count


def _robots(told: Any, folder: Path) -> Iterator[tuple[str, str | None]]:
    """Names and JSON of the robots of the table [robots]; the problems' own robots where there is none."""
    check_table(told, OF_ROBOTS, "robots of a study")
    if not told:
        yield OWN, None
    for name in texts(OptionError, "files of robots of a study", told.get("files", [])):
        yield Path(name).stem, _as_json(Robot.from_toml(folder / name))
    if "drawn" in told:
        asked = told["drawn"]
        check_table(asked, OF_DRAWN, "drawn robots of a study")
        if not {"of", "count"} <= asked.keys():
            raise OptionError("drawn robots of a study need of, a robot file, and count")
        of = text(OptionError, "of of drawn robots", asked["of"])
        base = Robot.from_toml(folder / of)
        count = _count("count of drawn robots", asked["count"], 1)
        seed = whole_number(OptionError, "seed of drawn robots", asked.get("seed", 0), 0)
        # Each robot is built as drawn, and as uncertain as the one that it is drawn from.
        none = np.zeros((5 * base.d, 5 * base.d))
        for draw, parts in enumerate(drawn(base, count, seed).parts):
            robot = known_robot(base, parts, none, 0.0)
            yield f"{Path(of).stem} {draw}", _as_json(replace(robot, tolerances=base.tolerances))


def _as_json(robot: Robot) -> str:
    """Write a robot as JSON with sorted keys, so that equal robots have equal text."""
    return json.dumps(robot.to_dict(), sort_keys=True)
