"""The documentation is executed: every command and example as written; links, options, files and functions exist.

Commands run, page by page and in order, in a folder that looks like a clone with its environment. In the normal
suite programs that take long get further arguments, those of THIN, last, where they win; `pytest -m slow` runs
them in full.
"""

from __future__ import annotations

import ast
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import redirect_stdout, suppress
from functools import partial
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from pages import Block, Page

from ctr_nlp import Robot, table_i_robot
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.cli import main
from ctr_nlp.cli.main import COMMANDS
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.axis import Axis
from ctr_nlp.hardware.description import Connection, Hardware
from ctr_nlp.support.value_checks import build_from_table, read_toml

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"bash", "python", "toml", "text", "math"}
SCRIPTS = sorted(path.name for path in (ROOT / "scripts").glob("*.py"))
STUDIES = ("compare", "learn", "baselines", "reproduce", "benchmark", "cohort", "contact")
"""Programs in scripts/studies/ that pages name with their options."""
ENVIRONMENT = "python3 -m venv"
"""What commands begin with that make an environment: .ci/run runs these."""
THIN = {
    ("plan * --robust*",): "--robot two.toml --frames 12 --samples 20",
    ("plan *--model dominant*",): "--frames 40 --samples 20",
    ("plan bronchus --start*",): "--frames 24 --samples 20",
    ("plan bronchus --robot*",): "--robot two.toml --frames 12 --samples 20",
    ("plan bronchus*",): "--frames 12 --samples 20",
    ("plan *synthetic_airway*",): "--robot two.toml --frames 40 --stability-margin 0.2 --samples 20",
    ("plan *human_airways*",): "--robot stock_3 --frames 25 --samples 20",
    ("plan *slicer_tree*",): "--nominal --frames 12 --samples 20",
    ("plan *airway*", "steer *airway*"): "--frames 40 --stability-margin 0.2 --samples 20",
    ("plan *", "steer *"): "--frames 40 --samples 20",
    ("force *",): "--every 20 --directions 14",
    ("scripts/studies/compare.py*", "compare *"): "arc bronchus --frames 2 --variants joint:sqp horizon:banded",
    ("scripts/studies/benchmark.py*", "benchmark *"): "--parts rows --rows frame",
    ("design *",): "--nominal --model dominant --frames 3 --starts 1 --robot two.toml",
    ("scripts/studies/reproduce.py*", "reproduce *"): "--only fig10 --frames 3 --jobs 1",
}
"""What command lines look like, as a script or a subcommand -> further arguments; the first that fits is taken."""
JUDGING = (
    *("plan\\ *", "steer\\ *", "robust\\ *", "under\\ *", "import\\ *", "study\\ *", "compare\\ *", "design\\ *"),
    *(
        f"scripts/{name}*"
        for name in ("horizon", "per_frame", "compare", "export", "studies/compare", "studies/reproduce")
    ),
)
"""Patterns of the shell of programs that judge plans: their exit status 1 says that a verdict is no, and the pages
show plans that fail, too."""
INTERPRETED = ("under *",)
"""Command lines whose programs are not compiled: for so few frames, that takes longer than it spares."""

PIP = '''#!{python}
"""Instead of pip, which needs a network: whether what is to be installed could be."""
import re
import sys

from ctr_nlp.support.value_checks import read_toml

*options, wanted = sys.argv[1:]
extras = set(read_toml("pyproject.toml")["project"]["optional-dependencies"])
found = re.fullmatch(r"\\.\\[([a-z0-9,]+)\\]", wanted)
sys.exit(not (options == ["install", "-q", "-e"] and found and set(found[1].split(",")) <= extras))
'''


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _as_shell(line: str) -> str:
    """A pattern of the shell for a command line, which may hold spaces."""
    return line.replace(" ", "\\ ")


def clone_of(folder: Path, thin: bool) -> Path:
    """What programs need, copied, with an environment whose programs are those of this one; thin: as THIN says."""
    for part in ("scripts", "examples", "docs"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "tests" / "emulator", folder / "tests" / "emulator")
    shutil.copy(ROOT / "pyproject.toml", folder)
    (folder / "two.toml").write_text(Robot(table_i_robot().tubes[1:]).to_toml(), encoding="utf-8")
    (folder / ".venv" / "bin").mkdir(parents=True)
    cases = [f'{"|".join(map(_as_shell, lines))}) set -- "$@" {more} ;;' for lines, more in THIN.items() if thin]
    interpreted = "|".join(map(_as_shell, INTERPRETED))
    if thin:
        cases += ["esac", 'case "$* " in', f"{interpreted}) export CTR_NLP_COMPILE=0 ;;"]
    head = "\n".join(["#!/bin/sh", 'case "$* " in', *cases, "esac"])
    forgiven = "{}; status=$?; exit $((status == 1 ? 0 : status))"
    judging = f'case "$* " in {"|".join(JUDGING)}) {forgiven} ;; esac; exec {{}}'
    programs = {
        name: "\n".join([head, judging.format(*[f'"{sys.executable}" {module}"$@"'] * 2), ""])
        for name, module in (("python", ""), ("ctr-nlp", "-m ctr_nlp "))
    }
    for name, text in (programs | {"pip": PIP.format(python=sys.executable)}).items():
        program = folder / ".venv" / "bin" / name
        program.write_text(text)
        program.chmod(0o755)
    return folder


