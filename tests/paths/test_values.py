"""Problems, curves, robots and settings are values: copies of any kind are equal to what they are copies of."""

from __future__ import annotations

import copy
import json
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import casadi as ca
import numpy as np
import pytest
from malformed import helix

from ctr_nlp import (
    Curve,
    Problem,
    Settings,
    curve_from_formula,
    curve_from_points,
    growing,
    problem_from_file,
    sequence,
    shape_curve,
    table_i_robot,
)
from ctr_nlp.exceptions import CurveError, OutputError, ProblemError

ROBOT = table_i_robot()
Q = np.array([0.1, 0.2, 0.3, 10, 20, 30, 0.1, 0.0])


def formula(scale: float = 0.044) -> Curve:
    return curve_from_formula(lambda u: (10 * ca.cos(scale * u) - 10, ca.if_else(u > 50, 0.0, 0.0), u), 0.0, 140.0)


def points(radius: float | None = 6.0) -> Curve:
    return curve_from_points(helix(), None if radius is None else np.full(61, radius))


PROBLEMS = {
    "formula": lambda: Problem("formula", ROBOT, growing(formula(), 3), truth=np.full((3, 8), 0.5)),
    "points": lambda: Problem("points", ROBOT, growing(points(), 3), to_robot=np.eye(4)),
    "smoothed": lambda: Problem("smoothed", ROBOT, growing(points().smooth(0.5), 3)),
    "pieces": lambda: Problem(
        "pieces", ROBOT, growing(points().reverse_direction().part(2, 40).apply_transform(np.eye(4)), 3)
    ),
    "shapes": lambda: Problem("shapes", ROBOT, sequence([shape_curve(ROBOT, Q), shape_curve(ROBOT, Q * 1.01)])),
}


@pytest.fixture(params=PROBLEMS)
def problem(request):
    return PROBLEMS[request.param]()


def same_samples(one: Problem, other: Problem) -> bool:
    pairs = zip(one.target_frames, other.target_frames, strict=True)
    return all(a == b and a.points.tobytes() == b.points.tobytes() for a, b in pairs)


def test_copies_are_equal_and_say_the_same_to_the_last_bit(problem, tmp_path):
    problem.save(tmp_path / "problem.npz")
    loaded = Problem.load(tmp_path / "problem.npz")
    for again in (pickle.loads(pickle.dumps(problem)), copy.copy(problem), copy.deepcopy(problem), loaded):
        assert again == problem
        assert again is not problem
        assert same_samples(again, problem)
        assert repr(again) == repr(problem)
        assert (again.lumen is again.target.curves[0]) == (problem.lumen is problem.target.curves[0])
    with pytest.raises(TypeError, match="unhashable"):
        hash(problem)


def test_another_process_has_equal_ones():
    every = [make() for make in PROBLEMS.values()] + [ROBOT, Settings(contact_weight=7.0)]
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        for one, other in zip(every, pool.map(copy.copy, every), strict=True):
            assert one == other


@pytest.mark.parametrize(
    "other",
    [
        lambda p: replace(p, name="other"),
        lambda p: replace(p, duration=9.0),
        lambda p: replace(p, truth=None),
        lambda p: replace(p, truth=np.full((3, 8), 0.25)),
        lambda p: replace(p, to_robot=np.eye(4)),
        lambda p: replace(p, robot=ROBOT.with_locked_tilt()),
        lambda p: replace(p, target=growing(formula(0.045), 3)),
        lambda p: replace(p, lumen=points()),
        lambda p: p[:2],
        lambda p: "formula",
    ],
)
def test_what_differs_in_anything_is_not_equal(other):
    problem = PROBLEMS["formula"]()
    assert problem != other(problem)


def test_curves_tell_their_makers_apart():
    assert formula() == formula()
    assert formula() != formula(0.045)
    assert points() == points()
    assert points() != points(5.0)
    assert points() != points().reverse_direction()
    assert points().part(1, 9) == points().part(1, 9) != points().part(2, 10)
    assert shape_curve(ROBOT, Q) != shape_curve(ROBOT, -Q[::1] * [-1, 1, 1, -1, -1, -1, 1, 1])
    assert hash(ROBOT) == hash(table_i_robot())
    assert hash(Settings()) == hash(Settings())


