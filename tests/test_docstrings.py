"""Docstrings of the public interface are complete, and their examples run and show what they say."""

from __future__ import annotations

import doctest
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType

import pytest

import ctr_nlp

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "ctr_nlp").rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


def test_some_docstrings_have_examples():
    assert len(MODULES) > 2


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted
    assert not found.failed


def public_functions() -> Iterator[tuple[str, FunctionType]]:
    """Functions that `import ctr_nlp` gives, and the public methods of its classes, by name."""
    for name in sorted(set(ctr_nlp.__all__)):
        given = getattr(ctr_nlp, name)
        held = {f"{name}.{key}": value for key, value in vars(given).items()} if inspect.isclass(given) else {}
        for key, value in ({name: given} | held).items():
            function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if inspect.isfunction(function) and not key.rpartition(".")[2].startswith("_"):
                yield key, function


def missing_sections(function: FunctionType) -> list[str]:
    """Sections of numpydoc that the docstring of a function needs and does not have."""
    text, signature = inspect.getdoc(function) or "", inspect.signature(function)
    needed = {
        "Parameters": bool(signature.parameters.keys() - {"self", "cls"}),
        "Returns": signature.return_annotation not in (None, "None") and "Yields\n------" not in text,
        "Raises": "raise " in inspect.getsource(function),
    }
    return [section for section, wanted in needed.items() if wanted and f"{section}\n------" not in text]


def test_public_functions_say_what_they_take_return_and_raise():
    found = {name: missing_sections(function) for name, function in public_functions()}
    assert len(found) > 100
    assert {name: missing for name, missing in found.items() if missing} == {}


def test_forty_public_names_have_an_example_that_runs():
    documented = {name: getattr(ctr_nlp, name) for name in ctr_nlp.__all__} | dict(public_functions())
    assert sum(">>> " in (inspect.getdoc(each) or "") for each in documented.values()) >= 40
