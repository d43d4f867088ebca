"""Planning under a load: a frame's functions, what its constraints say, and motions."""

from __future__ import annotations

import signal
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from common import named_problem
from loaded_plans import TWO, made, through_the_pole
from rows import central
from test_elastic_planning import TIES

from ctr_nlp import (
    Load,
    Loaded,
    LoadOverTime,
    Plan,
    Problem,
    Steerer,
    sequence,
    solve_horizon,
    solve_per_frame,
    table_i_robot,
)
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, ProblemError
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.models.protocol import build_sample_function
from ctr_nlp.ocp.frame import fill_parameters, program
from ctr_nlp.ocp.joint import frame_terms
from ctr_nlp.paths.curve import curve_from_points
from ctr_nlp.planning.horizon import loaded_horizon
from ctr_nlp.solvers.scenarios import interior_point

pytestmark = pytest.mark.interpreted
NITINOL, SIGMA = with_modulus(table_i_robot(), 60_000), np.linspace(0, 1, 31)
PULL = Load(force=(0.1, -0.2, 0.15))
LOADS = {
    "force": PULL,
    "tool force and moment": Load(force=(0.1, 0.2, -0.1), axes="tool", axial_moment=2.0),
    "dead moment": Load(force=(0.0, 0.1, 0.0), moment=(8.0, -5.0, 3.0)),
    "tool moment": Load(moment=(4.0, 6.0, 3.0), axes="tool", axial_moment=-2.0),
    "force along the body": Load((0.05, 0.0, 0.0), distributed_force=(0.0, 0.004, 0.0), between=(10.0, 40.0)),
    "weight": Load(force=(0.0, 0.1, 0.0), densities=6.45, down=(1, 0, 0)),
}
EVERY_LOAD = pytest.mark.parametrize("kind", LOADS)


def drawn_q(rng):
    out = np.maximum.accumulate(np.sort(rng.uniform(0.1, 1, 3)) * [50, 107, 150])
    return np.concatenate([rng.uniform(-1.5, 1.5, 3), out, rng.uniform(-0.5, 0.5, 2)])


def frame_of(load, margin=0.1):
    """The program of a frame, and its parameters."""
    model, sample = Loaded(load), named_problem("line", 3).target_frames[2]
    terms = frame_terms(NITINOL, model, margin)
    nlp = program("frame", NITINOL.structure, model, terms)
    return nlp, nlp.pack(fill_parameters(NITINOL, terms, sample))


@EVERY_LOAD
def test_every_x_is_the_equilibrium_of_its_own_configuration(kind):
    """q, as the program has it, leads back to x, and to the same shape, by the evaluation of motions."""
    model, rng = Loaded(LOADS[kind]), np.random.default_rng(1)
    nlp, p = frame_of(LOADS[kind])
    picked = ca.Function("picked", [nlp.x, nlp.p], [ca.vertcat(nlp.x, nlp.g)])
    for _ in range(3):
        q = drawn_q(rng)
        x = model.rest(NITINOL, q)
        found = picked(x, p).full().ravel()[nlp.configuration]
        np.testing.assert_allclose(found, np.append(q, x[:3]), atol=5e-4)


@EVERY_LOAD
def test_points_of_programs_are_those_of_motions(kind):
    """At 0.3 N to 0.02 mm."""
    model, rng = Loaded(LOADS[kind]), np.random.default_rng(2)
    if model.load.densities is None:
        shape = build_sample_function(model, NITINOL.structure, len(SIGMA))
        for _ in range(8):
            x = model.guess(NITINOL, drawn_q(rng))
            points, tangents = shape(x, SIGMA, NITINOL.numbers, model.load.numbers(3))
            np.testing.assert_allclose(points, model.points(NITINOL, x[None], SIGMA)[0], atol=0.02)
            np.testing.assert_allclose(tangents, model.tangents(NITINOL, x[None], SIGMA)[0], atol=0.005)
        return
    nlp, p = frame_of(model.load)
    residual = ca.Function("residual", [nlp.x, nlp.p], [nlp.residual])
    roots, target = p[nlp.parameter_slice("shape_roots")], p[nlp.parameter_slice("target")].reshape(3, -1).T
    for _ in range(8):
        x = model.guess(NITINOL, drawn_q(rng))
        points = target + residual(x, p).full().reshape(3, -1).T / roots[:, None]
        np.testing.assert_allclose(points, model.points(NITINOL, x[None], np.linspace(0, 1, 21))[0], atol=0.02)


