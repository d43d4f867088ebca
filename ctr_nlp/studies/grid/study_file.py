"""What a study asks for: a file that names problems, robots and settings, and the cases that these combine to."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from ctr_nlp.anatomy.files import centrelines_in
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.models import MODELS
from ctr_nlp.problems import NAMES
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import drawn, known_robot
from ctr_nlp.studies.grid.case import METHODS, SYNTHETIC, Case, content_of
from ctr_nlp.support.values import check_choice, read_toml, whole_number

KEYS = ("name", "problems", "robots", "models", "methods", "frames", "settings", "sample", "draws", "seed")
OF_PROBLEMS = ("names", "files", "folder", "synthetic", "options")
OF_ROBOTS = ("files", "drawn")
OF_DRAWN = ("of", "count", "seed")
OF_SAMPLE = ("method", "count", "seed", "ranges")
SAMPLERS: Mapping[str, type[qmc.QMCEngine]] = {"sobol": qmc.Sobol, "latin-hypercube": qmc.LatinHypercube}
"""How settings may be sampled, by name."""
OWN = "its own"
"""The name of a problem's own robot."""


@dataclass(frozen=True)
class Study:
    """A name, and cases of which no two are alike."""

    name: str
    cases: tuple[Case, ...]

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
        """The study of a file; names of files in it are relative to its folder. Raises OptionError."""
        told = read_toml(path)
        try:
            return cls.from_dict(told, Path(path).resolve().parent)
        except CtrError as error:
            raise OptionError(f"study {path}: {error}") from error

    @classmethod
    def from_dict(cls, told: Mapping[str, Any], folder: Path) -> Study:
        """The study that a mapping describes, as of a file in a folder. Raises CtrError."""
        _check_keys(told, KEYS, "a study")
        problems = tuple(_problems(told.get("problems", {}), folder))
        robots = tuple(_robots(told.get("robots", {}), folder))
        ways = tuple(_ways(told))
        settings = tuple(_settings(told))
        draws, seed = (
            whole_number(OptionError, f"{key} of a study", told.get(key, 0), 0) for key in ("draws", "seed")
        )
        frames = whole_number(OptionError, "frames of a study", told.get("frames", 100), 1)
        options = tuple(sorted(told.get("problems", {}).get("options", {}).items()))
        cases = (
            Case(
                problem,
                content,
                name,
                robot,
                model,
                method,
                frames,
                chosen,
                draws,
                seed,
                options if content else (),
            )
            for (problem, content), (name, robot), (model, method), chosen in itertools.product(
                problems, robots, ways, settings
            )
        )
        return cls(str(told.get("name", "study")), tuple(cases))


def _check_keys(told: Any, allowed: Sequence[str], of: str) -> None:
    if not isinstance(told, Mapping):
        raise OptionError(f"{of} is {told!r:.60}; it must be a table with the keys {', '.join(allowed)}")
    unknown = sorted(set(map(str, told)) - set(allowed))
    if unknown:
        raise OptionError(f"unknown key {unknown[0]!r} of {of}; allowed are {', '.join(allowed)}")


def _problems(told: Any, folder: Path) -> Iterator[tuple[str, str]]:
    """Names, and digests of files."""
    _check_keys(told, OF_PROBLEMS, "problems of a study")
    for name in told.get("names", ()):
        check_choice("a problem of a study", name, NAMES)
        yield name, ""
    files = [folder / name for name in told.get("files", ())]
    if "folder" in told:
        files += centrelines_in(folder / told["folder"])
    for path in files:
        yield str(path), content_of(str(path))
    for number in range(whole_number(OptionError, "synthetic of problems", told.get("synthetic", 0), 0)):
        yield f"{SYNTHETIC}{number}", ""


def _robots(told: Any, folder: Path) -> Iterator[tuple[str, str | None]]:
    """Names, and robots as JSON; the problems' own where none are told."""
    _check_keys(told, OF_ROBOTS, "robots of a study")
    if not told:
        yield OWN, None
    for name in told.get("files", ()):
        yield Path(name).stem, _as_json(Robot.from_toml(folder / name))
    if "drawn" in told:
        asked = told["drawn"]
        _check_keys(asked, OF_DRAWN, "drawn robots of a study")
        if not {"of", "count"} <= asked.keys():
            raise OptionError("drawn robots of a study need of, a robot file, and count")
        base = Robot.from_toml(folder / asked["of"])
        count = whole_number(OptionError, "count of drawn robots", asked["count"], 1)
        none = np.zeros((5 * base.d, 5 * base.d))
        for number, parts in enumerate(drawn(base, count, asked.get("seed", 0)).parts):
            robot = known_robot(base, parts, none, 0.0)
            yield f"{Path(asked['of']).stem} {number}", _as_json(replace(robot, tolerances=base.tolerances))


def _as_json(robot: Robot) -> str:
    return json.dumps(robot.to_dict(), sort_keys=True)


def _ways(told: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Models and methods, each with each."""
    models, methods = told.get("models", ["dominant"]), told.get("methods", ["horizon"])
    for model, method in itertools.product(_listed(models), _listed(methods)):
        check_choice("a model of a study", model, MODELS)
        check_choice("a method of a study", method, METHODS)
        yield model, method


def _settings(told: Mapping[str, Any]) -> Iterator[tuple[tuple[str, Any], ...]]:
    """Every combination of the settings that are listed, each with every sample of those that are sampled."""
    listed = told.get("settings", {})
    _check_keys(listed, tuple(Settings.__dataclass_fields__), "settings of a study")
    grid = itertools.product(*([(name, value) for value in _listed(values)] for name, values in listed.items()))
    for chosen, sampled in itertools.product(grid, _sampled(told.get("sample"))):
        if both := {name for name, _ in chosen} & {name for name, _ in sampled}:
            raise OptionError(f"{sorted(both)[0]} of a study is both listed and sampled; leave one out")
        found = tuple(sorted((*chosen, *sampled)))
        Settings(**dict(found))
        yield found


def _sampled(told: Any) -> list[tuple[tuple[str, Any], ...]]:
    """Settings sampled evenly within their ranges; one empty sample where none are."""
    if told is None:
        return [()]
    _check_keys(told, OF_SAMPLE, "sample of a study")
    ranges = told.get("ranges", {})
    _check_keys(ranges, tuple(Settings.__dataclass_fields__), "ranges of a sample")
    check_choice("method of a sample", told.get("method", "sobol"), SAMPLERS)
    count = whole_number(OptionError, "count of a sample", told.get("count", 0), 1)
    seed = whole_number(OptionError, "seed of a sample", told.get("seed", 0), 0)
    for name, ends in ranges.items():
        if not (isinstance(ends, list) and len(ends) == 2 and ends[0] < ends[1]):
            raise OptionError(f"range of {name} is {ends!r:.40}; it must be two numbers, the least first")
    engine = SAMPLERS[told.get("method", "sobol")](len(ranges), rng=np.random.default_rng(seed))
    low, high = np.array([ranges[name] for name in ranges], dtype=float).T
    return [tuple(zip(ranges, row, strict=True)) for row in qmc.scale(engine.random(count), low, high).tolist()]


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
