"""The wheel, installed into an environment of its own and used in an empty folder; the examples; the types."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile

import pytest
from common import NAMES, ROOT

BUILT = ("pyproject.toml", "setup.py", "README.md", "LICENSE")
"""What a wheel is built from, beside the package."""
ON_A_CLUSTER = {"slurm_study.py"}
"""Examples that need other commands and arguments: tests/studies/test_slurm.py runs them."""
EXAMPLES = sorted({path.name for path in (ROOT / "examples").glob("*.py")} - ON_A_CLUSTER)


def ran(command, folder, **environment):
    """What a command prints; the exit status 0 or 1 is well, since a plan's verdicts may be no."""
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=clean | environment, capture_output=True, text=True
    )
    assert done.returncode in (0, 1), done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this working tree; skips where nothing can build one."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("ctr_nlp", "problems"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in BUILT:
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(out), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no wheel can be built here: {done.stderr.strip()[-300:]}")
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def program(wheel, tmp_path_factory):
    """The installed command `ctr-nlp`; what the wheel requires is taken from this environment."""
    home = tmp_path_factory.mktemp("environment")
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    ran([sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index", wheel], home)
    (site,) = home.glob("lib/python*/site-packages")
    (site / "required.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin" / "ctr-nlp"


def test_the_wheel_holds_problems_templates_and_types(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"ctr_nlp/problems/{name}.py" for name in NAMES} <= names
    assert {f"ctr_nlp/cli/templates/{name}" for name in ("problem.py", "robot.toml", "hardware.toml")} <= names
    assert not [name for name in names if not name.startswith("ctr_nlp")]
    kept = {path for path in (ROOT / "ctr_nlp").rglob("*") if path.is_file() and path.suffix != ".pyc"}
    assert {path.relative_to(ROOT).as_posix() for path in kept} <= names


def test_the_installed_command_plans_in_an_empty_folder(program, tmp_path):
    where = "import ctr_nlp; print(ctr_nlp.__file__)"
    assert str(program.parents[1]) in ran([program.with_name("python"), "-c", where], tmp_path)
    ran([program, "plan", "cos", "--frames", 5], tmp_path)
    ran([program, "new", "problem", "my.py"], tmp_path)
    ran([program, "plan", "my.py", "--frames", 5, "--model", "dominant"], tmp_path)
    made = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert made == ["cos-horizon-elastic", "mine-horizon-dominant"]
    pytest.importorskip("k3d", reason='needs k3d: pip install "ctr_nlp[report]"')
    ran([program, "report", *(f"runs/{name}/plan.npz" for name in made)], tmp_path)
    assert (tmp_path / "runs" / "report" / "report.html").stat().st_size > 1e5


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_in_a_folder_of_its_own(name, tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / name)], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.count(" mm") >= 2


def test_there_are_three_examples():
    assert len(EXAMPLES) == 3


SCRIPT = """
import numpy as np

import ctr_nlp as ctr

problem: ctr.Problem = ctr.named_problem("cos", frames=3, robot=ctr.table_i_robot())
plan = ctr.solve_horizon(problem)
q: np.ndarray = plan.q
tube = ctr.Tube(length=90, curved_length=50, curvature=0.01, outer_diameter=2, inner_diameter=1)
reveal_type(plan)
reveal_type(ctr.solve_per_frame)
ctr.solve_horizon("cos")
ctr.Tube(length="90", curved_length=50, curvature=0.01, outer_diameter=2, inner_diameter=1)
ctr.nothing
"""


def test_a_type_checker_sees_the_types_of_what_a_user_writes(tmp_path):
    """Public names are found in spite of their being imported late; three mistakes are, too."""
    pytest.importorskip("mypy")
    (tmp_path / "mine.py").write_text(SCRIPT)
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "mine.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    told = [line for line in done.stdout.splitlines() if line.startswith("mine.py")]
    assert 'Revealed type is "ctr_nlp.plan.plan.Plan"' in done.stdout
    assert "-> ctr_nlp.plan.plan.Plan" in done.stdout
    assert sum("error: " in line for line in told) == 3, done.stdout
    assert any('"solve_horizon" has incompatible type "str"; expected "Problem"' in line for line in told)
    assert any('"length" to "Tube" has incompatible type "str"' in line for line in told)
    assert any('Module has no attribute "nothing"' in line for line in told)