@pytest.mark.parametrize("beta", TIES["seed"])
def test_derivatives_are_right_and_finite_where_tubes_end_together(beta):
    nlp, p = frame_of(PULL)
    x = Loaded(PULL).guess(NITINOL, np.array([0.5, -0.4, 0.3, *beta, 0.1, -0.2], dtype=float))
    _, gradient, _, jacobian = nlp.functions.slopes(x, p)
    assert np.isfinite(gradient.full()).all()
    assert np.isfinite(jacobian.full()).all()
    x[3:6] += [-0.5, 0.0, 0.5]
    _, gradient, _, jacobian = nlp.functions.slopes(x, p)
    value = nlp.functions.value
    expected = central(lambda at: value(at, p)[0].full().ravel(), x)
    np.testing.assert_allclose(gradient.full().ravel(), expected[0], rtol=1e-5, atol=1e-5 * abs(expected).max())
    expected = central(lambda at: value(at, p)[1].full().ravel(), x)
    np.testing.assert_allclose(jacobian.full(), expected, rtol=1e-5, atol=1e-5 * abs(expected).max())


def test_straight_tips_have_derivatives():
    """w = 0 is no special case."""
    nlp, p = frame_of(PULL)
    for part in nlp.functions.slopes(np.array([0.1, 0.2, 0.3, 20, 60, 100, 0, 0]), p):
        assert np.isfinite(part.full()).all()


def test_one_program_serves_all_loads_of_a_kind():
    nlp, _ = frame_of(PULL)
    assert frame_of(Load((0, 0, -0.2), axial_moment=1.0))[0] is nlp
    assert frame_of(LOADS["weight"])[0] is not nlp
    assert frame_of(LOADS["tool force and moment"])[0] is not nlp


def test_determinants_lose_their_sign_near_the_margin():
    """They hold the moment along the robot as it is: 0.03 at 0.3 N, on margins below 0.95."""
    model, rng, looked = Loaded(PULL), np.random.default_rng(3), 0
    while looked < 6:
        q = drawn_q(rng)
        q[:3] *= 1.5
        x = model.rest(NITINOL, q)
        margin = model.margins(NITINOL, x[None])[0]
        if not 0.05 < margin < 0.95:
            continue
        looked += 1
        for asked, held in ((margin - 0.03, True), (margin + 0.03, False)):
            nlp, p = frame_of(PULL, asked)
            g = nlp.functions.value(x, p)[1].full().ravel()
            names = np.repeat([c.name for c in nlp.constraints], [c.value.numel() for c in nlp.constraints])
            assert bool((g[names == "stability"] > 0).all()) == held


@pytest.fixture(scope="module")
def reachable():
    """A problem whose targets are shapes of an unloaded plan of two tubes, and that plan."""
    robot = with_modulus(TWO, 60_000)
    q = np.column_stack([np.linspace(0, 0.6, 4), np.zeros(4), np.linspace(40, 60, 4), np.linspace(60, 80, 4)])
    free = made(robot, np.hstack([q, np.zeros((4, 2))]))
    return Problem("reachable", robot, sequence([curve_from_points(shape) for shape in free.shape])), free


CONSTANT, LEANING = Load(force=(0.0, 0.1, 0.0)), Load(distributed_force=(0.0, 0.004, 0.0), between=(20.0, 70.0))
CHANGING = LoadOverTime([CONSTANT, LEANING, Load()], [0.0, 0.5, 1.0])


