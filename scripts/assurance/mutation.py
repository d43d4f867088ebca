"""Change single operators of a module, one at a time, and count how many changes its tests notice.

    python scripts/assurance/mutation.py ctr_nlp/plan/verdicts.py --count 20

Changes ("mutants") are those of cosmic-ray. Each runs in a process of its own, in which the changed module takes
the place of the one on disk; no file is changed. Those of equivalent.toml change nothing that could be noticed,
and are left out. Exit status 1 where fewer than 95 % are noticed, 2 where tests fail without a change.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.abc
import importlib.util
import os
import random
import signal
import sys
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).parent / "equivalent.toml"
WHOLE_CHECKS = "tests/check/test_checker.py", "tests/check/test_plan_faults.py"
TESTS = {
    "ctr_nlp/plan/verdicts.py": ["tests/plan/test_verdicts.py"],
    "ctr_nlp/check": [
        *("tests/check/test_records.py", "tests/check/test_findings.py", "tests/check/test_check_walls.py"),
        *("tests/check/test_equations.py", "tests/check/test_margins.py", *WHOLE_CHECKS),
    ],
}
"""Tests that look at a module or a folder of modules, the fastest first."""
CHANGES = (
    *("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd"),
    *("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "BitAnd_BitOr"),
    *("Lt_GtE", "LtE_Gt", "Gt_LtE", "GtE_Lt", "Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is"),
    *("USub_UAdd", "Delete_Not", "Delete_Invert"),
)
"""Names of cosmic-ray's operators, or their ends: one change of each binary, comparing and unary operator."""
LEAST_NOTICED = 0.95
PRELOADED = "casadi", "numpy", "scipy.ndimage", "scipy.optimize", "scipy.spatial.transform", "pytest"
"""Packages that are imported once, before processes are forked for the mutants."""
TIMEOUT_S = 600
POLL_S = 0.1
"""Between looks at whether tests have ended."""


class Mutant(NamedTuple):
    """A changed module: the operator's name, its line, both versions of that line, and the whole text."""

    operator: str
    line: int
    before: str
    after: str
    text: str