def run(clone: Path, command: list[str], name: str) -> str:
    """What a command prints; it must succeed. What it leaves in the background is ended."""
    output = clone / "output"
    with open(output, "w") as file:
        process = subprocess.Popen(
            command,
            cwd=clone,
            env=os.environ | {"COLUMNS": "120"},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            status = process.wait()
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    printed = output.read_text()
    assert status == 0, f"{name}: exit status {status}\n{command[-1]}\n{printed}"
    return printed


def commands(block: Block) -> str:
    """Those of a block. Where one makes the environment: what is left to do in it, but for running the tests."""
    if not block.text.startswith(ENVIRONMENT):
        return block.text
    last = block.text.split(" && ")[-1]
    return ":" if last.endswith("-m pytest\n") else last


def walk(page: Path, clone: Path) -> None:
    """Run the blocks of a page in order; examples in Python go on where those before them ended."""
    examples, printed = "", ""
    for block in Page.read(page).blocks:
        place = f"{named(page)}, line {block.line}"
        if block.language == "bash":
            printed = run(clone, ["bash", "-euo", "pipefail", "-c", commands(block)], place)
        elif block.language == "python":
            examples += block.text
            printed = run(clone, [".venv/bin/python", "-W", "error", "-c", examples], place)
        elif block.language == "text":
            shown, told = (" ".join(text.replace("─", " ").split()) for text in (block.text, printed))
            assert shown in told, f"{place}: not what is printed:\n{printed}"


RUNNABLE = [page for page in PAGES if {"bash", "python"} & {block.language for block in Page.read(page).blocks}]


def _program(line: str) -> str:
    """How a page calls the program of a line of THIN."""
    name = line.split()[0].rstrip("*")
    return name if "/" in name else f"ctr-nlp {name} "


LONG = [page for page in RUNNABLE if any(_program(line) in page.read_text() for lines in THIN for line in lines)]


@pytest.fixture(scope="module")
def walks(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[Path, Future[None]]]:
    """The pages that are asked for, two at a time: what is played waits more than it works."""
    asked = [item for item in request.session.items if "walks" in getattr(item, "fixturenames", ())]
    pages = [item.callspec.params["page"] for item in asked if isinstance(item, pytest.Function)]
    with ThreadPoolExecutor(2) as pool:
        walking = {
            page: pool.submit(walk, page, clone_of(tmp_path_factory.mktemp(page.stem), thin=True))
            for page in pages
        }
        wait(walking.values())  # nothing is left to work beside tests that need the machine for themselves
        yield walking


@pytest.mark.parametrize("page", RUNNABLE, ids=named)
def test_every_command_and_example_runs(page, walks):
    walks[page].result()


@pytest.mark.slow
@pytest.mark.parametrize("page", LONG, ids=named)
def test_every_command_runs_in_full(page, tmp_path):
    walk(page, clone_of(tmp_path, thin=False))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_block_is_of_a_kind_that_is_looked_at(page):
    blocks = Page.read(page).blocks
    assert {block.language for block in blocks} <= LANGUAGES
    placeholder = re.compile(r"\b(FILE|DIR|PROBLEM|PLAN\.npz|X Y Z|HOST)\b|<\w+>|\.\.\.")
    assert not [block.line for block in blocks if block.language == "bash" and placeholder.search(block.text)]


def test_ci_runs_the_commands_that_make_an_environment():
    commands = [
        line for block in Page.read(PAGES[0]).blocks for line in block.text.splitlines() if ENVIRONMENT in line
    ]
    ci = (ROOT / ".ci" / "run").read_text()
    judged = r"(?: \|\| \[ \$\? -eq 1 \] # .*)?"  # a verdict may be no
    endings = re.findall(rf"""^bash -c "\$\(readme_command '([^']+)'\)"{judged}$""", ci, re.MULTILINE)
    assert len(commands) == len(endings) == 2
    for ending in endings:
        assert len([command for command in commands if command.endswith(ending)]) == 1
    assert all(ENVIRONMENT not in page.read_text() for page in PAGES[1:])
    extras = read_toml(ROOT / "pyproject.toml")["project"]["optional-dependencies"]
    assert {name for command in commands for name in re.findall(r"\.\[(\w+)\]", command)} <= set(extras)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_link_leads_somewhere(page):
    for link in Page.read(page).links():
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), f"{link}: no such file"
        assert not anchor or anchor in Page.read(target).anchors(), f"{link}: no such heading"


