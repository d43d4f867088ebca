"""The command `ctr-nlp`: its subcommands, what they load, and files of the user's own."""

import json
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from common import NAMES, ROOT, UNJUDGED

import ctr_nlp
from ctr_nlp import Plan, Robot, read_load
from ctr_nlp.cli.commands import doctor
from ctr_nlp.cli.commands.new import TEMPLATE_BY_KIND, template
from ctr_nlp.cli.main import COMMANDS, load, main
from ctr_nlp.cli.problems import from_python
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.problems import named_problem
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.support.pool import BLAS_THREAD_VARIABLES

HEAVY = {"casadi", "numpy", "scipy", "matplotlib", "rich", "argparse"}


def loaded(code, *allowed):
    """Heavy modules that a line of Python brings, in a process of its own."""
    told = f"import sys\n{code}\nprint(*set({sorted(HEAVY)}) & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split()) - set(allowed)


def run(*arguments):
    return main([str(argument) for argument in arguments])


# What is loaded


def test_importing_the_library_loads_nothing_heavy():
    assert loaded("import ctr_nlp; ctr_nlp.__version__; dir(ctr_nlp)") == set()
    assert loaded("from ctr_nlp import CtrError") == set()
    assert "matplotlib" not in loaded("from ctr_nlp import *")


def test_importing_the_library_takes_little_of_the_processor():
    told = "import time; begin = time.process_time(); import ctr_nlp; print(time.process_time() - begin)"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 0.3


