"""Planning on the elastic model: a frame's functions, what its constraints say, and motions."""

from __future__ import annotations

import csv
import functools
import json
from dataclasses import replace

import casadi as ca
import frames as tracking
import numpy as np
import pytest
import truth
from common import UNJUDGED, named_problem
from frames import alone
from methods.comparison import available_variants, parse_variant
from reference import REFERENCE_METHODS
from reference.published import TABLE_II_PAPER_METHOD_ELASTIC
from rows import central

from ctr_nlp import (
    Limits,
    Problem,
    Robot,
    Settings,
    Tube,
    curve_from_formula,
    growing,
    solve_horizon,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.cli.commands.plan import plan as solve_horizon_program
from ctr_nlp.cli.commands.plan import steer as solve_per_frame_program
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.elastic import stability, torsion
from ctr_nlp.models.elastic.model import ELASTIC_NLP_STEPS_PER_SECTION
from ctr_nlp.ocp import FORMULATIONS
from ctr_nlp.ocp.frame_solver import FrameResult, sobol_starts
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.ocp.terms.feasible import MIN_INNER_DETERMINANT
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.solvers import compiled_functions
from ctr_nlp.solvers.frame.sqp import IPOPT_FALLBACK_TEXT

MARGIN = 0.1
ROBOTS = {
    "seed": table_i_robot(),
    "varying curvature": Robot(truth.TWO.tubes),
    "pushed out": truth.TWO,
}
EVERY_ROBOT = pytest.mark.parametrize("kind", ROBOTS)
TIES = {
    "seed": [(30, 30, 110), (0, 40, 90), (20, 80, 80), (0, 0, 60)],
    "varying curvature": [(30, 30), (0, 50)],
    "pushed out": [(40, 40), (0, 90), (60, 105)],
}
"""Extensions at which sections vanish."""
STRONG = Robot(
    (Tube(90, 70, (0.015, 0.03), 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)), Limits(beta=[(0, 85), (0, 140)])
)
COUPLED = {"seed": table_i_robot(), "strong": STRONG, "four tubes": truth.FOUR}
"""Robots that are unstable at many angles."""


@functools.cache
def frame(kind):
    """A frame with the margin as a parameter, and its functions."""
    nlp = alone(ROBOTS[kind], "elastic", True)
    return nlp, nlp.functions


def packed(nlp, robot, seed, margin=MARGIN):
    """A target like a helix, with noise."""
    u = np.linspace(0, 1, nlp.parameters["target"].shape[0])
    target = np.stack([25 * np.sin(2 * u), 15 * u**2, 90 * u], axis=1)
    target = target + np.random.default_rng(seed).normal(size=target.shape)
    return nlp.pack(
        {"tubes": robot.numbers, "target": target, "shape_roots": ShapeDistance().roots, "margin": margin}
    )


def drawn(robot, seed, count=1):
    """Unknowns (count, 2d + 2) at which tubes are turned by up to half a turn; extensions apart and in order."""
    rng, d = np.random.default_rng(seed), robot.d
    x = np.concatenate(
        [rng.uniform(-3.1, 3.1, (count, d)), np.zeros((count, d)), rng.uniform(-0.5, 0.5, (count, 2))], 1
    )
    parts = np.sort(rng.uniform(0.15, 0.97, (count, d)), axis=1)
    x[:, d : 2 * d] = np.maximum.accumulate(parts * robot.upper[d : 2 * d], axis=1) + 0.37 * np.arange(d)
    return x


def both(kind, p):
    """The objective and the constraints as a function of x."""
    value = frame(kind)[1].value
    return lambda x: np.concatenate([part.full().ravel() for part in value(x, p)])


def slopes(kind, x, p):
    """Their derivatives, (1 + m, n)."""
    _, gradient, _, jacobian = frame(kind)[1].slopes(x, p)
    return np.vstack([gradient.full().ravel(), jacobian.full()])


def assert_derivatives(exact, found):
    """Row by row."""
    for one, other in zip(exact, found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * max(1, np.abs(other).max()))


# A frame's functions


@EVERY_ROBOT
@pytest.mark.parametrize("seed", range(3))
def test_first_derivatives_match_finite_differences(kind, seed):
    """Of the objective, motors' angles, determinants and order."""
    x, p = drawn(ROBOTS[kind], seed)[0], packed(frame(kind)[0], ROBOTS[kind], seed)
    assert_derivatives(slopes(kind, x, p), central(both(kind, p), x, 1e-6))


@pytest.mark.parametrize(("kind", "beta"), [(kind, beta) for kind, some in TIES.items() for beta in some])
def test_first_derivatives_match_where_sections_vanish(kind, beta):
    """On the side where tubes end in order, by one-sided differences of order two."""
    robot, h = ROBOTS[kind], 1e-5
    d, x, p = robot.d, drawn(robot, 5)[0], packed(frame(kind)[0], robot, 5)
    x[d : 2 * d] = beta
    inwards = np.ones(len(x))
    inwards[d : 2 * d - 1][np.diff(beta) == 0] = -1
    function = both(kind, p)
    ways = [h * sign * e for sign, e in zip(inwards, np.eye(len(x)), strict=True)]
    rises = [4 * function(x + way) - 3 * function(x) - function(x + 2 * way) for way in ways]
    assert_derivatives(slopes(kind, x, p), np.stack(rises, axis=-1) / (2 * h) * inwards)


@EVERY_ROBOT
@pytest.mark.parametrize("seed", range(3))
def test_hessians_match_finite_differences_of_slopes(kind, seed):
    nlp, functions = frame(kind)
    rng, x, p = np.random.default_rng(seed), drawn(ROBOTS[kind], seed)[0], packed(nlp, ROBOTS[kind], seed)
    lam_f, lam_g = rng.uniform(0.5, 2), 100 * rng.normal(size=nlp.g.numel())

    def gradient(at):
        _, slope, _, jacobian = functions.slopes(at, p)
        return lam_f * slope.full().ravel() + jacobian.full().T @ lam_g

    *slopes, hessian = (part.full() for part in functions.expansion(x, p, lam_f, lam_g))
    found = central(gradient, x, 1e-6)
    np.testing.assert_allclose(hessian, found, rtol=1e-5, atol=1e-6 * np.abs(found).max())
    for one, other in zip(slopes, functions.slopes(x, p), strict=True):
        np.testing.assert_allclose(one, other.full(), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("lanes", [1, 8])
def test_compiled_code_is_what_is_interpreted(lanes):
    """Of the libraries that solvers of frames and of horizons use."""
    robot = ROBOTS["seed"]
    joint = FORMULATIONS["joint"](robot, Settings(), KINEMATIC_MODELS["elastic"])[0].nlp
    nlp = joint if lanes == 1 else frame("seed")[0]
    x, rng = drawn(robot, 1, lanes), np.random.default_rng(1)
    known = {
        "tubes": robot.numbers,
        "shape_roots": ShapeDistance().roots,
        "target": rng.normal(size=(21, 3)),
        "margin": MARGIN,
        "previous": rng.normal(size=8),
        "motion_root": 0.1,
    }
    p = nlp.pack({name: known[name] for name in nlp.parameters})
    inputs = [x.T, np.tile(p, (lanes, 1)).T, np.ones((1, lanes)), rng.normal(size=(nlp.g.numel(), lanes))]
    functions, fast = nlp.functions, compiled_functions.compile_functions(nlp, 1 if lanes == 1 else None)
    for name in ("value", "slopes", "expansion"):
        function = getattr(functions, name)
        given = inputs[: function.n_in()]
        expected = [part.full() for part in function.map(lanes).call([ca.DM(each) for each in given])]
        blocks = [ca.DM(each) if lanes == 1 else ca.DM(each.ravel(order="F")) for each in given]
        found = getattr(fast, name).call(
            [ca.reshape(b, *getattr(fast, name).size_in(i)) for i, b in enumerate(blocks)]
        )
        for one, other in zip(found, expected, strict=True):
            scale = np.abs(other).max()
            np.testing.assert_allclose(one.full().ravel("F"), other.ravel("F"), rtol=1e-9, atol=1e-11 * scale)


# What constraints say


@functools.cache
def values(kind):
    """Constraint values of a frame by x and parameters."""
    nlp = alone(COUPLED[kind], "elastic", True)
    return nlp, ca.Function("g", [nlp.x, nlp.p], [nlp.g], {"cse": True})


def constraints(kind, x, margin=MARGIN):
    """Values of a frame's constraints by name, (T, ..)."""
    nlp, g = values(kind)
    found = g.map(len(x))(x.T, np.tile(packed(nlp, COUPLED[kind], 0, margin), (len(x), 1)).T).full().T
    sizes = np.cumsum([constraint.value.numel() for constraint in nlp.constraints])[:-1]
    return dict(
        zip((constraint.name for constraint in nlp.constraints), np.split(found, sizes, axis=1), strict=True)
    )


@pytest.mark.parametrize("kind", COUPLED)
def test_alpha_is_that_of_the_configuration(kind):
    """To rounding with the steps that a nonlinear program takes, and nearly with those of forward solutions."""
    robot = COUPLED[kind]
    x = drawn(robot, 2, 100)
    alpha, d = constraints(kind, x)["alpha"], robot.d
    columns = [column[:, None] for column in x.T]
    twisted = torsion.twist(
        robot.tube_numbers,
        columns,
        torsion.sections(robot.tube_numbers, columns[d : 2 * d], np),
        np,
        ELASTIC_NLP_STEPS_PER_SECTION,
    )
    np.testing.assert_allclose(
        alpha, np.hstack(torsion.motors(robot.tube_numbers, columns, twisted)), rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(alpha, tracking.configuration(robot, x)[:, :d], atol=0.02)


@pytest.mark.interpreted
@pytest.mark.parametrize("margin", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("kind", COUPLED)
def test_determinants_are_allowed_where_the_margin_is_held(kind, margin):
    """But for 0.03 about the margin, where integration and Galerkin's method differ. A determinant before the last
    keeps MIN_INNER_DETERMINANT from 0, and so may forbid a little more than the margin does.
    """
    robot = COUPLED[kind]
    x = drawn(robot, 3, 250)
    margins, determinants = stability.margins(robot.tube_numbers, x), constraints(kind, x, margin)["stability"]
    held, missed = margins > margin + 0.03, margins < margin - 0.03
    assert min(held.sum(), missed.sum()) > 10
    assert (determinants[held] > 0).all()
    allowed = (determinants >= np.append(np.full(determinants.shape[1] - 1, MIN_INNER_DETERMINANT), 0)).all(axis=1)
    assert not (allowed & missed).any()


# Frame by frame


def excess(plan, order=1, before=()):
    """By how much differences of q exceed the limits of speed (1) or acceleration (2) at most."""
    most = (plan.robot.speed, plan.robot.acceleration)[order - 1] * plan.dt**order
    return float((np.abs(np.diff(np.vstack([*before, plan.q]), n=order, axis=0)) - most).max())


@functools.cache
def by_frame(name):
    return solve_per_frame(named_problem(name, 14), model="elastic")


@pytest.mark.parametrize("name", ["arc", "line"])
def test_a_motion_is_solved_within_limits_and_stable_at_every_frame(name):
    plan = by_frame(name)
    assert plan.complete
    for q in plan.q:
        plan.robot.check(q)
    assert excess(plan) <= 1e-6
    assert plan.stability.min() >= MARGIN - 1e-3
    assert plan.meta["snaps"] == []
    assert summary(plan)["e3"] < TABLE_II_PAPER_METHOD_ELASTIC[name][0]


@pytest.mark.parametrize("name", ["arc", "line"])
def test_shapes_are_those_of_the_robot_moved_through_q(name):
    plan = by_frame(name)
    moved = tracking.follow(plan.robot, plan.q)
    np.testing.assert_allclose(plan.shape, tracking.elastic_shapes(plan.robot, moved.x), atol=1e-9)
    np.testing.assert_allclose(plan.stability, moved.stability, atol=1e-9)
    np.testing.assert_allclose(plan.stability_between, moved.stability_between, atol=1e-9)


def test_a_line_is_followed_up_to_the_margin_and_the_plan_says_where():
    """Its curved tubes cannot be turned against each other as far as the line asks for."""
    plan = by_frame("line")
    binds = summary(plan)["stability_binds"]
    limited = np.concatenate([np.arange(first - 1, last) for first, last in binds])
    assert binds[-1][1] == 14
    least = np.minimum(plan.stability, plan.stability_between)
    assert least[limited].max() < MARGIN + 0.005 <= np.delete(least, limited).min()


def test_both_solvers_agree_from_the_same_frame_before():
    """IPOPT keeps mu_min from limits, 1e-9 mm^2 each, which is more than a part in a million of these errors."""
    problem = named_problem("arc", 14)
    sqp, ipopt = (NlpFrames.of(problem, "joint", solver, "elastic") for solver in ("sqp", "ipopt"))
    before = sqp.search(0)[0]
    for j in range(1, 4):
        found, other = (solver.step(j, replace(before, warm=None)) for solver in (sqp, ipopt))
        assert found.success
        assert other.success
        assert found.objective == pytest.approx(other.objective, rel=1e-6, abs=1e-8)
        np.testing.assert_allclose(found.q, other.q, atol=1e-3)
        before = found


def test_a_robot_that_stands_somewhere_starts_from_there():
    problem = named_problem("arc", 14)
    start = np.array([1.5, 2.0, 3.0, 2, 5, 9, 0.1, -0.1])
    plan = solve_per_frame(problem, model="elastic", start=start)
    assert plan.complete
    assert excess(plan, before=[start]) <= 1e-6
    free = by_frame("arc")
    assert np.abs(plan.q[0] - start).max() < np.abs(free.q[0] - start).max()


# Over a horizon


@functools.cache
def over_horizon(name, solver):
    """Of a smooth objective: where the penalty on arrival has its corner, solvers agree to 1e-4 alone."""
    start, settings = solve_per_frame(named_problem(name, 16), model="elastic"), Settings(arrival_weight=0.0)
    asked = {"solver": solver, "initial": [start.q], "motion_weight": 1e-5, "settings": settings}
    return solve_horizon(named_problem(name, 16), model="elastic", **asked)


@pytest.mark.parametrize("name", ["arc", "line_arc"])
def test_both_solvers_of_a_horizon_find_the_same_motion(name):
    banded, ipopt = (over_horizon(name, solver) for solver in ("banded", "ipopt"))
    assert banded.objective.mean() == pytest.approx(ipopt.objective.mean(), rel=1e-5)


@pytest.mark.parametrize("name", ["arc", "line_arc"])
@pytest.mark.parametrize("solver", ["banded", "ipopt"])
def test_a_horizon_is_solved_within_limits_and_stable(name, solver):
    plan = over_horizon(name, solver)
    assert plan.complete
    for q in plan.q:
        plan.robot.check(q)
    assert excess(plan) <= 1e-6
    assert plan.stability.min() >= MARGIN - 1e-3
    assert plan.stability_between.min() >= MARGIN - 0.01
    assert summary(plan)["e3"] < TABLE_II_PAPER_METHOD_ELASTIC[name][0]


def test_given_ends_are_kept_at_rest_and_accelerations_are_limited():
    """The angle of a motor at the end is the one that a nonlinear program's few steps of integration find."""
    limits = {"alpha_acceleration": 3.0, "beta_acceleration": 20.0, "theta_acceleration": 0.5}
    problem = named_problem("arc", 16)
    problem = replace(problem, robot=problem.robot.with_limits(**limits))
    start, end = np.array([3, 3, 3, 0, 2, 6, 0, 0.0]), over_horizon("arc", "banded").q[-1] + 0.01
    end[3:6] -= 1
    plan = solve_horizon(problem, model="elastic", start=start, end=end, motion_weight=1e-5)
    assert plan.complete
    np.testing.assert_allclose(plan.q[-1], end, atol=1e-4)
    np.testing.assert_array_equal(plan.q[-1, 3:], end[3:])
    resting = np.vstack([start, start, plan.q, plan.q[-1:]])
    assert (np.abs(np.diff(resting, axis=0)) <= plan.robot.speed * plan.dt + 1e-6).all()
    turns = np.abs(np.diff(resting, n=2, axis=0)) / plan.dt**2 / plan.robot.acceleration
    assert turns.max() == pytest.approx(1, abs=1e-5)


# Small robots, without a compiler


@pytest.fixture
def interpreted(monkeypatch):
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")


def along_an_arc(tubes, frames=3):
    """A robot's way along an arc of radius 60 mm."""
    path = curve_from_formula(lambda u: (60 * ca.cos(u) - 60, 0, 60 * ca.sin(u)), 0.0, 1.2)
    return Problem("arc", Robot(tubes), growing(path, frames))


def test_without_a_compiler_frames_and_horizons_are_solved(interpreted):
    problem = along_an_arc((Tube(90, 40, 0.02, 4.0, 3.2), Tube(150, 80, 0.014, 2.6, 1.6)))
    plan = solve_per_frame(problem, model="elastic", direction="backward")
    assert plan.complete
    assert plan.meta["solver"] == "ipopt"
    whole = solve_horizon(problem, model="elastic", initial=[plan.q])
    assert whole.complete
    assert whole.meta["solver"] == "ipopt"
    assert summary(whole)["e3"] < 2 * summary(plan)["e3"] + 0.1


def test_without_a_margin_nothing_is_limited_by_it(interpreted):
    """Tubes that follow a line: with the margin they stop short of where they would snap.

    Where the tip is led to the end, they turn on to where the margin is large.
    """
    path = curve_from_formula(lambda u: (0, 0, u), 0.0, 80.0)
    robot = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
    problem = Problem("straight", robot, growing(path, 3))
    plans = [
        solve_per_frame(
            problem,
            model="elastic",
            direction="forward",
            settings=Settings(stability_margin=margin, arrival_weight=0.0),
        )
        for margin in (None, 0.5)
    ]
    assert plans[1].stability.min() >= 0.5 - 1e-3
    assert [bool(summary(plan)["stability_binds"]) for plan in plans] == [False, True]
    assert plans[0].objective.mean() < plans[1].objective.mean()


def test_stiff_tubes_are_planned_as_on_the_dominant_model(interpreted):
    """Tubes that hardly twist, the outer one of which dominates."""
    stiff = {"poisson_ratio": -0.99}
    tubes = Tube(90, 40, 0.012, 4.0, 3.2, youngs_modulus=1e4, **stiff), Tube(150, 80, 0.02, 2.6, 1.6, **stiff)
    problem = along_an_arc(tubes)
    told = {"direction": "backward", "settings": Settings(arrival_weight=0.0)}
    plans = [solve_per_frame(problem, model=model, **told) for model in ("dominant", "elastic")]
    np.testing.assert_allclose(plans[1].shape, plans[0].shape, atol=0.05)
    np.testing.assert_allclose(plans[1].objective, plans[0].objective, atol=1e-2)
    assert plans[1].stability.min() > 0.98


# Names, numbers and programs


@pytest.mark.parametrize("name", ["two-stage", "two-stage-exact"])
def test_formulations_that_need_curvatures_without_alpha_refuse_the_model(name):
    with pytest.raises(OptionError, match="model is 'elastic'; two-stage formulations need 'dominant'"):
        NlpFrames.of(named_problem("arc", 2), name, model="elastic")


def test_reference_methods_plan_on_the_dominant_model_but_those_of_twisted_tubes():
    models = {name: parse_variant(name).model for name in REFERENCE_METHODS}
    twisted = ("tip-resolved", "follow-the-leader", "follow-the-leader-approximate")
    for name in (*twisted, "s2j-elastic", "s2j-projected-elastic"):
        assert models.pop(name) == "elastic"
    assert set(models.values()) == {"dominant"}


def test_variants_here_begin_with_those_on_the_elastic_model():
    assert available_variants()[:2] == ["horizon:banded:elastic", "joint:sqp:elastic"]
    assert all(parse_variant(name).name == name for name in available_variants())


@pytest.mark.parametrize("margin", [1.0, -0.1, np.nan])
def test_a_margin_that_nothing_can_have_is_refused_with_its_range(margin):
    with pytest.raises(OptionError, match=rf"stability_margin is {margin}; it must lie in \[0, 1\), or be None"):
        Settings(stability_margin=margin)


def run(program, *arguments):
    return program([str(argument) for argument in arguments])


def test_a_plan_says_where_stability_limits_it(tmp_path, capsys):
    out = tmp_path / "out"
    assert run(solve_per_frame_program, "line", "--model", "elastic", "--frames", 14, "--out", out) == 1, (
        "it cannot follow"
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert "line: joint" in printed
    assert "elastic model, solver sqp" in printed
    assert "stability (margin 0.1) limits frames" in printed
    found = json.loads((out / "summary.json").read_text())
    assert found["stability_binds"]
    assert found["stability_min"] >= MARGIN - 1e-3
    assert found["snaps"] == []
    assert (out / "stability.png").exists()


def test_a_plan_of_the_dominant_model_is_evaluated_on_the_elastic_one(tmp_path, capsys):
    out = tmp_path / "out"
    asked = "arc", "--frames", 6, "--model", "dominant", "--out", out
    assert run(solve_horizon_program, *asked) == 1
    found = json.loads((out / "summary.json").read_text())
    assert found["stability_between_min"] < 1e-3, "exactly opposed tubes come to a fork"
    assert found["verdicts"]["stable"]["word"] == "no"
    assert (found["model"], found["evaluated"]) == ("dominant", "elastic")
    with open(out / "errors.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for key, column in (("stability_min", "stability"), ("stability_between_min", "stability_between")):
        assert found[key] == pytest.approx(min(float(row[column]) for row in rows))
    plan = Plan.load(out / "plan.npz")
    moved = tracking.follow(plan.robot, plan.q)
    np.testing.assert_allclose(plan.shape, tracking.elastic_shapes(plan.robot, moved.x), atol=1e-9)
    assert len(found["snaps"]) == len(moved.snaps)
    assert "on the elastic model" in capsys.readouterr().out


def test_no_margin_may_be_asked_for(tmp_path):
    out = tmp_path / "out"
    asked = *UNJUDGED, "arc", "--model", "dominant", "--frames", 3, "--stability-margin", "none", "--out", out
    assert run(solve_horizon_program, *asked) == 0
    assert Plan.load(out / "plan.npz").meta["options"]["stability_margin"] is None


@pytest.mark.parametrize("program", [solve_per_frame_program, solve_horizon_program])
@pytest.mark.parametrize(
    ("margin", "message"), [("1", "stability_margin is 1.0"), ("nan", "stability_margin is nan")]
)
def test_programs_refuse_a_margin_before_solving(tmp_path, capsys, program, margin, message):
    out = tmp_path / "out"
    assert run(program, "arc", "--model", "elastic", "--stability-margin", margin, "--out", out) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_searches_from_far_away_end_without_another_solver():
    """Rows that pressed hard at the start must not keep steps short along curved rows for good.

    Far from the target's end, the penalty on the tip has a corner at which steps are short: there a search may end
    with another solver, but it ends.
    """
    problem = named_problem("cos")
    smooth = NlpFrames.of(problem, model="elastic", settings=Settings(arrival_weight=0.0))
    frames = NlpFrames.of(problem, model="elastic")
    for frame in (24, 49, 74, 99):
        for guess in sobol_starts(problem.robot, problem.target_frames[frame], 16):
            given = FrameResult(guess, x=frames._unknowns(guess))
            found = smooth.search_near(frame, given)
            assert found.success
            assert IPOPT_FALLBACK_TEXT not in found.status, (frame, guess, found.status)
            assert frames.search_near(frame, given).success


@pytest.mark.parametrize("turned", [0, 1])
def test_a_tube_that_a_search_turned_once_with_its_tip_is_turned_back(turned):
    """Rounding must not decide it: a whole turn is as far as the limits of what searches leave alone."""
    problem = named_problem("synthesis")
    frames = NlpFrames.of(problem, model="elastic")
    found = frames.search(problem.frames - 1)[0]
    whole = 2 * np.pi * (1 - 1e-12) * np.eye(8)[turned]
    back = frames._remove_whole_turns(replace(found, q=found.q + whole, x=found.x + whole, warm=None))
    assert abs(back.x[:2]).max() < np.pi
    np.testing.assert_allclose(back.q, found.q, atol=1e-9)


@pytest.mark.parametrize("turns", [(2, -3, 1), (0, 0, -3), (-2, -2, -2)])
def test_a_search_that_wound_up_tubes_ends_where_a_robot_comes_from_aligned_tubes(cos_problem, turns):
    """Tubes that are turned whole with their tips are in the same equilibrium."""
    frames = NlpFrames.of(cos_problem, model="elastic", settings=Settings(stability_margin=MARGIN))
    found = frames.search(0)[0]
    tips = np.array([*(turns[k] - turns[-1] for k in range(2)), turns[-1]])
    wound = replace(
        found,
        q=found.q + 2 * np.pi * np.pad(turns, (0, 5)),
        x=found.x + 2 * np.pi * np.pad(tips, (0, 5)),
        warm=None,
    )
    back = frames._remove_whole_turns(wound)
    assert abs(back.x[:2]).max() <= np.pi + 1e-9
    assert abs(back.q[2]) <= np.pi + 1e-9
    np.testing.assert_allclose(np.cos(back.q[:3]), np.cos(found.q[:3]), atol=1e-9)
    again = frames.search_near(0, back)
    assert again.objective == pytest.approx(found.objective, rel=1e-6, abs=1e-9)
    np.testing.assert_allclose(again.q, back.q, atol=1e-5)
