"""Other laboratories' forward models beside ours: a stand-in that is right, one that is not, and bad answers."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from peers.agreement import compare_models, sample_configurations
from peers.program import format_input, run_peer_program

from ctr_nlp import Robot, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.loads import with_modulus

THREE = with_modulus(table_i_robot(), 60_000.0)
LONE = Robot(THREE.tubes[:1])
SCRIPT = Path(__file__).parents[2] / "scripts" / "studies" / "peer_models.py"
ARC = """#!{python}
import math, sys
numbers = iter(sys.stdin.read().split())
take = lambda count: [float(next(numbers)) for _ in range(count)]
d, n = map(int, take(2))
((length, curved, k, *_),) = [take(7) for _ in range(d)]
for row in range(n):
    alpha, beta, *force = take(5)
    if row == {unsolved}:
        print("0.001 nan 0")
        continue
    told = []
    for s in (0.0, beta / 2, beta):
        across, along = (1 - math.cos(k * s)) / k, math.sin(k * s) / k
        turn = alpha + {off}
        told += [s, across * math.cos(turn), across * math.sin(turn), along]
    print(0.001, "{stability}", 3, *told)
"""


@pytest.fixture
def stand_in(tmp_path):
    """Makes a program that bends one tube into an arc of its curvature, towards alpha."""

    def make(unsolved=-1, off=0.0, stability="nan", text=ARC):
        path = tmp_path / "peer"
        path.write_text(text.format(python=sys.executable, unsolved=unsolved, off=off, stability=stability))
        path.chmod(0o755)
        return path

    return make


def test_an_arc_agrees_with_a_lone_tube_and_what_is_not_solved_is_counted(stand_in):
    found = compare_models("arc", stand_in(unsolved=3, stability="1"), LONE, sample_configurations(LONE, 8))
    assert (found.configurations, found.unsolved, found.unsolved_here, found.elsewhere) == (8, 1, 0, 0)
    assert found.shape_largest < 1e-6
    assert found.unstable == 0
    assert found.peer_ms == pytest.approx(1.0)


def test_a_convention_that_is_a_quarter_turn_off_is_seen(stand_in):
    found = compare_models("arc", stand_in(off=np.pi / 2, stability="-1"), LONE, sample_configurations(LONE, 8))
    assert found.elsewhere > 0 or found.tip_largest > 1.0
    turned = compare_models("arc", stand_in(off=0.01), LONE, sample_configurations(LONE, 8))
    assert 0.001 < turned.tip_median < 0.2
    assert turned.unstable is None


def test_a_force_at_the_tip_bends_our_tube_and_not_the_stand_in(stand_in):
    """As Euler and Bernoulli's cantilever of what is out, to first order."""
    q = np.array([[0.0, 50.0, 0.0, 0.0]])
    force, tube = 0.05, LONE.tubes[0]
    found = compare_models("arc", stand_in(), LONE, q, (force, 0.0, 0.0))
    assert found.tip_largest == pytest.approx(force * 50.0**3 / (3 * tube.bending_stiffness), rel=0.15)


def test_configurations_are_within_limits_in_order_and_on_the_grid():
    q = sample_configurations(THREE, 50, seed=3)
    beta = q[:, 3:6]
    assert (q >= THREE.lower - 1e-9).all()
    assert (q <= THREE.upper + 1e-9).all()
    assert (np.diff(beta, axis=1) >= 2.0 - 1e-9).all()
    assert np.abs(beta * 100 - np.round(beta * 100)).max() < 1e-9
    assert len(format_input(THREE, q).splitlines()) == 1 + 3 + 50


@pytest.mark.parametrize(
    ("text", "says"),
    [("#!/bin/sh\nexit 3\n", "does not answer"), ("#!/bin/sh\necho 1 nan 2 3\n", "does not answer")],
)
def test_programs_that_do_not_answer_are_refused(stand_in, text, says):
    with pytest.raises(OptionError, match=says):
        run_peer_program(stand_in(text=text), "", 1)


def test_what_other_models_do_not_know_is_refused(stand_in):
    with pytest.raises(OptionError, match="answers 0 of 2"):
        run_peer_program(stand_in(text="#!/bin/sh\n"), "", 2)
    tilted = sample_configurations(LONE, 1) + np.array([0.0, 0.0, 0.1, 0.0])
    with pytest.raises(OptionError, match="theta is not 0"):
        format_input(LONE, tilted)
    with pytest.raises(OptionError, match="configurations is 0"):
        sample_configurations(LONE, 0)


def test_the_script_skips_what_is_not_there_and_prints_a_row_for_what_is(stand_in, tmp_path, capsys, monkeypatch):
    robot = tmp_path / "lone.toml"
    robot.write_text(Robot(table_i_robot().tubes[:1]).to_toml(), encoding="utf-8")
    given = ["absent=/nowhere/peer", f"arc={stand_in()}", "--robot", str(robot), "--configurations", "3"]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *given])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    printed = capsys.readouterr().out
    assert "absent is skipped: there is no program /nowhere/peer" in printed
    assert printed.splitlines()[-2].startswith("| arc | 0 | 3 | 0 | 0 | 0 |")