class Replaced(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Import system that gives a module another text.

    Parameters
    ----------
    name : str
        Of the module.
    path : Path
        Its file.
    text : str
        The text that is run instead of the file's.
    """

    def __init__(self, name: str, path: Path, text: str) -> None:
        self._name = name
        self._path = path
        self._text = text

    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> Any:
        """Return how the module is loaded; None for all others."""
        if fullname != self._name:
            return None
        return importlib.util.spec_from_loader(fullname, self, origin=str(self._path))

    def get_source(self, fullname: str) -> str:
        """Return the other text."""
        return self._text

    def get_code(self, fullname: str) -> CodeType:
        """Return the compiled text."""
        return compile(self._text, str(self._path), "exec")


def find_mutants(path: Path, lines: Collection[str] | None = None) -> list[Mutant]:
    """Return the mutants of a file: all, or those of what stands in one of these lines, without their indents."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    text = path.read_text(encoding="utf-8")
    tree = get_ast(text)
    stripped = [line.strip() for line in text.splitlines()]
    names = [name for name in operator_names() if {*name.split("Operator_"), *name.split("/")} & {*CHANGES}]
    found = []
    for name in names:
        operator = get_operator(name)()
        # In the order in which mutate_code counts them. Each of its calls parses the text anew.
        places = [place for node in ast_nodes(tree) for place in operator.mutation_positions(node)]
        for occurrence, ((first, _), (last, _)) in enumerate(places):
            if lines is not None and not set(lines) & set(stripped[first - 1 : last]):
                continue
            changed = mutate_code(text, get_operator(name)(), occurrence)
            pairs = zip(text.splitlines(), changed.splitlines(), strict=False)
            line, (before, after) = next((i, pair) for i, pair in enumerate(pairs, 1) if pair[0] != pair[1])
            found.append(Mutant(name.split("/")[-1], line, before.strip(), after.strip(), changed))
    return found


def read_equivalent(path: Path = EQUIVALENT) -> dict[tuple[str, str, str], str]:
    """Return why changes cannot be noticed, by file and both versions of the line; ValueError without a reason."""
    rows = tomllib.loads(path.read_text(encoding="utf-8")).get("changes", [])
    found = {(row["file"], row["before"], row["after"]): row.get("reason", "") for row in rows}
    for key, reason in found.items():
        if not reason:
            raise ValueError(f"{path.name}: the change {key} has no reason")
    return found


def run_tests(module: str, path: Path, text: str, tests: Sequence[str], timeout: float = TIMEOUT_S) -> int | None:
    """Return pytest's exit status with a text in place of a module's; None where tests take too long."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):
                os.dup2(nothing.fileno(), 1)
                os.dup2(nothing.fileno(), 2)
                sys.meta_path.insert(0, Replaced(module, path, text))
                _forget_imports(module.partition(".")[0])
                import pytest

                options = ["-x", "-q", "--numprocesses", "0", "-p", "no:cacheprovider", "-p", "no:rerunfailures"]
                status = int(pytest.main([*options, "-o", "addopts=", "-m", "not slow", *tests]))
        finally:
            os._exit(status)
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(POLL_S)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _forget_imports(package: str) -> None:
    """Forget what was imported of a package and of the tests.

    Where this runs within the tests, both are there already, and the changed text would never be imported.
    """
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if name.partition(".")[0] == package or (file and Path(file).is_relative_to(ROOT / "tests")):
            del sys.modules[name]


def module_name(file: str) -> str:
    """Return the name of the module in a file of the repository."""
    return file.removesuffix(".py").replace("/", ".")


def tests_of(path: str) -> list[str]:
    """Return the tests that look at a module."""
    return next(tests for part, tests in TESTS.items() if path.startswith(part))


def main(argv: list[str] | None = None) -> int:
    """Run mutants, print those that nobody notices, and return the exit status."""
    parser = argparse.ArgumentParser(description="Count the changes of a module that its tests notice.")
    parser.add_argument("files", metavar="FILE.py", nargs="+", help="files of plan/verdicts or check")
    parser.add_argument("--count", metavar="N", type=int, help="so many mutants, chosen at random (default: all)")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of that choice (default 0)")
    parser.add_argument("--timeout", metavar="S", type=float, default=TIMEOUT_S, help="longest run of tests, s")
    parser.add_argument("--tests", metavar="TEST", nargs="+", help="tests to run instead of those of the module")
    asked = parser.parse_args(argv)
    os.chdir(ROOT)
    for package in PRELOADED:
        importlib.import_module(package)
    same = read_equivalent()
    every = [
        (file, mutant)
        for file in asked.files
        for mutant in find_mutants(ROOT / file)
        if (file, mutant.before, mutant.after) not in same
    ]
    chosen = (
        every if asked.count is None else random.Random(asked.seed).sample(every, min(asked.count, len(every)))
    )
    # Tests that fail anyhow would seem to notice every mutant.
    with_same_tests = {tuple(asked.tests or tests_of(file)): file for file in asked.files}
    for tests, file in with_same_tests.items():
        text = (ROOT / file).read_text(encoding="utf-8")
        if run_tests(module_name(file), ROOT / file, text, tests) != 0:
            print(f"{', '.join(tests)} fail without a change; nothing was counted", file=sys.stderr)
            return 2
    missed = 0
    late = 0
    for done, (file, mutant) in enumerate(chosen):
        print(f"{done} of {len(chosen)} done, {missed} not noticed", file=sys.stderr)
        own = asked.tests or tests_of(file)
        status = run_tests(module_name(file), ROOT / file, mutant.text, own, asked.timeout)
        late += status is None
        if status == 0:
            missed += 1
            print(f"{file}:{mutant.line}: {mutant.operator}\n  - {mutant.before}\n  + {mutant.after}", flush=True)
    noticed = len(chosen) - missed
    slow = f", {late} of them since tests took over {asked.timeout:g} s" if late else ""
    print(f"{noticed} of {len(chosen)} mutants are noticed{slow}; there are {len(every)} in all")
    return 0 if noticed >= LEAST_NOTICED * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
