"""Malformed curves, targets and problems from Python: each is one clear error or rightly accepted."""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from malformed import Case, helix, judge, table, written

from ctr_nlp import (
    Curve,
    Problem,
    Target,
    curve_from_formula,
    curve_from_points,
    growing,
    problem_from_file,
    read_csv,
    sequence,
    solve_per_frame,
    table_i_robot,
)
from ctr_nlp.exceptions import CurveError, OptionError, ProblemError, RobotError
from ctr_nlp.paths.lumen import Lumen

PATH = curve_from_points(helix(), np.full(61, 6.0))
SEED = table_i_robot()
PROBLEM = Problem("helix", SEED, growing(PATH, 3))
UNKNOWN = replace(PATH, point=lambda s: np.full((len(s), 3), math.nan))
CIRCLE = curve_from_formula(lambda u: (20 * ca.sin(u), 20 - 20 * ca.cos(u), 0), 0.0, 2 * math.pi)
FILE = table()

CURVES = [
    (lambda: curve_from_points("path"), CurveError, "points are no array of numbers"),
    (lambda: curve_from_points(None), CurveError, r"points have shape \(\)|points are no array"),
    (lambda: curve_from_points([]), CurveError, r"points have shape \(0,\)"),
    (lambda: curve_from_points([[1, 2, 3], [4, 5]]), CurveError, "points are no array of numbers"),
    (lambda: curve_from_points(helix()[:, :2]), CurveError,
     r"points have shape \(61, 2\); a centreline is \(n, 3\)"),
    (lambda: curve_from_points(helix()[:2]), CurveError, "points of a centreline is 2; it must be at least 4"),
    (lambda: curve_from_points(helix()[:1]), CurveError, "points of a centreline is 1; it must be at least 4"),
    (lambda: curve_from_points(helix() / 1000), CurveError, "must be in millimetres, and these look like metres"),
    (lambda: curve_from_points(helix() * 1e4), CurveError, "it must be at most 100000 mm"),
    (lambda: curve_from_points(np.where(helix() == 0, np.nan, helix())), CurveError, "point 1 is .nan"),
    (lambda: curve_from_points(np.repeat(helix(), 2, axis=0)), CurveError, "points 1 and 2 are the same"),
    (lambda: curve_from_points(helix() + 1j), CurveError, "points are no array of numbers"),
    (lambda: curve_from_points(helix(), radius=[1, 2]), CurveError,
     "lumen radii must be 61 positive finite numbers"),
    (lambda: curve_from_points(helix(), radius=-np.ones(61)), CurveError, "lumen radii must be 61 positive"),
    (lambda: curve_from_points(helix(), radius="wide"), CurveError, "lumen radii must be 61 positive"),
    (lambda: curve_from_points(helix(), radius=5.0), CurveError, "lumen radii must be 61 positive"),
    (lambda: curve_from_points(helix(), smoothing=-1), CurveError, "smoothing is -1 mm; it must be a finite"),
    (lambda: curve_from_points(helix(), smoothing=math.inf), CurveError, "smoothing is inf mm"),
    (lambda: curve_from_points(helix(), smoothing="much"), CurveError, "smoothing is 'much' mm"),
    (lambda: curve_from_points(helix(), smoothing=None), CurveError, "smoothing is None mm"),
    (lambda: curve_from_formula(lambda u: (u, 0), 0, 50), CurveError, "it must give three coordinates"),
    (lambda: curve_from_formula(lambda u: u, 0, 50), CurveError, "three coordinates|formula cannot be evaluated"),
    (lambda: curve_from_formula(lambda u: (u, math.sin(u), 0), 0, 50), CurveError,
     "write it with CasADi's functions, as casadi.cos"),
    (lambda: curve_from_formula("u, 0, 0", 0, 50), CurveError, "formula cannot be evaluated"),
    (lambda: curve_from_formula(lambda u: (u, 0, 0), 50, 0), CurveError,
     "range is .50, 0.; it must be finite and grow"),
    (lambda: curve_from_formula(lambda u: (u, 0, 0), 0, math.inf), CurveError,
     "stop of the parameter range is inf"),
    (lambda: curve_from_formula(lambda u: (u, 0, 0), "a", 1), CurveError, "start of the parameter range is 'a'"),
    (lambda: curve_from_formula(lambda u: (1, 2, 3), 0, 50), CurveError, "stands still|formula"),
    (lambda: curve_from_formula(lambda u: (1 / u, 0, 0), 0, 50), CurveError, "leaves the finite numbers"),
    (lambda: curve_from_formula(lambda u: (u, ca.SX.sym("v"), 0), 0, 50), CurveError,
     "depend on its argument alone"),
    (lambda: Curve(math.nan, PATH.point, PATH.tangent, PATH.curvature), CurveError, "length of a curve is nan mm"),
    (lambda: Curve(-1, PATH.point, PATH.tangent, PATH.curvature), CurveError, "length of a curve is -1 mm"),
    (lambda: Curve(50, helix(), PATH.tangent, PATH.curvature), CurveError,
     "point of a curve is .* a function of arc"),
    (lambda: PATH.part(5, 5), CurveError, "start and stop of a piece of a curve are 5 and 5 mm"),
    (lambda: PATH.part(-1, 5), CurveError, "a curve are -1 and 5 mm; they must grow and lie within"),
    (lambda: PATH.part("a", 5), CurveError, "start of a piece is 'a'"),
    (lambda: PATH.apply_transform(np.eye(3)), CurveError, r"transform of a curve has shape \(3, 3\); it must "
                                                          r"be \(4, 4\)"),
    (lambda: PATH.apply_transform(np.diag([2.0, 1, 1, 1])), CurveError, "transform of a curve is .*; it must "
                                                                        "be rigid"),
    (lambda: PATH.apply_transform(np.diag([1.0, -1, 1, 1])), CurveError, "transform of a curve is .*, which "
                                                                         "mirrors"),
    (lambda: PATH.apply_transform("left"), CurveError, "transform of a curve is 'left'; it must be numbers"),
    (lambda: Lumen(np.zeros((5, 3))), CurveError, r"table of a lumen has shape \(5, 3\); it must be \(n, 4\)"),
    (lambda: Lumen(np.zeros((5, 4))), CurveError, "radius of a lumen is 0 mm; it must be positive"),
    (lambda: Lumen(np.ones((1, 4))), CurveError, "table of a lumen has 1 points"),
    (lambda: Lumen(np.ones((5, 4))), CurveError, "table of a lumen has 5 points; .* none repeated"),
    (lambda: Lumen("wide"), CurveError, "table of a lumen is 'wide'; it must be numbers"),
    (lambda: Lumen(np.full((5, 4), np.nan)), CurveError, "table of a lumen has nan"),
]  # fmt: skip

