"""The examples of CONTRIBUTING.md do what it says of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from bench import sweep
from common import named_problem
from emulator.wire import VirtualClock
from pages import Page

from ctr_nlp import Limits, Robot, Tube
from ctr_nlp.anatomy.branch import check_branches
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS
from ctr_nlp.exceptions import CurveError
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.results import PlaybackOutcome
from ctr_nlp.hardware.playing.session import play_plan, prepare_trajectory
from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame import fill_parameters, program
from ctr_nlp.ocp.nlp import Constraint, Nlp, Residual
from ctr_nlp.ocp.terms import Order

PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"


@pytest.fixture(scope="module")
def examples() -> dict[str, Any]:
    """The names that the examples in Python define, each run with its own imports alone."""
    found: dict[str, Any] = {}
    for block in Page.read(PAGE).blocks:
        if block.language == "python":
            names: dict[str, Any] = {"__name__": __name__}  # dataclasses look their module up
            code = compile(block.text, f"CONTRIBUTING.md, line {block.line}", "exec", dont_inherit=True)
            exec(code, names)
            found |= names
    return found


def test_the_term_costs_what_it_says(examples):
    problem = named_problem("line", 3)
    term = examples["TipSide"](4.0)
    dominant = KINEMATIC_MODELS["dominant"]
    nlp = program("terms", problem.robot.structure, dominant, (term, Order(None)))
    cost = ca.Function("cost", [nlp.x, nlp.p], [ca.sumsqr(nlp.residual)])
    q = np.array([0.4, -0.9, 0.3, 20.0, 50.0, 90.0, 0.2, -0.3])
    parameters = nlp.pack(fill_parameters(problem.robot, (term,), problem.target_frames[-1]))
    tip = dominant.points(problem.robot, q[None], np.ones(1))[0, 0]
    assert float(cost(q, parameters)) == pytest.approx(4.0 * tip[0] ** 2, rel=1e-3)


def test_the_model_is_the_dominant_one_for_a_single_tube(examples):
    robot = Robot((Tube(200, 150, 0.008, 2, 1),), Limits())
    q = np.array([[0.4, 120.0, 0.1, -0.2]])
    sigma = np.array([0.2, 0.6, 1.0])
    model = examples["Single"]()
    dominant = KINEMATIC_MODELS["dominant"]
    np.testing.assert_allclose(model.points(robot, q, sigma), dominant.points(robot, q, sigma), atol=1e-9)
    np.testing.assert_allclose(model.tangents(robot, q, sigma), dominant.tangents(robot, q, sigma), atol=1e-9)


def test_the_device_writes_every_command_once_in_order(examples, tmp_path):
    clock = VirtualClock()
    plan = sweep(10)
    hardware = replace(simulated_hardware(plan.robot), arm=None)
    position = prepare_trajectory(plan, hardware)[0].positions(np.zeros(1))[0]
    lines = list[str]()
    device = examples["Lines"](lines.append, position, clock)
    player = Player(device, None, Journal(tmp_path / "journal.jsonl", clock), clock)
    assert play_plan(player, plan, hardware).outcome is PlaybackOutcome.SUCCESS
    times = [float(line.split()[0]) for line in lines]
    assert len(times) > 10
    assert times == sorted(set(times))
    last = json.loads(lines[-1].partition(" ")[2])
    np.testing.assert_allclose(last, hardware.positions(plan.robot, plan.q[-1]), atol=1e-6)


def test_the_solver_finds_what_ipopt_finds(examples):
    x = ca.SX.sym("x", 2)
    to = ca.SX.sym("to", 2)
    disc = Constraint("disc", ca.sumsqr(x), np.array([-np.inf]), np.array([1.0]))
    wide = np.full(2, 10.0)
    nlp = Nlp("nearest", x, -wide, wide, {"to": to}, (Residual("distance", x - to),), (), (disc,))
    found = examples["LimitedMemory"](nlp)(np.zeros(2), nlp.pack({"to": (3.0, 4.0)}))
    assert found.success
    np.testing.assert_allclose(found.x, [0.6, 0.8], atol=1e-5)


def test_the_machine_format_has_a_line_for_each_command(examples):
    plan = sweep(10)
    trajectory = prepare_trajectory(plan, replace(simulated_hardware(plan.robot), arm=None))[0]
    title, *lines = map(json.loads, examples["json_lines"](trajectory, "sweep").splitlines())
    assert title == {"plan": "sweep"}
    assert [line["time_s"] for line in lines] == trajectory.commands().time.tolist()
    assert [*lines[0]][1:] == [axis.letter for axis in trajectory.hardware.axes]


def test_the_sender_gives_each_message_once(examples):
    source = examples["Queued"](Sensing())
    source.open()
    source._queue.append(([1.0, 2.0, 3.0], None))
    (reading,) = source.take(np.zeros(8), 5.0)
    assert reading.values.tolist() == [1.0, 2.0, 3.0]
    assert source.take(np.zeros(8), 5.1) == []


def test_the_reader_reads_points(examples, tmp_path):
    points = np.column_stack([np.zeros(40), 0.02 * np.arange(40.0) ** 2, 3.0 * np.arange(40)])
    np.savetxt(tmp_path / "path.xyz", points)
    (branch,) = examples["read_xyz"](tmp_path / "path.xyz", AS_THE_FILE_SAYS).branches
    assert branch.name == "path"
    np.testing.assert_allclose(branch.points, points)


@pytest.mark.parametrize("content", [b"", b"1 2\n3 4\n", b"0 0 0 5\n0 0 30 5\n", b"a b c\n", b"\xff\xfe\x00"])
def test_the_reader_refuses_other_files(examples, tmp_path, content):
    path = tmp_path / "path.xyz"
    path.write_bytes(content)
    with pytest.raises(CurveError, match=r"path\.xyz"):
        check_branches(path, examples["read_xyz"](path, AS_THE_FILE_SAYS))


def test_the_command_prints_tips(examples, tmp_path, capsys):
    plan = sweep(3)
    plan.save(tmp_path / "plan.npz")
    assert examples["main"]([str(tmp_path / "plan.npz"), "--json"]) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    np.testing.assert_allclose([row[1:] for row in table["rows"]], plan.shape[:, -1])
