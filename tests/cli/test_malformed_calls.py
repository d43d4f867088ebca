"""Malformed robots, settings, searches and plans from Python: each is one clear error or rightly accepted."""

from __future__ import annotations

import functools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from malformed import Case, helix, judge, plan

from ctr_nlp import (
    Plan,
    Problem,
    Robot,
    Settings,
    Steerer,
    Tube,
    by_frame,
    curve_from_points,
    growing,
    shape_curve,
    shapes,
    solve_horizon,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.exceptions import CurveError, OptionError, OutputError, ProblemError, RobotError

PATH = curve_from_points(helix(), np.full(61, 6.0))
SEED = table_i_robot()
PROBLEM = Problem("helix", SEED, growing(PATH, 3))
Q = np.array([0, 0, 0, 10, 20, 30, 0, 0.0])


def balanced():
    """An inner tube that is stiffer than the outer one."""
    return Robot((Tube(90, 60, 0.01, 2.4, 2.2), Tube(150, 100, 0.012, 2.0, 1.0)))


ROBOTS = [
    (lambda: Robot([]), RobotError, "a robot has no tubes"),
    (lambda: Robot("tubes"), RobotError, "tubes of a robot are 'tubes'; give a sequence of Tube"),
    (lambda: Robot(None), RobotError, "tubes of a robot are None"),
    (lambda: Robot(SEED.tubes[0]), RobotError, "tubes of a robot are Tube"),
    (lambda: Robot((1, 2)), RobotError, "tubes of a robot are .1, 2."),
    (lambda: Robot(SEED.tubes, {"alpha": 1}), RobotError, "limits of a robot are .*; they must be Limits"),
    (lambda: Robot(SEED.tubes[::-1]), RobotError, "tubes 1 and 2 are in the wrong order"),
    (lambda: Tube(100, 50, 66.7, 2, 1), RobotError, "did you mean 1/66.7 .a radius of 66.7 mm. or 0.0667"),
    (lambda: Tube(100, 50, 0.2, 5.7, 4.3), RobotError, "strained by 57 %"),
    (lambda: Tube(100, 50, 0.081, 2, 1), RobotError, "strained by 8.1 %.*at most 0.08 per mm"),
    (lambda: Tube(100, 50, 0.08, 2, 1), None, "8 % is what nitinol bears"),
    (lambda: Robot((Tube(90, 60, 0.0, 4.0, 3.2), Tube(150, 100, 0.07, 3.0, 1.0))), RobotError,
        "tube 2 is strained by .*9|tube curvature"),
    (lambda: Robot((Tube(90, 60, 0.0, 4.0, 2.4), Tube(150, 100, 0.07, 2.2, 2.0))), RobotError,
        r"tube 2 is strained by 7\.\d+ % at .* nitinol allows 6 %"),
    (balanced, None, "balanced tubes are a robot"),
    (lambda: Robot.from_dict(3), RobotError, "a robot is 3; it must be a table"),
    (lambda: Robot.from_dict({"tubes": {}}), RobotError, "a robot needs a list of tubes"),
    (lambda: Robot.from_dict({3: 4}), RobotError, "key '3' is unknown in a robot"),
    (lambda: Robot.from_toml(None), RobotError, "path is None"),
    (lambda: Robot.from_toml(0), RobotError, "path is 0; it must be the path of a file"),
    (lambda: SEED.check("q"), RobotError, "q is 'q'; it must be numbers"),
    (lambda: SEED.check([0, 0]), RobotError, r"q has shape \(2,\)"),
    (lambda: SEED.check([90, 0, 0, 10, 20, 30, 0, 0]), RobotError, "alpha_1 .*did you mean 1.571 rad .90 degrees"),
    (lambda: SEED.check([0, 0, 0, 10, 20, 30, 30, 0]), RobotError,
     "theta_x .*did you mean 0.5236 rad .30 degrees"),
    (lambda: SEED.check([0, 0, 0, 20, 10, 30, 0, 0]), RobotError,
     "beta_1 of q is 20 mm and exceeds beta_2, 10 mm"),
    (lambda: SEED.with_limits(gamma=3), RobotError, "limit 'gamma' is unknown; allowed are alpha, beta"),
    (lambda: SEED.with_limits(theta=(-45, 45)), RobotError, "-45 degrees"),
    (lambda: SEED.with_limits(beta_speed="fast"), RobotError, "beta_speed is 'fast'"),
    (lambda: SEED.with_limits(beta_speed="90"), None, "text that reads as a number is one"),
    (lambda: SEED.with_limits(carriage_gap=True), RobotError, "carriage_gap is True"),
    (lambda: SEED.with_limits(alpha=[[-1, 1], [-1, 1], [-1, True]]), RobotError, "limits of alpha are"),
    (lambda: shapes(SEED, Q), RobotError, r"q has shape \(8,\); it must be \(n, 8\)"),
    (lambda: shapes(SEED, "q"), RobotError, "q is 'q'; it must be numbers"),
    (lambda: shapes(SEED, Q[None, :7]), RobotError, r"q has shape \(1, 7\); it must be \(n, 8\)"),
    (lambda: shapes("seed", Q[None]), RobotError, "robot is 'seed'; it must be a Robot"),
    (lambda: shapes(balanced(), np.zeros((1, 6))), OptionError,
     "tube 1 is not stiffer than tube 2.*--model elastic"),
    (lambda: shape_curve(SEED, Q[:7]), RobotError, r"q has shape \(7,\)"),
    (lambda: shape_curve(SEED, 0 * Q), CurveError, "length of a curve is 0.0 mm"),
    (lambda: shape_curve(SEED, np.nan * Q), RobotError, "q has nan at .1.; all of it must be finite"),
    (lambda: shape_curve(balanced(), np.array([0, 0, 10, 20, 0, 0.0])), OptionError, "--model elastic"),
]  # fmt: skip

SETTINGS = [
    (functools.partial(Settings, **{name: value}), OptionError, re.escape(f"{name} is {value!r}"))
    for name, values in {
        "motion_weight": (-1, math.nan, math.inf, "a", None, True),
        "jump_width": (0, -1, math.nan, "wide", None),
        "seed": ("a", -1, 1.5, 2**32, None, True),
        "stability_margin": (-0.1, 1, math.nan, "none", True),
        "clearance": (-1, math.inf, math.nan, "x", None),
        "contact_weight": (-1, math.inf, "x", [1]),
        "arrival_weight": (-1, math.inf, "x", [1]),
    }.items()
    for value in values
]

SOLVERS = [
    (lambda: solve_per_frame(PROBLEM, "jiont"), OptionError,
     "formulation is 'jiont'; it must be one of joint, two-stage"),
    (lambda: solve_per_frame(PROBLEM, model="foo"), OptionError,
     "model is 'foo'; it must be one of dominant, elastic"),
    (lambda: solve_per_frame(PROBLEM, model=["elastic"]), OptionError, "model is .'elastic'."),
    (lambda: solve_per_frame(PROBLEM, solver="foo"), OptionError, "solver is 'foo'; it must be one of"),
    (lambda: solve_per_frame(PROBLEM, direction="up"), OptionError,
     "direction is 'up'; it must be one of forward"),
    (lambda: solve_per_frame(PROBLEM, start=[1, 2]), RobotError, r"start has shape \(2,\)"),
    (lambda: solve_per_frame(PROBLEM, start="home"), RobotError, "start is 'home'; it must be numbers"),
    (lambda: solve_per_frame(PROBLEM, start=Q, direction="backward"), OptionError,
     "direction is 'backward' and a start"),
    (lambda: solve_per_frame(PROBLEM, start=np.nan * Q), RobotError, "alpha_1 of start is nan"),
    (lambda: solve_per_frame(PROBLEM, settings={"seed": 1}), OptionError, "settings is .*; it must be a Settings"),
    (lambda: solve_per_frame(PROBLEM, "two-stage", model="elastic"), OptionError,
     "two-stage formulations need 'dominant'"),
    (lambda: solve_per_frame("cos"), ProblemError, "problem is 'cos'; it must be a Problem"),
    (lambda: solve_per_frame(Problem("p", balanced(), growing(PATH, 3)), model="dominant"), OptionError,
     "--model elastic"),
    (lambda: solve_horizon("cos"), ProblemError, "problem is 'cos'; it must be a Problem"),
    (lambda: solve_horizon(replace(PROBLEM, target=growing(PATH, 1))), OptionError, "frames is 1; .* at least 2"),
    (lambda: solve_horizon(PROBLEM, model="foo"), OptionError, "model of a horizon is 'foo'"),
    (lambda: solve_horizon(PROBLEM, solver="sqp"), OptionError, "solver of a horizon is 'sqp'"),
    (lambda: solve_horizon(PROBLEM, settings=3), OptionError, "settings is 3; it must be a Settings"),
    (lambda: solve_horizon(PROBLEM, starts=0), OptionError, "starts is 0"),
    (lambda: solve_horizon(PROBLEM, starts=1.5), OptionError, "starts is 1.5"),
    (lambda: solve_horizon(PROBLEM, jobs="two"), OptionError, "jobs is 'two'"),
    (lambda: solve_horizon(PROBLEM, motion_weight="x"), OptionError, r"motion_weight is 'x' s\^2"),
    (lambda: solve_horizon(PROBLEM, initial=[Q]), OptionError,
     r"a motion of initial has shape \(8,\); it must be \(3, 8\)"),
    (lambda: solve_horizon(PROBLEM, initial=["forward"]), OptionError, "initial .*'forward'"),
    (lambda: solve_horizon(PROBLEM, initial=3), OptionError, "initial is 3"),
    (lambda: solve_horizon(PROBLEM, end=[0] * 7), RobotError, r"end has shape \(7,\)"),
    (lambda: solve_horizon(replace(PROBLEM, duration=0.1)), ProblemError,
     "beta_3 may slide at 90 mm/s. Raise its speed"),
    (lambda: solve_horizon(Problem("p", balanced(), growing(PATH, 3)), model="dominant"), OptionError,
     "--model elastic"),
    (lambda: Steerer(SEED, Q, 0), OptionError, "dt is 0 s; it must be a finite number > 0"),
    (lambda: Steerer(SEED, Q, "fast"), OptionError, "dt is 'fast' s"),
    (lambda: Steerer(SEED, Q[:5], 0.1), RobotError, r"q has shape \(5,\)"),
    (lambda: Steerer(SEED, "home", 0.1), RobotError, "q is 'home'"),
    (lambda: Steerer(SEED, Q, 0.1, model="foo"), OptionError, "model is 'foo'"),
    (lambda: Steerer(SEED, Q, 0.1, settings=3), OptionError, "settings is 3"),
    (lambda: Steerer("seed", Q, 0.1), RobotError, "robot is 'seed'; it must be a Robot"),
    (lambda: Steerer(balanced(), np.array([0, 0, 10, 20, 0, 0.0]), 0.1, model="dominant"), OptionError,
     "--model elastic"),
]  # fmt: skip

PLANS = [
    (lambda: plan().evaluate_on("foo"), OptionError, "model is 'foo'; it must be one of dominant, elastic"),
    (lambda: plan().evaluate_on(None), OptionError, "model is None"),
    (lambda: plan().save("/nowhere/at/all/plan.npz"), OutputError, "plan cannot be written to /nowhere"),
    (lambda: plan().save(None), OutputError, "path is None"),
    (lambda: replace(plan(), meta=plan().meta | {"x": math.nan}).save("x.npz"), OutputError,
     "meta of the plan cannot"),
    (lambda: replace(plan(), meta=plan().meta | {"x": object()}).save("x.npz"), OutputError,
     "meta of the plan cannot"),
    (lambda: Plan.load(None), OutputError, "path is None"),
    (lambda: Plan.load(0), OutputError, "path is 0"),
    (lambda: Plan.load("/nowhere/plan.npz"), OutputError, "plan /nowhere/plan.npz cannot be read: No such file"),
    (lambda: Plan.load("/tmp"), OutputError, "plan /tmp cannot be read: Is a directory"),
    (lambda: Plan.load("a\0b"), OutputError, "path is 'a.x00b'"),
    (lambda: summary("plan"), OptionError, "plan is 'plan'; it must be a Plan"),
    (lambda: by_frame(None), OptionError, "plan is None; it must be a Plan"),
]  # fmt: skip


def cases():
    """All of the table."""
    tables = {"robot": ROBOTS, "settings": SETTINGS, "solver": SOLVERS, "plan": PLANS}
    for kind, rows in tables.items():
        for number, (call, error, message) in enumerate(rows):
            yield Case(f"{kind} {number}: {message}", lambda folder, call=call: call(), error, message)


CASES = list(cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_malformed_call_is_one_clear_error_or_rightly_accepted(case, tmp_path):
    judge(case, tmp_path)