TARGETS = [
    (lambda: growing(PATH, 0), ProblemError, "frames is 0; it must be a whole number of at least 1"),
    (lambda: growing(PATH, 2.5), ProblemError, "frames is 2.5"),
    (lambda: growing(PATH, "many"), ProblemError, "frames is 'many'"),
    (lambda: growing(PATH, True), ProblemError, "frames is True"),
    (lambda: growing(helix(), 3), ProblemError, "path is .*; it must be a Curve"),
    (lambda: sequence([]), ProblemError, "a target has no frames; give at least one"),
    (lambda: sequence([PATH, helix()]), ProblemError, "shape 2 is .*; it must be a Curve"),
    (lambda: sequence(PATH), ProblemError, "shapes of a target is .*; give a sequence"),
    (lambda: sequence("path"), ProblemError, "shapes of a target is 'path'; give a sequence"),
    (lambda: Target((PATH,), (10.0, 20.0)), ProblemError,
     "curves of a target is 1 and that of its lengths 2; they must be equal"),
    (lambda: Target((PATH,), (math.nan,)), ProblemError,
     "length 1 of a target is nan; it must be a number of mm in"),
    (lambda: Target((PATH,), (0.0,)), ProblemError, "length 1 of a target is 0.0"),
    (lambda: Target((PATH,), (500.0,)), ProblemError, "length 1 of a target is 500.0; .*the length of its curve"),
    (lambda: Target((PATH,), ("long",)), ProblemError, "length 1 of a target is 'long'"),
    (lambda: Target((3,), (10.0,)), ProblemError, "curve 1 of a target is 3; it must be a Curve"),
    (lambda: Problem("p", SEED, sequence([PATH, UNKNOWN])).target_frames, ProblemError,
        "point of frame 2 of the target has nan at .1, 1.; all of it must be finite"),
    (lambda: solve_per_frame(Problem("p", SEED, sequence([UNKNOWN]))), ProblemError, "frame 1 of the target"),
    (lambda: Problem("p", SEED, sequence([CIRCLE])).target_frames, None, "a closed curve is a shape too"),
    (lambda: sequence([replace(PATH, point=lambda s: PATH.point(s)[:, :2])]).sample(), ProblemError,
     r"point of frame 1 of the target has shape \(101, 2\); it must be \(101, 3\)"),
    (lambda: sequence([replace(PATH, curvature=lambda s: 0.0)]).sample()[0].turning, ProblemError,
     r"curvature of frame 1 of the target has shape \(\); it must be \(800,\)"),
    (lambda: sequence([replace(PATH, radius=lambda s: np.nan * s)]).sample(), ProblemError,
     "radius of frame 1 of the target has nan"),
    (lambda: sequence([replace(PATH, point=lambda s: 2 * PATH.point(s))]).sample(), ProblemError,
     "frame 1 of the target has .* it turns back on itself"),
    (lambda: Problem("p", SEED, "cos"), ProblemError, "target of a problem is 'cos'; it must be a Target"),
    (lambda: Problem("p", SEED, PATH), ProblemError, "target of a problem is .*; it must be a Target"),
    (lambda: Problem("p", "seed", growing(PATH, 3)), ProblemError,
     "robot of a problem is 'seed'; it must be a Robot"),
    (lambda: Problem(7, SEED, growing(PATH, 3)), ProblemError, "name of a problem is 7; it must be a str"),
    (lambda: replace(PROBLEM, duration=0), ProblemError, "duration is 0 s; it must be a finite number > 0"),
    (lambda: replace(PROBLEM, duration=math.nan), ProblemError, "duration is nan s"),
    (lambda: replace(PROBLEM, duration="long"), ProblemError, "duration is 'long' s"),
    (lambda: replace(PROBLEM, duration=True), ProblemError, "duration is True s"),
    (lambda: replace(PROBLEM, to_robot=np.eye(3)), ProblemError,
     r"to_robot has shape \(3, 3\); it must be \(4, 4\)"),
    (lambda: replace(PROBLEM, truth=np.zeros((3, 7))), ProblemError,
     r"truth has shape \(3, 7\); it must be \(3, 8\)"),
    (lambda: replace(PROBLEM, truth=np.full((3, 8), np.nan)), ProblemError, "truth has nan"),
    (lambda: replace(PROBLEM, lumen=replace(PATH, radius=None)), ProblemError,
     "lumen is a curve without a radius"),
    (lambda: replace(PROBLEM, lumen=5), ProblemError, "lumen is"),
    (lambda: Problem("p", SEED, growing(curve_from_points(helix() * 3), 3)), ProblemError,
     "robot reaches 150.00 mm"),
]  # fmt: skip

