"""Planner setups of a study: every combination of model, method, load and settings of one or more tables."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, model_with_load
from ctr_nlp.models.loads import Load, LoadOverTime, read_load
from ctr_nlp.ocp import default_model
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.studies.grid.case import NO_LOAD, STUDY_METHODS
from ctr_nlp.studies.grid.measures import MEASURES
from ctr_nlp.support.value_checks import check_choice, check_instance, check_keys, floats, whole_number

SETUP_KEYS = ("models", "methods", "loads", "settings", "sample", "measures")
MAX_SETTINGS_SAMPLES = 100_000
SETTINGS_SAMPLE_KEYS = ("method", "count", "seed", "ranges")
SAMPLERS: Mapping[str, type[qmc.QMCEngine]] = {"sobol": qmc.Sobol, "latin-hypercube": qmc.LatinHypercube}
"""Samplers of settings, by name."""


@dataclass(frozen=True)
class PlannerSetup:
    """Model, method, load and settings of a plan, and its further measures; fields as in Case."""

    model: str
    method: str
    load_name: str
    load: str | None
    settings: tuple[tuple[str, Any], ...]
    measures: tuple[str, ...]


def planner_setups(data: Mapping[str, Any], folder: Path) -> Iterator[PlannerSetup]:
    """Combine the models, methods, loads and settings of a study.

    Parameters
    ----------
    data : mapping
        The study's file. Its tables ``[[ways]]`` are combined each by itself; without any, keys of the study
        itself are taken.
    folder : Path
        Folder to which names of load files are relative.

    Yields
    ------
    PlannerSetup
        One combination after the other.

    Raises
    ------
    LoadError
        A load's file cannot be read or holds no load.
    OptionError
        A key is unknown, a value is out of its range, or a load does not go with a model.
    """
    tables = data.get("ways")
    if tables is None:
        tables = [{name: data[name] for name in SETUP_KEYS if name in data}]
    elif both := sorted(set(SETUP_KEYS) & data.keys()):
        raise OptionError(f"{both[0]} of a study stands beside its tables [[ways]]; write it into each of these")
    check_instance(OptionError, "ways of a study", tables, list)
    for table in tables:
        check_table(table, SETUP_KEYS, "ways of a study")
        measures = tuple(_as_list(table.get("measures", [])))
        for name in measures:
            check_choice("a measure of a study", name, MEASURES)
        loads = [_load(name, folder) for name in _as_list(table.get("loads", [NO_LOAD]))]
        methods = _as_list(table.get("methods", ["horizon"]))
        models = _as_list(table.get("models", [None]))  # None: the default of each method
        for given, method, (name, load), settings in itertools.product(models, methods, loads, _settings(table)):
            model = default_model(method) if given is None else given
            check_choice("a model of a study", model, KINEMATIC_MODELS)
            check_choice("a method of a study", method, STUDY_METHODS)
            if load is not None:
                model_with_load(model, load)  # raises where the model knows no loads, before anything is planned
            written = None if load is None else json.dumps(load.to_dict())
            yield PlannerSetup(model, method, name, written, settings, measures)


def _load(name: Any, folder: Path) -> tuple[str, Load | LoadOverTime | None]:
    """Return the name of a load in tables and the load itself, or None for none."""
    check_instance(OptionError, "a load of a study", name, str)
    if name == NO_LOAD:
        return NO_LOAD, None
    return Path(name).stem, read_load(folder / name)


def check_table(table: Any, allowed: Sequence[str], of: str) -> None:
    """Raise OptionError unless `table` is a mapping whose keys are all allowed; of: its name in the message."""
    if not isinstance(table, Mapping):
        raise OptionError(f"{of} is {table!r:.60}; it must be a table with the keys {', '.join(allowed)}")
    check_keys(OptionError, of, table, allowed)


def _settings(table: Mapping[str, Any]) -> Iterator[tuple[tuple[str, Any], ...]]:
    """Yield every combination of the listed settings of a table, each with every sample of the sampled ones."""
    listed = table.get("settings", {})
    check_table(listed, tuple(Settings.__dataclass_fields__), "settings of a study")
    grid = itertools.product(*([(name, value) for value in _as_list(values)] for name, values in listed.items()))
    for chosen, sampled in itertools.product(grid, _sample_settings(table.get("sample"))):
        if both := {name for name, _ in chosen} & {name for name, _ in sampled}:
            raise OptionError(f"{sorted(both)[0]} of a study is both listed and sampled; leave one out")
        # Sorted, so that the order of keys in a file does not make another case, with another digest.
        found = tuple(sorted((*chosen, *sampled)))
        Settings(**dict(found))  # raises where a value is out of its range, before anything is planned
        yield found


def _sample_settings(table: Any) -> list[tuple[tuple[str, Any], ...]]:
    """Sample settings evenly within the ranges of a table; one empty sample where there is no table."""
    if table is None:
        return [()]
    check_table(table, SETTINGS_SAMPLE_KEYS, "sample of a study")
    ranges = table.get("ranges", {})
    check_table(ranges, tuple(Settings.__dataclass_fields__), "ranges of a sample")
    check_choice("method of a sample", table.get("method", "sobol"), SAMPLERS)
    count = whole_number(OptionError, "count of a sample", table.get("count", 0), 1)
    if count > MAX_SETTINGS_SAMPLES:
        raise OptionError(f"count of a sample is {count}; it must be at most {MAX_SETTINGS_SAMPLES}")
    seed = whole_number(OptionError, "seed of a sample", table.get("seed", 0), 0)
    for name, ends in ranges.items():
        low, high = floats(OptionError, f"range of {name}", ends, (2,))
        if low >= high:
            raise OptionError(f"range of {name} is {ends!r:.40}; it must be two numbers, the least first")
    if not ranges:
        raise OptionError("ranges of a sample are empty; name settings, each with two numbers, the least first")
    engine = SAMPLERS[table.get("method", "sobol")](len(ranges), rng=np.random.default_rng(seed))
    low, high = np.array([ranges[name] for name in ranges], dtype=float).T
    return [tuple(zip(ranges, row, strict=True)) for row in qmc.scale(engine.random(count), low, high).tolist()]


def _as_list(value: Any) -> list[Any]:
    """Return a list as it is, and anything else as the only entry of one."""
    return value if isinstance(value, list) else [value]
