"""The short programs of scripts/, called as a user calls them."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (("compare.py", "cos", "--variants", "joint:sqpp"), "is 'sqpp'; it must be one of ipopt, sqp"),
        (("compare.py", "cos", "--robot", "examples/hardware.toml"), "it is a hardware file, not a robot file"),
        (("export.py", "cos", "--frames", "1"), "frames"),
    ],
)
def test_bad_input_is_one_line(line, message):
    name, *rest = line
    called = [sys.executable, str(ROOT / "scripts" / name), *rest]
    done = subprocess.run(called, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    (told,) = done.stderr.splitlines()
    assert told.startswith("error: ")
    assert message in told