def defined(path: Path) -> set[str]:
    """Names at the top of a module, and those in its classes as Class.name."""

    def names(body: list[ast.stmt]) -> set[str]:
        found = {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        for node in body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            for target in targets:
                found |= {name.id for name in ast.walk(target or ast.Pass()) if isinstance(name, ast.Name)}
        return found

    body = ast.parse(path.read_text()).body
    classes = [node for node in body if isinstance(node, ast.ClassDef)]
    return names(body) | {f"{node.name}.{name}" for node in classes for name in names(node.body)}


def test_every_function_that_the_method_names_is_in_its_file():
    lines = [line for line in Page.read(ROOT / "docs" / "method.md").prose if line.startswith("Code: ")]
    checked = 0
    for line in lines:
        parts = re.split(r"\[([^\]]+)\]\(([^)]+)\)", line.removeprefix("Code: "))
        assert parts[0] == ""
        for title, link, names in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
            assert link == f"../ctr_nlp/{title}"
            wanted = re.findall(r"`([^`]+)`", names)
            missing = set(wanted) - defined(ROOT / "ctr_nlp" / title)
            assert wanted, f"{title}: no function is named"
            assert not missing, f"{title}: {missing}"
            checked += len(wanted)
    assert checked > 50


def test_every_equation_of_the_seed_stands_once_and_with_its_code():
    """Displayed ones are fenced; inline ones have no backslash before a sign, which Markdown would take away."""
    text = (ROOT / "docs" / "method.md").read_text()
    numbers = re.findall(r"\\tag\{(\d+)\}|\\text\{\((\d+)\)\}", text)
    assert sorted(int(tag or mark) for tag, mark in numbers) == list(range(1, 13))
    page = Page.read(ROOT / "docs" / "method.md")
    assert sum(block.language == "math" for block in page.blocks) >= 12
    inline = re.findall(r"\$[^$]+\$", "\n".join(page.prose))
    assert inline
    assert not [formula for formula in inline if re.search(r"\\[^a-zA-Z]", formula)]
    parts = text.partition("## Where we depart")[0].split("\n## ")[1:]
    assert [part.split("\n")[0] for part in parts if "\nCode: [" not in part] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_file_that_is_named_exists(page):
    """Those of the repository; links are looked at elsewhere, and what programs write is not here."""
    text = re.sub(r"\[[^\]]*\]\([^)]*\)", "", "\n".join(Page.read(page).prose))
    for span in re.findall(r"`([^`\s]+)`", text):
        if re.fullmatch(r"[\w./-]+(\.py|\.c|\.toml|\.cff|/)", span) and not span.startswith("runs/"):
            assert any((ROOT / room / span).exists() for room in (".", "ctr_nlp", "scripts")), span


def test_every_file_that_contributors_are_sent_to_exists():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(r"`([\w./-]+(?:\.py|\.md|\.toml|/))`", text)) - {"runs/site/"}
    assert len(named) > 10
    assert [
        span for span in named if not any((ROOT / room / span).exists() for room in (".", "ctr_nlp/hardware"))
    ] == []


@pytest.fixture(scope="module")
def helps() -> dict[str, str]:
    """The --help of every program."""
    programs = {name: partial(runpy.run_path, str(ROOT / "scripts" / name)) for name in SCRIPTS}
    programs |= {f"ctr-nlp {name}": partial(runpy.run_module, "ctr_nlp") for name in COMMANDS}
    programs |= {
        f"studies/{name}.py": partial(runpy.run_path, str(ROOT / "scripts" / "studies" / f"{name}.py"))
        for name in STUDIES
    }
    programs |= {"emulator": partial(runpy.run_module, "emulator")}
    return {name: help_of(name.split(), run) for name, run in programs.items()}


def help_of(names: list[str], run: partial[dict[str, object]]) -> str:
    """What a program of these names prints where it is asked for help."""
    told = StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told):
        patch.setattr(main, "_hold_interrupts", lambda: None)  # as this process goes on after it
        patch.setattr(sys, "argv", [*names, "--help"])
        patch.setenv("COLUMNS", "80")
        with pytest.raises(SystemExit) as end:
            run(run_name="__main__")
    assert not end.value.code
    return told.getvalue()


def test_every_program_tells_its_exit_status(helps):
    assert SCRIPTS == ["compare.py", "export.py", "horizon.py", "per_frame.py"]
    assert [name for name in SCRIPTS if "Exit status" not in helps[name]] == []