@pytest.mark.parametrize("solve", [solve_per_frame, solve_horizon])
@pytest.mark.parametrize(
    "load",
    [CONSTANT, *(pytest.param(load, marks=pytest.mark.slow) for load in (LEANING, CHANGING))],
    ids=["constant", "along the body", "over time"],
)
def test_a_plan_that_knows_the_load_makes_up_for_it(reachable, solve, load):
    """At most a tenth of the error that is left without; and its file tells the load."""
    problem, free = reachable
    found = solve(problem, model=Loaded(load))
    blind = np.sqrt((np.linalg.norm(free.with_load(load).shape - found.target, axis=-1) ** 2).mean())
    left = np.sqrt((np.linalg.norm(found.shape - found.target, axis=-1) ** 2).mean())
    assert found.success.all()
    assert not found.meta["snaps"]
    assert left < 0.1 * blind
    assert found.evaluated_load == load
    assert found.as_planned
    assert not found.evaluate_on("elastic").as_planned
    assert found.evaluate_on("elastic").evaluated_load is None
    assert found.with_load(Load()).evaluated_load == Load()


@pytest.mark.slow
@pytest.mark.parametrize("force", [(0.0, 0.1, 0.0), (-0.1, 0.0, 0.0)])
@pytest.mark.parametrize("name", ["cos", "line_arc"])
def test_a_load_costs_about_nothing_where_the_robot_can_bear_it(name, force):
    """From the motion without it alone, no plan, or one of a quarter more, was found in three of these cases."""
    problem = named_problem(name)
    problem = replace(problem, robot=with_modulus(problem.robot, 60_000))
    free = solve_horizon(problem, model="elastic")
    found = solve_horizon(problem, model=Loaded(Load(force)), motion_weight=free.options["motion_weight"])
    assert found.success.all()
    assert not found.meta["snaps"]
    assert found.verdicts.stable.word == "yes"
    assert found.objective.sum() < 1.2 * free.objective.sum()


def test_a_locked_tilt_stays(reachable):
    problem, _ = reachable
    robot = problem.robot.with_locked_tilt()
    found = solve_per_frame(replace(problem, robot=robot), model=Loaded(Load(force=(0.0, 0.02, 0.0))))
    assert found.success.all()
    np.testing.assert_allclose(found.theta, 0, atol=1e-6)


