"""Write docs/assurance.md: hazards, what prevents or detects each, and the tests that show it.

    python scripts/assurance/page.py [--check]

Hazards are in hazards.toml; tests name them with `@pytest.mark.hazard`. A hazard without a test, and a test that
names an unknown hazard, are errors. With --check nothing is written: exit status 1 where the page is out of date.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "assurance.md"
HAZARDS = Path(__file__).parent / "hazards.toml"
HEAD = """# Assurance

What could go wrong when a plan is made and played, what prevents or detects it, and the tests that show it. The
page is made from the tests by `scripts/assurance/page.py`. It claims no conformity with any norm, and the software
is not validated for use on patients.
"""


class AssuranceError(Exception):
    """Hazards and tests that do not go together."""


def read_hazards(path: Path = HAZARDS) -> dict[str, str]:
    """Return what prevents or detects each hazard, by its name; raise AssuranceError where one is there twice."""
    rows = tomllib.loads(path.read_text(encoding="utf-8"))["hazards"]
    found = {row["name"]: row["prevented"] for row in rows}
    if len(found) < len(rows):
        raise AssuranceError(f"a hazard of {path.name} has the name of another one")
    return found


def find_tests(folder: Path = ROOT / "tests") -> dict[str, list[str]]:
    """Return the tests that name each hazard, as `file::test`, from the syntax of the files in a folder."""
    found = defaultdict(list)
    for path in sorted(folder.rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if "mark.hazard" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.FunctionDef):
                continue
            for mark in node.decorator_list:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.hazard":
                    for name in mark.args:
                        test = f"{path.relative_to(folder.parent).as_posix()}::{node.name}"
                        found[ast.literal_eval(name)].append(test)
    return dict(found)


def build_page(hazards: dict[str, str], tests: dict[str, list[str]], project: dict[str, Any]) -> str:
    """Return the text of the page; raise AssuranceError for hazards without tests, and for unknown ones.

    hazards: from `read_hazards`. tests: from `find_tests`. project: the table of that name in pyproject.toml.
    """
    untested = [name for name in hazards if not tests.get(name)]
    unknown = [name for name in tests if name not in hazards]
    if untested:
        raise AssuranceError(f"no test shows that these hazards are prevented: {', '.join(untested)}")
    if unknown:
        raise AssuranceError(f"tests name hazards that {HAZARDS.name} does not have: {', '.join(unknown)}")
    lines = [HEAD, "## Hazards", "", "| hazard | what prevents or detects it | tests |", "|---|---|---|"]
    for name, prevented in hazards.items():
        shown = "<br>".join(f"`{test}`" for test in sorted(tests[name]))
        lines.append(f"| {name} | {prevented} | {shown} |")
    lines += ["", "## Dependencies", "", "Versions are those that the package asks for.", ""]
    lines += ["| package | version |", "|---|---|", f"| Python | {project['requires-python']} |"]
    for requirement in sorted(project["dependencies"]):
        wanted, _, only = requirement.partition(";")
        cut = next(i for i, letter in enumerate(wanted) if letter in "<>=~!")
        lines.append(f"| {wanted[:cut]} | {wanted[cut:].strip()}{f' where {only.strip()}' if only else ''} |")
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Write the page, or compare it; return the exit status."""
    parser = argparse.ArgumentParser(description="Write docs/assurance.md from the tests.")
    parser.add_argument("--check", action="store_true", help="compare the page, and write nothing")
    arguments = parser.parse_args(argv)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    try:
        text = build_page(read_hazards(), find_tests(), project)
    except AssuranceError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if arguments.check:
        return 0 if PAGE.exists() and PAGE.read_text(encoding="utf-8") == text else 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