FILES = [
    (lambda path: problem_from_file(path, frames=0), ProblemError, "frames is 0"),
    (lambda path: problem_from_file(path, trim="middle"), OptionError,
     "trim is 'middle'; it must be 'start' or 'end'"),
    (lambda path: problem_from_file(path, robot="seed"), RobotError, "robot is 'seed'; it must be a Robot"),
    (lambda path: problem_from_file(path, duration=-1), ProblemError, "duration is -1 s"),
    (lambda path: problem_from_file(path, branch="left"), CurveError,
     "branch is 'left'; there is none of that name"),
    (lambda path: problem_from_file(path, branch=2), CurveError, "branch is '2'"),
    (lambda path: problem_from_file(path, entry=(1, 2)), CurveError,
     "entry is .1, 2.; it must be three finite numbers"),
    (lambda path: problem_from_file(path, entry="root"), CurveError, "entry is 'root'"),
    (lambda path: problem_from_file(path, entry=(500, 0, 0)), CurveError, "mm away from branch 'path'"),
    (lambda path: problem_from_file(path, entry=helix()[-1], target=helix()[0]), CurveError,
     "exchange the points"),
    (lambda path: problem_from_file(path, entry=helix()[5], target=helix()[5]), CurveError,
     "exchange the points|long"),
    (lambda path: problem_from_file(path, smoothing=-1), CurveError, "smoothing is -1 mm"),
    (lambda path: problem_from_file(path, smoothing="some"), CurveError, "smoothing is 'some' mm"),
    (lambda path: problem_from_file(path, insertion=(0, 0, 0)), OptionError, "insertion direction is"),
    (lambda path: problem_from_file(path, insertion=(0, 0, -1)), CurveError,
     "degrees away from where the path leads"),
    (lambda path: problem_from_file(path, tilt=30), OptionError,
     r"tilt is 30 rad.*did you mean 0\.5236 rad \(30 degrees"),
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
    for kind, rows in {"curve": CURVES, "target": TARGETS}.items():
        for number, (call, error, message) in enumerate(rows):
            yield Case(f"{kind} {number}: {message}", lambda folder, call=call: call(), error, message)
    for number, (call, error, message) in enumerate(FILES):
        run = lambda folder, call=call: call(written(folder, "path.csv", FILE))  # noqa: E731
        yield Case(f"file {number}: {message}", run, error, message)


CASES = list(cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_malformed_call_is_one_clear_error_or_rightly_accepted(case, tmp_path):
    judge(case, tmp_path)