@pytest.mark.parametrize(("given", "expected"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_linear_algebra_of_a_command_has_one_thread_unless_the_user_says_otherwise(given, expected):
    code = "import os, sys\nfrom ctr_nlp.cli.main import main\nsys.argv = ['ctr-nlp', '--version']\n"
    code += "try:\n    main()\nexcept SystemExit:\n    print(os.environ['OPENBLAS_NUM_THREADS'])"
    environment = {name: value for name, value in os.environ.items() if name not in BLAS_THREAD_VARIABLES}
    told = [sys.executable, "-c", code]
    done = subprocess.run(told, capture_output=True, text=True, check=True, env=environment | given)
    assert done.stdout.split()[-1] == expected


def test_a_plan_without_pictures_loads_nothing_that_draws(tmp_path):
    arguments = [
        "plan",
        "arc",
        "--model",
        "dominant",
        "--frames",
        "3",
        "--no-figures",
        "--out",
        str(tmp_path / "out"),
        *UNJUDGED,
    ]
    code = f"from ctr_nlp.cli.main import main\nassert main({arguments}) == 0"
    code += "\nassert 'scipy.stats' not in sys.modules"
    assert "matplotlib" not in loaded(code)
    assert not list((tmp_path / "out").glob("*.png"))


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_what_is_told_of_the_command_loads_nothing_heavy(option):
    code = f"from ctr_nlp.cli.main import main\ntry: main(['{option}'])\nexcept SystemExit: pass"
    assert loaded(code, "argparse") == set()


def test_the_doctor_is_called_without_what_it_looks_for():
    assert loaded("import ctr_nlp.cli.commands.doctor", "argparse", "rich") == set()


def test_public_names_are_those_that_are_told_and_each_is_what_its_module_holds():
    assert set(ctr_nlp.__all__) <= set(dir(ctr_nlp))
    homes = {name for names in ctr_nlp._HOMES.values() for name in names}
    assert homes | {"__version__"} == set(ctr_nlp.__all__)
    for name in homes:
        assert getattr(ctr_nlp, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ctr_nlp.nothing


def test_the_version_is_one():
    assert f"version: {ctr_nlp.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert 'version = { attr = "ctr_nlp.__version__" }' in (ROOT / "pyproject.toml").read_text()


# Subcommands


def test_every_subcommand_is_listed_and_has_help_of_its_own(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    listed = capsys.readouterr().out
    for name, entry in COMMANDS.items():
        assert f" {name}" in listed
        parser = load(entry).parser(f"ctr-nlp {name}")
        assert parser.prog == f"ctr-nlp {name}" == load(entry).name
        assert "Exit status" in parser.epilog


@pytest.mark.parametrize("arguments", [[], ["plans"], ["--frames", "5"]])
def test_what_is_no_subcommand_is_refused_with_those_that_are(arguments, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert "COMMAND" in capsys.readouterr().err


def test_what_is_nearly_a_subcommand_is_told_which(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["exprot"])
    assert "no command is called 'exprot'" in (told := capsys.readouterr().err)
    assert told.endswith("Did you mean 'export'?\n")


@pytest.mark.parametrize(
    ("script", "options", "printed"),
    [
        ("horizon", ("--frames", "10"), "e3 0."),
        ("per_frame", ("--frames", "5"), "e3 0."),
        ("compare", ("--frames", "5", "--variants", "joint:sqp"), "joint:sqp"),
        ("export", ("--frames", "20", "--to", "gcode"), "wrote cos.gcode"),
    ],
)
def test_scripts_run_from_any_folder(script, options, printed, tmp_path):
    model = () if script == "compare" else ("--model", "dominant")
    command = [sys.executable, str(ROOT / f"scripts/{script}.py"), "cos", *model, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert printed in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--direction", "best"],
            "--direction does not go with --formulation horizon; it goes with one of joint,",
        ),
        (["--jump-width", 2], "--jump-width does not go with --formulation horizon"),
        (
            ["--formulation", "joint", "--jobs", 2],
            "--jobs does not go with --formulation joint; it goes with horizon",
        ),
        (["--formulation", "two-stage", "--end", "q.json"], "--end does not go with --formulation two-stage"),
        (["--formulation", "joint", "--jobs", 0], "--jobs does not go with --formulation joint"),
        (["--formulation", "joint", "--live"], "--live does not go with --formulation joint"),
        (["--formulation", "joint", "--sweep-motion-weight"], "--sweep-motion-weight does not go with"),
        (["--formulation", "joint", "--solver", "banded"], "solver is 'banded'; it must be one of ipopt, sqp"),
        (["--solver", "sqp"], "solver of a horizon is 'sqp'; it must be one of banded, ipopt"),
    ],
)
def test_options_that_do_not_fit_the_formulation_are_refused_by_name(arguments, message, tmp_path, capsys):
    assert run("plan", "arc", "--frames", 2, *arguments, "--out", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


def test_plan_is_the_horizon_and_steer_goes_frame_by_frame(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = *UNJUDGED, "arc", "--model", "dominant", "--frames", 3
    assert run("plan", *asked) == 0
    assert run("plan", *asked, "--formulation", "joint", "--out", "same") == 0
    assert run("steer", *asked) == 0
    assert sorted(path.name for path in Path("runs").iterdir()) == ["arc-horizon-dominant", "arc-joint-dominant"]
    one, other = (Plan.load(Path(place) / "plan.npz") for place in ("same", "runs/arc-joint-dominant"))
    np.testing.assert_array_equal(one.q, other.q)


def test_frame_by_frame_a_motion_is_retracted_and_limited_too(tmp_path):
    arguments = [
        "--model",
        "dominant",
        "--frames",
        4,
        "--retract",
        "--speed",
        1,
        60,
        0.5,
        "--out",
        tmp_path / "out",
        *UNJUDGED,
    ]
    assert run("steer", "arc", *arguments) == 0
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    assert plan.meta["problem"]["name"] == "arc-retraction"
    assert plan.robot.speed.tolist() == [1, 1, 1, 60, 60, 60, 0.5, 0.5]


# Problems


def test_a_named_problem_is_that_of_its_file():
    for name in NAMES:
        assert named_problem(name, 2).name == name


def test_a_problem_file_is_planned_and_may_import_what_lies_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("parts.py").write_text("from ctr_nlp.problems import named_problem\n")
    Path("mine.py").write_text(
        "from dataclasses import replace\nfrom parts import named_problem\n"
        "def problem(frames, duration, robot):\n"
        "    return replace(named_problem('arc', frames, duration, robot), name='mine')\n"
    )
    made = from_python("mine.py", 3, 6.0, None)
    assert (made.name, made.frames, made.dt) == ("mine", 3, 2.0)
    assert str(tmp_path) not in sys.path
    del sys.modules["parts"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"mine.py defines no problem\(frames, duration, robot\); see `ctr-nlp new problem`"),
        ("problem = 3\n", "defines no problem"),
        ("\ndef problem(\n", "mine.py: SyntaxError: .*mine.py, line 2"),
        ("import nothing_such\n", "mine.py, line 1: ModuleNotFoundError: No module named 'nothing_such'"),
        ("problem = lambda: 0\n", "mine.py: TypeError: .*takes 0 positional arguments but 3 were given"),
        ("def problem(*_):\n    return 1 / 0\n", "mine.py, line 2: ZeroDivisionError: division by zero"),
        (
            "def problem(*_):\n    return 'arc'\n",
            r"mine.py: problem\(\) returned 'arc'; it must return a ctr_nlp.P",
        ),
        ("import sys\nsys.exit(3)\n", "mine.py, line 2: SystemExit: 3"),
        (
            "import ctr_nlp as c\ndef problem(*_):\n    return c.table_i_robot().with_limits(theta=(1, 0))\n",
            "mine.py, line 3: limits of theta_x",
        ),
    ],
)
def test_a_problem_file_that_is_none_is_refused_in_one_line_that_says_where(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(text)
    with pytest.raises(ProblemError, match=message) as raised:
        from_python("mine.py", 3, 10.0, None)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["mine.py", "--branch", "2"],
            "--branch goes with a centreline file or a mask; mine.py is a problem file",
        ),
        (["nowhere.py"], "problem is 'nowhere.py'; it must be one of arc, bronchus"),
    ],
)
def test_calls_with_problem_files_are_refused_in_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("")
    assert run("plan", *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


# Files to start from


@pytest.mark.parametrize("kind", TEMPLATE_BY_KIND)
def test_a_new_file_is_written_once_and_is_good(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = f"mine{Path(TEMPLATE_BY_KIND[kind]).suffix}"
    assert run("new", kind, file) == 0
    assert f"wrote {file}; next: ctr-nlp " in capsys.readouterr().out
    if kind == "problem":
        assert from_python(file, 4, 10.0, None).frames == 4
    else:
        read = {"robot": Robot.from_toml, "hardware": Hardware.from_toml, "load": read_load}
        read.get(kind, Study.from_toml)(file)
    Path(file).write_text("mine now")
    assert run("new", kind, file) == 2
    assert f"{file} exists and is left as it is" in capsys.readouterr().err
    assert Path(file).read_text() == "mine now"


def test_a_new_file_is_named_for_what_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("new", "problem", "mine.toml") == 2
    assert "the name of a problem file ends in .py" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_examples_are_the_templates():
    for name in ("robot.toml", "hardware.toml", "study.toml", "survival.toml"):
        assert (ROOT / "examples" / name).read_text() == template(name)


# Doctor, completion, warm


def test_the_doctor_finds_that_planning_works(capsys):
    assert run("doctor") == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    assert all(word in out for word in ("casadi", "C compiler", "cache", "ffmpeg", "planning works"))


def requirements(monkeypatch, *lines):
    monkeypatch.setattr(doctor, "_plan", lambda: iter(()))
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: list(lines))


def test_the_doctor_tells_the_command_for_what_is_missing(monkeypatch, capsys):
    requirements(monkeypatch, "numpy>=2", 'nothing-such>=7 ; extra == "more"', 'numpy>=2 ; extra == "full"')
    assert run("doctor") == 0
    lines = capsys.readouterr().out.splitlines()
    assert f'extra more: {sys.executable} -m pip install "nothing-such>=7"' in lines
    assert not [line for line in lines if line.startswith("extra full:")]


def test_the_doctor_ends_in_1_where_the_core_lacks_something(monkeypatch, capsys):
    requirements(monkeypatch, "nothing-such>=7")
    assert run("doctor") == 1
    assert "planning does not work: core" in capsys.readouterr().out


def test_the_doctor_ends_in_1_where_nothing_is_solved(monkeypatch, capsys):
    monkeypatch.setattr(ctr_nlp, "solve_per_frame", lambda *_, **__: types.SimpleNamespace(complete=False), False)
    monkeypatch.setattr(ctr_nlp, "summary", lambda _: {"e3": 1.0}, False)
    assert run("doctor") == 1
    assert "planning does not work: a plan" in capsys.readouterr().out


def test_without_a_compiler_the_doctor_says_so_and_planning_works(monkeypatch, capsys):
    requirements(monkeypatch)
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    assert run("doctor") == 0
    assert "CTR_NLP_COMPILE is 0" in capsys.readouterr().out


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_subcommands_options_and_problems(shell, capsys):
    pytest.importorskip("shtab", reason='needs shtab: pip install "ctr_nlp[completion]"')
    assert run("completion", shell) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in COMMANDS)
    assert " ".join(NAMES) in script
    assert "formulation" in script
    if shell == "bash":
        asked = "COMP_WORDS=(ctr-nlp plan bron); COMP_CWORD=2; _shtab_ctr_nlp; echo ${COMPREPLY[@]}"
        done = subprocess.run(["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["bronchus"]


def test_warm_builds_what_plans_need_and_tells_where_it_is(monkeypatch, capsys):
    from ctr_nlp.cli.commands import warm

    built = []
    for how in warm.BUILDS:
        monkeypatch.setitem(
            warm.BUILDS, how, lambda problem, model, how=how: built.append((problem.name, model.name, how))
        )
    assert run("warm", "arc", "cos", "--models", "elastic") == 0
    assert built == [(name, "elastic", how) for name in ("arc", "cos") for how in ("frame by frame", "horizon")]
    assert str(cache.folder()) in capsys.readouterr().out
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    assert run("warm", "arc") == 2


def test_a_warm_cache_is_what_plans_use(tmp_path, monkeypatch):
    """Nothing is compiled for a plan after `warm`."""
    assert run("warm", "arc", "--models", "dominant") == 0
    monkeypatch.setattr(cache, "_build", lambda *_: pytest.fail("something is compiled"))
    assert run("plan", "arc", "--model", "dominant", "--frames", 4, *UNJUDGED, "--out", tmp_path) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["failed"] == 0