def test_the_command_plans_under_a_load(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text("force = [0.0, 0.02, 0.0]\n")
    (tmp_path / "two.toml").write_text(TWO.to_toml())
    rows = "".join(f"{0.001 * z * z},0,{z}\n" for z in range(0, 81, 4))
    (tmp_path / "path.csv").write_text(f"x_mm,y_mm,z_mm\n{rows}")
    argv = ["steer", "path.csv", "--robot", "two.toml", "--frames", "2", "--model", "elastic", "--no-figures"]
    argv += ["--out", "here", "--load", "mine.toml", "--direction", "forward"]
    assert main(argv) == 2
    assert "looks like a ratio" in capsys.readouterr().err
    assert main([*argv, "--youngs-modulus", "60000"]) in (0, 1)
    assert "under a tip force of (0, 0.02, 0) N" in capsys.readouterr().out
    assert Plan.load("here/plan.npz").evaluated_load == Load(force=(0.0, 0.02, 0.0))


def test_what_cannot_be_planned_under_a_load_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = [
        "plan",
        "line",
        "--model",
        "dominant",
        "--frames",
        "4",
        "--force",
        "0",
        "0.02",
        "0",
        "--youngs-modulus",
        "60000",
    ]
    assert main(argv) == 2
    assert "does not go with the dominant model" in capsys.readouterr().err


def test_a_base_that_is_led_through_the_pole_of_its_tilt_is_refused_under_a_load_frame_by_frame_at_once():
    """In the middle of synthesis the base points along -y."""
    problem = named_problem("synthesis", 100, robot=NITINOL)
    with pytest.raises(ProblemError, match=r"begins 0\.\d+ rad from the y axis of the base in frame (49|5\d)"):
        solve_per_frame(problem, model=Loaded(PULL))
    wall = curve_from_points([(0.0, 0.0, 50.0 * k) for k in range(4)], radius=4 * [10.0])
    walled = replace(problem, lumen=wall)
    with pytest.raises(ProblemError, match=r"begins 0\.\d+ rad from the y axis"):
        solve_horizon(walled, model=Loaded(PULL))


def test_a_motion_under_a_load_may_lead_the_base_through_the_pole_of_its_tilt():
    """Its targets are shapes of two tubes that nothing pulls at."""
    robot = with_modulus(TWO, 60_000)
    free = made(robot, through_the_pole())
    problem = Problem("pole", robot, sequence([curve_from_points(shape) for shape in free.shape]))
    load = Load(force=(0.0, 0.0, -0.1))
    found = solve_horizon(problem, model=Loaded(load), initial=[free.q])
    blind = np.sqrt((np.linalg.norm(free.with_load(load).shape - found.target, axis=-1) ** 2).mean())
    left = np.sqrt((np.linalg.norm(found.shape - found.target, axis=-1) ** 2).mean())
    assert found.complete
    assert found.as_planned
    assert left < 0.1 * blind
    assert found.q[0, 4] < np.pi / 2 - 0.2
    assert found.q[-1, 4] > np.pi / 2 + 0.2


def test_a_motion_under_a_load_keeps_a_given_start_and_end(reachable):
    problem, free = reachable
    start, end = free.q[0] + 0.01, free.q[-1] + 0.02
    found = solve_horizon(problem, model=Loaded(CHANGING), start=start, end=end)
    assert found.complete
    np.testing.assert_allclose(found.q[-1], end, atol=1e-9)
    assert (abs(found.q[0] - start) <= problem.robot.speed * problem.dt + 1e-6).all()


def test_a_motion_that_is_interrupted_before_the_load_is_looked_at_is_no_solution(reachable):
    problem, _ = reachable
    found = solve_horizon(problem, model=Loaded(CONSTANT), progress=lambda *_: signal.raise_signal(signal.SIGINT))
    assert found.meta["interrupted"]
    assert not found.success.any()
    assert np.isfinite(found.q).all()


def test_a_motion_that_is_interrupted_under_the_load_is_no_solution(reachable, monkeypatch):
    problem, _ = reachable
    advance = interior_point._InteriorPointSolve.advance

    def interrupted(run):
        signal.raise_signal(signal.SIGINT)
        return advance(run)

    monkeypatch.setattr(interior_point._InteriorPointSolve, "advance", interrupted)
    found = solve_horizon(problem, model=Loaded(CONSTANT))
    assert found.meta["interrupted"]
    assert not found.success.any()
    assert found.evaluated_load == CONSTANT


@pytest.mark.slow
def test_a_motion_that_is_given_is_where_the_search_under_a_load_begins(reachable, monkeypatch):
    problem, _ = reachable
    first = solve_horizon(problem, model=Loaded(CONSTANT))
    monkeypatch.delattr(loaded_horizon, "per_frame_motions")
    weight = first.options["motion_weight"]
    again = solve_horizon(problem, model=Loaded(CONSTANT), initial=[first.q], motion_weight=weight)
    assert again.complete
    assert again.objective.sum() == pytest.approx(first.objective.sum(), abs=1e-4)


def test_a_steerer_bears_no_load_that_changes():
    with pytest.raises(LoadError, match="a Steerer needs a load that stays the same; this one changes over time"):
        Steerer(NITINOL, [0, 0, 0, 0, 20, 40, 0, 0], 0.05, model=Loaded(CHANGING))