def options(text: str) -> set[str]:
    """Long options in a text, tables' rulers apart."""
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_program_and_option_that_is_named_exists(page, helps):
    """An option stands in the help of a program that its section names, or else its page."""
    whole = "\n".join(Page.read(page).sections())
    for name in re.findall(r"\bscripts/(\w+\.py)", whole):
        assert name in SCRIPTS
    for name in re.findall(r"`(?:\.venv/bin/)?ctr-nlp ([a-z]+)", whole):
        assert name in COMMANDS
    for section in Page.read(page).sections():
        near = [name for name in helps if name in section] or [name for name in helps if name in whole]
        allowed = set().union(*(options(helps[name]) for name in near or helps))
        assert options(section) <= allowed, f"{section[:60]}: {options(section) - allowed}, by {near}"


def snippets() -> list[tuple[str, Block]]:
    pages = [(named(page), block) for page in PAGES for block in Page.read(page).blocks]
    return [(name, block) for name, block in pages if block.language == "toml"]


@pytest.mark.parametrize(("name", "block"), snippets(), ids=lambda value: getattr(value, "line", value))
def test_a_part_of_a_hardware_file_fits_into_the_example(name, block, tmp_path, robot):
    part, whole = tmp_path / "part.toml", read_toml(ROOT / "examples" / "hardware.toml")
    part.write_text(block.text)
    given = read_toml(part)
    assert set(given) <= {"connection", "axes", "arm"}
    axes = {axis["joint"]: axis for axis in [*whole["axes"], *given.get("axes", [])]}
    hardware = Hardware(
        tuple(build_from_table(Axis, axis) for axis in axes.values()),
        build_from_table(Arm, whole["arm"] | given.get("arm", {})),
        build_from_table(Connection, given.get("connection", {})),
    )
    hardware.apply_limits(robot)
    for axis in given.get("axes", []):
        i = robot.axes.index(axis["joint"])
        ends = np.zeros((2, len(robot.axes)))
        ends[:, i] = robot.lower[i], robot.upper[i]
        column = [each.joint for each in hardware.axes].index(axis["joint"])
        reached = np.sort(hardware.positions(robot, ends)[:, column])
        assert reached == pytest.approx(axis["range"])


def test_the_wiring_is_that_of_the_example_hardware():
    """Axis, joint, unit, range, speed and acceleration; the drives agree with the emulated machine's settings."""
    from emulator.reports import DEFAULT_CONTROLLER_SETTINGS

    hardware = Hardware.from_toml(ROOT / "examples" / "hardware.toml")
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in Page.read(ROOT / "docs" / "hardware.md").prose
        if re.match(r"\| [A-Z] \|", line)
    ]
    assert [row[0] for row in rows] == list(hardware.letters)
    for k, (row, axis) in enumerate(zip(rows, hardware.axes, strict=True)):
        assert f"`{axis.joint}`" in row[1]
        lower, upper = axis.range
        assert row[2:6] == [
            axis.unit,
            f"{lower:g} to {upper:g}",
            f"{axis.speed:g} {axis.unit}/s",
            f"{axis.acceleration:g} {axis.unit}/s²",
        ]
        if "=" in row[6]:
            drive, steps = row[6].split(" = ")
            numbers = drive.replace("mm lead", "").replace("steps", "").replace(" : 1", "").replace("x", "*")
            assert eval(numbers) == pytest.approx(DEFAULT_CONTROLLER_SETTINGS[100 + k])
            assert steps == f"{DEFAULT_CONTROLLER_SETTINGS[100 + k]:g} steps/{axis.unit}"


def test_the_example_of_slicer_is_what_the_tutorial_makes(tmp_path, monkeypatch):
    blocks = [
        block for block in Page.read(ROOT / "docs" / "tutorial.md").blocks if "synthetic_airway" in block.text
    ]
    assert [block.language for block in blocks] == ["python"]
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks[0].text, "tutorial.md", "exec"), {})
    kept = ROOT / "examples" / "airway.mrk.json"
    assert kept.stat().st_size < 60e3
    made, known = (read_branches(path, None) for path in (tmp_path / "airway.mrk.json", kept))
    assert [branch.name for branch in made.branches] == [branch.name for branch in known.branches]
    assert made.space == known.space == "LPS"
    for one, other in zip(made.branches, known.branches, strict=True):
        assert one.points == pytest.approx(other.points, abs=2e-3)
        assert one.radius == pytest.approx(other.radius, abs=2e-3)


def test_pictures_are_small():
    pictures = list((ROOT / "docs").rglob("*.png"))
    assert pictures
    assert all(path.stat().st_size < 150e3 for path in pictures)
