"""Malformed calls from Python: each is one clear error or rightly accepted."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from malformed import Case, helix, judge, plan, table, written

from ctr_nlp import (
    Curve,
    Limits,
    Plan,
    Problem,
    Robot,
    Settings,
    Steerer,
    Target,
    Tube,
    by_frame,
    curve_from_formula,
    curve_from_points,
    growing,
    problem_from_file,
    read_csv,
    seed_robot,
    sequence,
    shape_curve,
    shapes,
    solve_horizon,
    solve_per_frame,
    summary,
)
from ctr_nlp.errors import CtrError, CurveError, OptionError, OutputError, ProblemError, RobotError
from ctr_nlp.lumen import Lumen

PATH = curve_from_points(helix(), np.full(61, 6.0))
SEED = seed_robot()
PROBLEM = Problem("helix", SEED, growing(PATH, 3))
Q = np.array([0, 0, 0, 10, 20, 30, 0, 0.0])
UNKNOWN = replace(PATH, point=lambda s: np.full((len(s), 3), math.nan))
CIRCLE = curve_from_formula(lambda u: (20 * ca.sin(u), 20 - 20 * ca.cos(u), 0), 0.0, 2 * math.pi)
FILE = table()


def balanced():
    """An inner tube that is stiffer than the outer one."""
    return Robot((Tube(90, 60, 0.01, 2.4, 2.2), Tube(150, 100, 0.012, 2.0, 1.0)))


def bad(call, error, message):
    return call, error, message


CURVES = [
    bad(lambda: curve_from_points("path"), CurveError, "points are no array of numbers"),
    bad(lambda: curve_from_points(None), CurveError, r"points have shape \(\)|points are no array"),
    bad(lambda: curve_from_points([]), CurveError, r"points have shape \(0,\)"),
    bad(lambda: curve_from_points([[1, 2, 3], [4, 5]]), CurveError, "points are no array of numbers"),
    bad(lambda: curve_from_points(helix()[:, :2]), CurveError, r"points have shape \(61, 2\); a centreline is \(n, 3\)"),
    bad(lambda: curve_from_points(helix()[:2]), CurveError, "2 points; a centreline needs at least 4"),
    bad(lambda: curve_from_points(helix()[:1]), CurveError, "1 points; a centreline needs at least 4"),
    bad(lambda: curve_from_points(helix() / 1000), CurveError, "must be in millimetres, and these look like metres"),
    bad(lambda: curve_from_points(helix() * 1e9), CurveError, "it must be at most 100000 mm"),
    bad(lambda: curve_from_points(np.where(helix() == 0, np.nan, helix())), CurveError, "point 1 is .nan"),
    bad(lambda: curve_from_points(np.repeat(helix(), 2, axis=0)), CurveError, "points 1 and 2 are the same"),
    bad(lambda: curve_from_points(helix() + 1j), CurveError, "points are no array of numbers"),
    bad(lambda: curve_from_points(helix(), radius=[1, 2]), CurveError, "lumen radii must be 61 positive finite numbers"),
    bad(lambda: curve_from_points(helix(), radius=-np.ones(61)), CurveError, "lumen radii must be 61 positive"),
    bad(lambda: curve_from_points(helix(), radius="wide"), CurveError, "lumen radii must be 61 positive"),
    bad(lambda: curve_from_points(helix(), radius=5.0), CurveError, "lumen radii must be 61 positive"),
    bad(lambda: curve_from_points(helix(), smoothing=-1), CurveError, "smoothing is -1 mm; it must be a finite"),
    bad(lambda: curve_from_points(helix(), smoothing=math.inf), CurveError, "smoothing is inf mm"),
    bad(lambda: curve_from_points(helix(), smoothing="much"), CurveError, "smoothing is 'much' mm"),
    bad(lambda: curve_from_points(helix(), smoothing=None), CurveError, "smoothing is None mm"),
    bad(lambda: curve_from_formula(lambda u: (u, 0), 0, 50), CurveError, "it must give three coordinates"),
    bad(lambda: curve_from_formula(lambda u: u, 0, 50), CurveError, "three coordinates|formula cannot be evaluated"),
    bad(lambda: curve_from_formula(lambda u: (u, math.sin(u), 0), 0, 50), CurveError, "write it with CasADi's functions, as casadi.cos"),
    bad(lambda: curve_from_formula("u, 0, 0", 0, 50), CurveError, "formula cannot be evaluated"),
    bad(lambda: curve_from_formula(lambda u: (u, 0, 0), 50, 0), CurveError, "range is .50, 0.; it must be finite and grow"),
    bad(lambda: curve_from_formula(lambda u: (u, 0, 0), 0, math.inf), CurveError, "stop of the parameter range is inf"),
    bad(lambda: curve_from_formula(lambda u: (u, 0, 0), "a", 1), CurveError, "start of the parameter range is 'a'"),
    bad(lambda: curve_from_formula(lambda u: (1, 2, 3), 0, 50), CurveError, "stands still|formula"),
    bad(lambda: curve_from_formula(lambda u: (1 / u, 0, 0), 0, 50), CurveError, "leaves the finite numbers"),
    bad(lambda: curve_from_formula(lambda u: (u, ca.SX.sym("v"), 0), 0, 50), CurveError, "depend on its argument alone"),
    bad(lambda: Curve(math.nan, PATH.point, PATH.tangent, PATH.curvature), CurveError, "length of a curve is nan mm"),
    bad(lambda: Curve(-1, PATH.point, PATH.tangent, PATH.curvature), CurveError, "length of a curve is -1 mm"),
    bad(lambda: Curve(50, helix(), PATH.tangent, PATH.curvature), CurveError, "point of a curve is .* a function of arc"),
    bad(lambda: PATH.part(5, 5), CurveError, r"piece \[5, 5\] mm"),
    bad(lambda: PATH.part(-1, 5), CurveError, r"piece \[-1, 5\] mm of a curve: it must lie within"),
    bad(lambda: PATH.part("a", 5), CurveError, "start of a piece is 'a'"),
    bad(lambda: PATH.moved(np.eye(3)), CurveError, r"transform of a curve has shape \(3, 3\); it must be \(4, 4\)"),
    bad(lambda: PATH.moved(np.diag([2.0, 1, 1, 1])), CurveError, "transform of a curve is .*; it must be rigid"),
    bad(lambda: PATH.moved("left"), CurveError, "transform of a curve is 'left'; it must be numbers"),
    bad(lambda: Lumen(np.zeros((5, 3))), CurveError, r"table of a lumen has shape \(5, 3\); it must be \(n, 4\)"),
    bad(lambda: Lumen("wide"), CurveError, "table of a lumen is 'wide'; it must be numbers"),
    bad(lambda: Lumen(np.full((5, 4), np.nan)), CurveError, "table of a lumen has nan"),
]  # fmt: skip

TARGETS = [
    bad(lambda: growing(PATH, 0), ProblemError, "frames is 0; it must be a whole number of at least 1"),
    bad(lambda: growing(PATH, 2.5), ProblemError, "frames is 2.5"),
    bad(lambda: growing(PATH, "many"), ProblemError, "frames is 'many'"),
    bad(lambda: growing(PATH, True), ProblemError, "frames is True"),
    bad(lambda: growing(helix(), 3), ProblemError, "path is .*; it must be a Curve"),
    bad(lambda: sequence([]), ProblemError, "a target with 0 frames; give at least 1"),
    bad(lambda: sequence([PATH, helix()]), ProblemError, "shape 2 is .*; it must be a Curve"),
    bad(lambda: sequence(PATH), ProblemError, "shapes of a target is .*; give a sequence"),
    bad(lambda: sequence("path"), ProblemError, "shapes of a target is 'path'; give a sequence"),
    bad(lambda: Target((PATH,), (10.0, 20.0)), ProblemError, "a target has 1 curves and 2 lengths; one each"),
    bad(lambda: Target((PATH,), (math.nan,)), ProblemError, "length 1 of a target is nan; it must be a number of mm in"),
    bad(lambda: Target((PATH,), (0.0,)), ProblemError, "length 1 of a target is 0.0"),
    bad(lambda: Target((PATH,), (500.0,)), ProblemError, "length 1 of a target is 500.0; .*the length of its curve"),
    bad(lambda: Target((PATH,), ("long",)), ProblemError, "length 1 of a target is 'long'"),
    bad(lambda: Target((3,), (10.0,)), ProblemError, "curve 1 of a target is 3; it must be a Curve"),
    bad(lambda: Problem("p", SEED, sequence([PATH, UNKNOWN])).samples, ProblemError,
        "frame 2 of the target has a point that is not finite"),
    bad(lambda: solve_per_frame(Problem("p", SEED, sequence([UNKNOWN]))), ProblemError, "frame 1 of the target"),
    bad(lambda: Problem("p", SEED, sequence([CIRCLE])).samples, None, "a closed curve is a shape too"),
    bad(lambda: Problem("p", SEED, "cos"), ProblemError, "target of a problem is 'cos'; it must be a Target"),
    bad(lambda: Problem("p", SEED, PATH), ProblemError, "target of a problem is .*; it must be a Target"),
    bad(lambda: Problem("p", "seed", growing(PATH, 3)), ProblemError, "robot of a problem is 'seed'; it must be a Robot"),
    bad(lambda: Problem(7, SEED, growing(PATH, 3)), ProblemError, "name of a problem is 7; it must be a str"),
    bad(lambda: replace(PROBLEM, duration=0), ProblemError, "duration is 0 s; it must be a finite number > 0"),
    bad(lambda: replace(PROBLEM, duration=math.nan), ProblemError, "duration is nan s"),
    bad(lambda: replace(PROBLEM, duration="long"), ProblemError, "duration is 'long' s"),
    bad(lambda: replace(PROBLEM, duration=True), ProblemError, "duration is True s"),
    bad(lambda: replace(PROBLEM, to_robot=np.eye(3)), ProblemError, r"to_robot has shape \(3, 3\); it must be \(4, 4\)"),
    bad(lambda: replace(PROBLEM, truth=np.zeros((3, 7))), ProblemError, r"truth has shape \(3, 7\); it must be \(3, 8\)"),
    bad(lambda: replace(PROBLEM, truth=np.full((3, 8), np.nan)), ProblemError, "truth has nan"),
    bad(lambda: replace(PROBLEM, lumen=replace(PATH, radius=None)), ProblemError, "lumen is a curve without a radius"),
    bad(lambda: replace(PROBLEM, lumen=5), ProblemError, "lumen is"),
    bad(lambda: Problem("p", SEED, growing(curve_from_points(helix() * 3), 3)), ProblemError, "robot reaches 150.00 mm"),
]  # fmt: skip

ROBOTS = [
    bad(lambda: Robot([]), RobotError, "a robot without tubes"),
    bad(lambda: Robot("tubes"), RobotError, "tubes of a robot are 'tubes'; give a sequence of Tube"),
    bad(lambda: Robot(None), RobotError, "tubes of a robot are None"),
    bad(lambda: Robot(SEED.tubes[0]), RobotError, "tubes of a robot are Tube"),
    bad(lambda: Robot((1, 2)), RobotError, "tubes of a robot are .1, 2."),
    bad(lambda: Robot(SEED.tubes, {"alpha": 1}), RobotError, "limits of a robot are .*; they must be Limits"),
    bad(lambda: Robot(SEED.tubes[::-1]), RobotError, "tubes 1 and 2 are in the wrong order"),
    bad(lambda: Tube(100, 50, 66.7, 2, 1), RobotError, "did you mean 1/66.7 .a radius of 66.7 mm. or 0.0667"),
    bad(lambda: Tube(100, 50, 0.2, 5.7, 4.3), RobotError, "strained by 57 %"),
    bad(lambda: Tube(100, 50, 0.081, 2, 1), RobotError, "strained by 8.1 %.*at most 0.08 per mm"),
    bad(lambda: Tube(100, 50, 0.08, 2, 1), None, "8 % is what nitinol bears"),
    bad(lambda: Robot((Tube(90, 60, 0.0, 4.0, 3.2), Tube(150, 100, 0.07, 3.0, 1.0))), RobotError,
        "tube 2 is strained by .*9|tube curvature"),
    bad(lambda: Robot((Tube(90, 60, 0.0, 4.0, 2.4), Tube(150, 100, 0.07, 2.2, 2.0))), RobotError,
        r"tube 2 is strained by 7\.\d+ % at .* nitinol bears 6 %"),
    bad(balanced, None, "balanced tubes are a robot"),
    bad(lambda: Robot.from_dict(3), RobotError, "a robot is 3; it must be a table"),
    bad(lambda: Robot.from_dict({"tubes": {}}), RobotError, "a robot needs a list of tubes"),
    bad(lambda: Robot.from_dict({3: 4}), RobotError, "unknown key '3' in a robot"),
    bad(lambda: Robot.from_toml(None), RobotError, "path is None"),
    bad(lambda: Robot.from_toml(0), RobotError, "path is 0; it must be the path of a file"),
    bad(lambda: SEED.check("q"), RobotError, "q is 'q'; it must be numbers"),
    bad(lambda: SEED.check([0, 0]), RobotError, r"q has shape \(2,\)"),
    bad(lambda: SEED.check([90, 0, 0, 10, 20, 30, 0, 0]), RobotError, "alpha_1 .*did you mean 1.571 rad .90 degrees"),
    bad(lambda: SEED.check([0, 0, 0, 10, 20, 30, 30, 0]), RobotError, "theta_x .*did you mean 0.5236 rad .30 degrees"),
    bad(lambda: SEED.check([0, 0, 0, 20, 10, 30, 0, 0]), RobotError, "beta_1 of q is 20 mm and exceeds beta_2, 10 mm"),
    bad(lambda: SEED.with_limits(gamma=3), RobotError, "unknown limit 'gamma'; allowed are alpha, beta"),
    bad(lambda: SEED.with_limits(theta=(-45, 45)), RobotError, "-45 degrees"),
    bad(lambda: SEED.with_limits(beta_speed="90"), RobotError, "beta_speed is '90'"),
    bad(lambda: SEED.with_limits(carriage_gap=True), RobotError, "carriage_gap is True"),
    bad(lambda: SEED.with_limits(alpha=[[-1, 1], [-1, 1], [-1, True]]), RobotError, "limits of alpha are"),
    bad(lambda: shapes(SEED, Q), RobotError, r"q has shape \(8,\); it must be \(n, 8\)"),
    bad(lambda: shapes(SEED, "q"), RobotError, "q is 'q'; it must be numbers"),
    bad(lambda: shapes(SEED, Q[None, :7]), RobotError, r"q has shape \(1, 7\); it must be \(n, 8\)"),
    bad(lambda: shapes("seed", Q[None]), RobotError, "robot is 'seed'; it must be a Robot"),
    bad(lambda: shapes(balanced(), np.zeros((1, 6))), OptionError, "tube 1 is not stiffer than tube 2.*--model elastic"),
    bad(lambda: shape_curve(SEED, Q[:7]), RobotError, r"q has shape \(7,\)"),
    bad(lambda: shape_curve(SEED, 0 * Q), CurveError, "length of a curve is 0.0 mm"),
    bad(lambda: shape_curve(SEED, np.nan * Q), RobotError, "q has nan at .1.; all of it must be finite"),
    bad(lambda: shape_curve(balanced(), np.array([0, 0, 10, 20, 0, 0.0])), OptionError, "--model elastic"),
]  # fmt: skip

SETTINGS = [
    bad(functools.partial(Settings, **{name: value}), OptionError, re.escape(f"{name} is {value!r}"))
    for name, values in {
        "motion_weight": (-1, math.nan, math.inf, "a", None, True),
        "jump_width": (0, -1, math.nan, "wide", None),
        "seed": ("a", -1, 1.5, 2**32, None, True),
        "stability_margin": (-0.1, 1, math.nan, "none", True),
        "clearance": (-1, math.inf, math.nan, "x", None),
        "contact_weight": (-1, math.inf, "x", [1]),
        "clearance_cost": (-0.1, math.nan, "x", None),
    }.items()
    for value in values
]

SOLVERS = [
    bad(lambda: solve_per_frame(PROBLEM, "jiont"), OptionError, "formulation is 'jiont'; it must be one of joint, two-stage"),
    bad(lambda: solve_per_frame(PROBLEM, model="foo"), OptionError, "model is 'foo'; it must be one of dominant, elastic"),
    bad(lambda: solve_per_frame(PROBLEM, model=["elastic"]), OptionError, "model is .'elastic'."),
    bad(lambda: solve_per_frame(PROBLEM, solver="foo"), OptionError, "solver is 'foo'; it must be one of"),
    bad(lambda: solve_per_frame(PROBLEM, direction="up"), OptionError, "direction is 'up'; it must be one of forward"),
    bad(lambda: solve_per_frame(PROBLEM, start=[1, 2]), RobotError, r"start has shape \(2,\)"),
    bad(lambda: solve_per_frame(PROBLEM, start="home"), RobotError, "start is 'home'; it must be numbers"),
    bad(lambda: solve_per_frame(PROBLEM, start=Q, direction="backward"), OptionError, "direction is 'backward' and a start"),
    bad(lambda: solve_per_frame(PROBLEM, start=np.nan * Q), RobotError, "alpha_1 of start is nan"),
    bad(lambda: solve_per_frame(PROBLEM, settings={"seed": 1}), OptionError, "settings is .*; it must be a Settings"),
    bad(lambda: solve_per_frame(PROBLEM, "two-stage", model="elastic"), OptionError, "two-stage formulations need 'dominant'"),
    bad(lambda: solve_per_frame("cos"), ProblemError, "problem is 'cos'; it must be a Problem"),
    bad(lambda: solve_per_frame(Problem("p", balanced(), growing(PATH, 3))), OptionError, "--model elastic"),
    bad(lambda: solve_horizon("cos"), ProblemError, "problem is 'cos'; it must be a Problem"),
    bad(lambda: solve_horizon(replace(PROBLEM, target=growing(PATH, 1))), OptionError, "frames is 1; .* at least 2"),
    bad(lambda: solve_horizon(PROBLEM, model="foo"), OptionError, "model of a horizon is 'foo'"),
    bad(lambda: solve_horizon(PROBLEM, solver="sqp"), OptionError, "solver of a horizon is 'sqp'"),
    bad(lambda: solve_horizon(PROBLEM, settings=3), OptionError, "settings is 3; it must be a Settings"),
    bad(lambda: solve_horizon(PROBLEM, starts=0), OptionError, "starts is 0"),
    bad(lambda: solve_horizon(PROBLEM, starts=1.5), OptionError, "starts is 1.5"),
    bad(lambda: solve_horizon(PROBLEM, jobs="two"), OptionError, "jobs is 'two'"),
    bad(lambda: solve_horizon(PROBLEM, motion_weight="x"), OptionError, r"motion_weight is 'x' s\^2"),
    bad(lambda: solve_horizon(PROBLEM, initial=[Q]), OptionError, r"a motion of initial has shape \(8,\); it must be \(3, 8\)"),
    bad(lambda: solve_horizon(PROBLEM, initial=["forward"]), OptionError, "initial .*'forward'"),
    bad(lambda: solve_horizon(PROBLEM, initial=3), OptionError, "initial is 3"),
    bad(lambda: solve_horizon(PROBLEM, end=[0] * 7), RobotError, r"end has shape \(7,\)"),
    bad(lambda: solve_horizon(replace(PROBLEM, duration=0.1)), ProblemError, "beta_3 may slide at 90 mm/s. Raise its speed"),
    bad(lambda: solve_horizon(Problem("p", balanced(), growing(PATH, 3))), OptionError, "--model elastic"),
    bad(lambda: Steerer(SEED, Q, 0), OptionError, "dt is 0 s; it must be a finite number > 0"),
    bad(lambda: Steerer(SEED, Q, "fast"), OptionError, "dt is 'fast' s"),
    bad(lambda: Steerer(SEED, Q[:5], 0.1), RobotError, r"q has shape \(5,\)"),
    bad(lambda: Steerer(SEED, "home", 0.1), RobotError, "q is 'home'"),
    bad(lambda: Steerer(SEED, Q, 0.1, model="foo"), OptionError, "model is 'foo'"),
    bad(lambda: Steerer(SEED, Q, 0.1, settings=3), OptionError, "settings is 3"),
    bad(lambda: Steerer("seed", Q, 0.1), RobotError, "robot is 'seed'; it must be a Robot"),
    bad(lambda: Steerer(balanced(), np.array([0, 0, 10, 20, 0, 0.0]), 0.1), OptionError, "--model elastic"),
]  # fmt: skip

PLANS = [
    bad(lambda: plan().on("foo"), OptionError, "model is 'foo'; it must be one of dominant, elastic"),
    bad(lambda: plan().on(None), OptionError, "model is None"),
    bad(lambda: plan().save("/nowhere/at/all/plan.npz"), OutputError, "plan cannot be written to /nowhere"),
    bad(lambda: plan().save(None), OutputError, "path is None"),
    bad(lambda: replace(plan(), meta=plan().meta | {"x": math.nan}).save("x.npz"), OutputError, "meta of the plan cannot"),
    bad(lambda: replace(plan(), meta=plan().meta | {"x": object()}).save("x.npz"), OutputError, "meta of the plan cannot"),
    bad(lambda: Plan.load(None), OutputError, "path is None"),
    bad(lambda: Plan.load(0), OutputError, "path is 0"),
    bad(lambda: Plan.load("/nowhere/plan.npz"), OutputError, "/nowhere/plan.npz is not a plan"),
    bad(lambda: Plan.load("/tmp"), OutputError, "/tmp is not a plan"),
    bad(lambda: Plan.load("a\0b"), OutputError, "path is 'a.x00b'"),
    bad(lambda: summary("plan"), OptionError, "plan is 'plan'; it must be a Plan"),
    bad(lambda: by_frame(None), OptionError, "plan is None; it must be a Plan"),
]  # fmt: skip

FILES = [
    (lambda path: problem_from_file(path, frames=0), ProblemError, "frames is 0"),
    (lambda path: problem_from_file(path, trim="middle"), OptionError, "trim is 'middle'; it must be 'start' or 'end'"),
    (lambda path: problem_from_file(path, robot="seed"), RobotError, "robot is 'seed'; it must be a Robot"),
    (lambda path: problem_from_file(path, duration=-1), ProblemError, "duration is -1 s"),
    (lambda path: problem_from_file(path, branch="left"), CurveError, "branch is 'left'; there is none of that name"),
    (lambda path: problem_from_file(path, branch=2), CurveError, "branch is '2'"),
    (lambda path: problem_from_file(path, entry=(1, 2)), CurveError, "entry is .1, 2.; it must be three finite numbers"),
    (lambda path: problem_from_file(path, entry="root"), CurveError, "entry is 'root'"),
    (lambda path: problem_from_file(path, entry=(500, 0, 0)), CurveError, "mm away from branch 'path'"),
    (lambda path: problem_from_file(path, entry=helix()[-1], target=helix()[0]), CurveError, "exchange the points"),
    (lambda path: problem_from_file(path, entry=helix()[5], target=helix()[5]), CurveError, "exchange the points|long"),
    (lambda path: problem_from_file(path, smoothing=-1), CurveError, "smoothing is -1 mm"),
    (lambda path: problem_from_file(path, smoothing="some"), CurveError, "smoothing is 'some' mm"),
    (lambda path: problem_from_file(path, insertion=(0, 0, 0)), OptionError, "insertion direction is"),
    (lambda path: problem_from_file(path, insertion=(0, 0, -1)), CurveError, "degrees away from where the path leads"),
    (lambda path: problem_from_file(path, tilt=30), OptionError, r"tilt is 30 rad.*did you mean 0\.5236 rad \(30 degrees"),
    (lambda path: problem_from_file(path, tilt="much"), OptionError, "tilt is 'much'"),
    (lambda path: problem_from_file(path, tilt=-0.1), OptionError, "tilt is -0.1 rad"),
    (lambda path: problem_from_file(path.with_name("none.csv")), CurveError, "none.csv cannot be read"),
    (lambda path: problem_from_file(path.parent), CurveError, "is not a known kind of file"),
    (lambda path: problem_from_file(None), CurveError, "path is None"),
    (lambda path: read_csv(path, smoothing=math.nan), CurveError, "smoothing is nan mm"),
    (lambda path: read_csv(path.parent), CurveError, "cannot be read"),
    (lambda path: read_csv(3), CurveError, "path is 3; it must be the path of a file"),
    (lambda path: problem_from_file(path, tilt=0.0), None, "no tilt at all is a limit too"),
    (lambda path: problem_from_file(path, reverse=True), None, "the path may be followed from its end"),
]  # fmt: skip


def cases():
    """All of the table."""
    tables = {"curve": CURVES, "target": TARGETS, "robot": ROBOTS, "settings": SETTINGS, "solver": SOLVERS, "plan": PLANS}
    for kind, rows in tables.items():
        for number, (call, error, message) in enumerate(rows):
            yield Case(f"{kind} {number}: {message}", lambda folder, call=call: call(), error, message)
    for number, (call, error, message) in enumerate(FILES):
        run = lambda folder, call=call: call(written(folder, "path.csv", FILE))  # noqa: E731
        yield Case(f"file {number}: {message}", run, error, message)


CASES = list(cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_malformed_call_is_one_clear_error_or_rightly_accepted(case, tmp_path):
    judge(case, tmp_path)


def test_every_error_is_one_of_ours():
    assert all(case.error is None or issubclass(case.error, CtrError) for case in CASES)