def test_a_curve_of_the_users_own_functions_is_equal_to_itself_and_refused_by_files(tmp_path):
    path = points()
    own = Curve(path.length, lambda s: path.point(s), path.tangent, path.curvature)
    problem = Problem("own", ROBOT, growing(own, 2))
    assert problem == copy.deepcopy(problem)
    with pytest.raises(OutputError, match="not made by this library"):
        problem.save(tmp_path / "p.npz")
    assert not list(tmp_path.iterdir())


def test_a_formula_is_kept_to_the_last_bit():
    def written(u):
        return 20 * ca.sin(u / 40) ** 2, ca.fmax(u / 9, ca.sqrt(1 + u)) + ca.exp(-u / 50), ca.atan2(u, 3) + u - 0.5

    u = np.linspace(0, 100, 37)
    symbol = ca.SX.sym("u")
    x = ca.vertcat(*written(symbol))
    orders = [x, ca.jacobian(x, symbol), ca.jacobian(ca.jacobian(x, symbol), symbol)]
    kept = curve_from_formula(written, 0.0, 100.0).point.__self__.x
    for order, expression in enumerate(orders):
        meant = ca.Function("d", [symbol], [expression])(u[None]).full().T
        np.testing.assert_allclose(kept.derivative(u, order), meant, rtol=1e-15, atol=0)


def test_a_formula_with_a_function_kept_apart_is_refused():
    v = ca.SX.sym("v")
    apart = ca.Function("apart", [v], [ca.sin(v)], {"never_inline": True})
    with pytest.raises(CurveError, match="never_inline"):
        curve_from_formula(lambda u: (apart(u), 0, u), 0.0, 100.0)


def test_some_frames_of_a_problem_keep_its_pace():
    problem = PROBLEMS["formula"]()
    some = problem[1:]
    assert some.frames == 2
    assert some.dt == pytest.approx(problem.dt)
    assert same_samples(some, replace(problem, target=problem.target[1:], truth=None))
    assert (some.truth == 0.5).all()
    for wrong in (slice(2, 2), slice(0, 3, 2), 1):
        with pytest.raises(ProblemError, match=r"\[first:stop\]"):
            problem[wrong]


def test_what_a_problem_says_of_itself():
    problem = PROBLEMS["points"]()
    assert (
        repr(problem)
        == f"Problem(points: 3 frames in 10 s, up to {problem.target.lengths[-1]:.1f} mm, 3 tubes, within a lumen)"
    )
    html = replace(problem, name="<b>&")._repr_html_()
    assert "&lt;b&gt;&amp;" in html
    assert html.count("<polyline") == 6
    assert "6.00 mm" in html
    assert "nan" not in html


def test_a_problem_from_a_file_is_a_value(shared_data, tmp_path):
    problem = problem_from_file(
        next(iter(sorted((shared_data / "airways").glob("*.csv")))), frames=2, trim="start"
    )
    problem.save(tmp_path / "p.npz")
    assert Problem.load(tmp_path / "p.npz") == problem == pickle.loads(pickle.dumps(problem))


@pytest.mark.parametrize("damage", [b"", b"PK", b"not"])
def test_a_damaged_problem_is_one_clear_line(damage, tmp_path):
    (tmp_path / "p.npz").write_bytes(damage)
    with pytest.raises(OutputError, match="is not a problem"):
        Problem.load(tmp_path / "p.npz")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda told: told.update(format=9), "this version reads 1"),
        (lambda told: told.update(problem=3), "it holds 3"),
        (lambda told: told["table"].insert(0, {"kind": "os.system", "fields": {}}), "'os.system' is unknown"),
        (lambda told: told.update(problem={"of": told["problem"], "method": "__reduce__"}), "may name"),
        (lambda told: told["table"].clear(), "damaged"),
    ],
)
def test_a_file_cannot_ask_for_anything_else(change, why, tmp_path):
    PROBLEMS["formula"]().save(tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz") as data:
        arrays = dict(data)
    told = json.loads(str(arrays.pop("meta")))
    change(told)
    np.savez(tmp_path / "p.npz", meta=np.array(json.dumps(told)), **arrays)
    with pytest.raises(OutputError, match=why):
        Problem.load(tmp_path / "p.npz")
