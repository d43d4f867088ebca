"""Random reachable targets are followed; random malformed inputs are refused; nothing else is ever raised."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from methods.comparison import parse_variant
from strategies import numbers

from ctr_nlp import (
    Curve,
    Problem,
    Robot,
    Settings,
    curve_from_formula,
    curve_from_points,
    growing,
    problem_from_file,
    read_csv,
    sequence,
    shape_curve,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.exceptions import CtrError

FRAMES = 10


def reachable(seed: int) -> Problem:
    """Ten shapes on a straight line in q between two random configurations, within a second a frame."""
    random = np.random.default_rng(seed)
    robot = table_i_robot()
    ends = [
        np.concatenate(
            [
                random.uniform(-np.pi, np.pi, robot.d),
                np.sort(random.uniform(0, 1, robot.d)) * robot.upper[robot.d : 2 * robot.d] + [0, 0, 1e-3],
                random.uniform(-1, 1, 2),
            ]
        )
        for _ in range(2)
    ]
    t = np.arange(1, FRAMES + 1)[:, None] / FRAMES
    truth = np.minimum((1 - t) * ends[0] + t * ends[1], robot.upper)
    return Problem(f"random {seed}", robot, sequence([shape_curve(robot, q) for q in truth]), truth=truth)


def assert_followed(seeds: range) -> None:
    """Every frame solved within bounds, order and speed; e3 at most 0.1 mm on at least 95 % of the targets."""
    errors = []
    for seed in seeds:
        plan = solve_per_frame(reachable(seed), model="dominant")
        robot = plan.robot
        assert plan.complete, seed
        assert (plan.q >= robot.lower - 1e-6).all(), seed
        assert (plan.q <= robot.upper + 1e-6).all(), seed
        assert (np.diff(plan.beta, axis=1) >= -1e-6).all(), seed
        assert (np.abs(np.diff(plan.q, axis=0)) <= robot.speed * plan.dt + 1e-6).all(), seed
        errors.append(summary(plan)["e3"])
    followed = np.mean(np.array(errors) <= 0.1)
    print(f"{len(errors)} targets: {100 * followed:.1f} % within 0.1 mm, worst {max(errors):.3g} mm")
    assert followed >= 0.95


def test_reachable_targets_are_followed():
    assert_followed(range(10))


def test_a_motion_that_would_run_into_the_limits_of_tilt_is_found_the_other_way_round():
    """Followed from the usual way to write its first shape, this motion needs theta_y beyond pi."""
    robot = table_i_robot()
    ends = np.array(
        [
            [-2.97, -2.21, 2.69, 6.4, 53.4, 90.2, -2.66, -2.3],
            [0.07, 1.02, -1.41, 18.5, 66.5, 142.3, -2.24, 1.79],
        ]
    )
    t = np.linspace(0.1, 1, FRAMES)[:, None]
    shapes = [shape_curve(robot, q) for q in (1 - t) * ends[0] + t * ends[1]]
    plan = solve_per_frame(Problem("tilted", robot, sequence(shapes)), model="dominant")
    assert plan.complete
    assert summary(plan)["e3"] < 0.01


@pytest.mark.slow
def test_200_reachable_targets_are_followed():
    assert_followed(range(200))


bad_numbers = st.sampled_from([math.nan, math.inf, -math.inf])
Refused = Callable[[], object]


@st.composite
def good_points(draw: st.DrawFn) -> np.ndarray:
    """A gently bent path of 5 to 40 points, 20 to 140 mm long."""
    n = draw(st.integers(5, 40))
    t = np.linspace(0, draw(numbers(20, 140)), n)
    return np.column_stack([t, draw(numbers(0, 10)) * np.sin(t / 40), 0 * t])


@st.composite
def malformed_points(draw: st.DrawFn) -> Refused:
    points = draw(good_points())
    i = draw(st.integers(0, len(points) - 2))
    kind = draw(st.sampled_from(["number", "few", "repeated", "metres", "flat", "radius", "smoothing"]))
    if kind == "number":
        points[i, draw(st.integers(0, 2))] = draw(bad_numbers)
    elif kind == "few":
        points = points[: draw(st.integers(0, 3))]
    elif kind == "repeated":
        points[i + 1] = points[i]
    elif kind == "metres":
        points = points / 1000
    elif kind == "flat":
        points = points[:, :2]
    elif kind == "radius":
        radius = np.full(len(points), 4.0)
        radius[i] = draw(st.one_of(bad_numbers, numbers(-5, 0)))
        return lambda: curve_from_points(points, radius)
    else:
        return lambda: curve_from_points(points, smoothing=draw(st.one_of(bad_numbers, numbers(-5, -0.01))))
    return lambda: curve_from_points(points)


@st.composite
def malformed_robots(draw: st.DrawFn) -> Refused:
    data = copy.deepcopy(table_i_robot().to_dict())
    tubes, limits = data["tubes"], data["limits"]
    i = draw(st.integers(0, 2))
    kind = draw(
        st.sampled_from(["order", "nest", "negative", "number", "key", "bounds", "chain", "speed", "gap", "text"])
    )
    if kind == "order":
        tubes[0], tubes[i or 1] = tubes[i or 1], tubes[0]
    elif kind == "nest":
        tubes[min(i, 1)]["inner_diameter"] = tubes[min(i, 1) + 1]["outer_diameter"] - draw(numbers(0.01, 1))
    elif kind == "negative":
        key = draw(st.sampled_from(["length", "curved_length", "curvature", "outer_diameter", "inner_diameter"]))
        tubes[i][key] = -draw(numbers(0.01, 100))
    elif kind == "number":
        tubes[i][draw(st.sampled_from(sorted(tubes[i])))] = draw(bad_numbers)
    elif kind == "key":
        tubes[i]["colour"] = "blue"
    elif kind == "bounds":
        limits[draw(st.sampled_from(["alpha", "theta"]))] = [draw(numbers(0.1, 1)), draw(numbers(-1, 0))]
    elif kind == "chain":
        limits["beta"] = [[draw(numbers(31, 50)), 50], [0, 30], [0, 150]]
    elif kind == "speed":
        limits[draw(st.sampled_from(["alpha_speed", "beta_speed", "theta_speed"]))] = draw(numbers(-5, 0))
    elif kind == "gap":
        limits["carriage_gap"] = draw(st.one_of(numbers(-5, -0.01), numbers(200, 500)))
    else:
        tubes[i]["length"] = draw(st.sampled_from(["long", [], None, {}]))
    return lambda: Robot.from_dict(data)


@st.composite
def malformed_problems(draw: st.DrawFn) -> Refused:
    robot = table_i_robot()
    path = curve_from_formula(lambda u: (0.0, 0.0, u), 0.0, 100.0)
    kind = draw(st.sampled_from(["frames", "duration", "long", "name", "weight", "variant", "piece"]))
    if kind == "frames":
        return lambda: growing(path, draw(st.one_of(st.integers(-5, 0), numbers(0.1, 9.9), st.just(True))))
    if kind == "duration":
        duration = draw(st.one_of(bad_numbers, numbers(-10, 0)))
        return lambda: Problem("p", robot, growing(path, 2), duration)
    if kind == "long":
        long = curve_from_formula(lambda u: (0.0, 0.0, u), 0.0, draw(numbers(150.8, 500)))
        return lambda: Problem("p", robot, growing(long, 2))
    if kind == "name":
        option = draw(st.sampled_from(["formulation", "solver", "model", "direction"]))
        word = draw(
            st.text(max_size=8).filter(lambda text: "-" not in text and len(text) != 4 and text != "joint")
        )
        return lambda: solve_per_frame(Problem("p", robot, growing(path, 2)), **{option: word + "?"})
    if kind == "weight":
        return lambda: Settings(motion_weight=draw(st.one_of(bad_numbers, numbers(-5, -1e-9))))
    if kind == "variant":
        return lambda: parse_variant(draw(st.text(max_size=12)) + "?")
    return lambda: path.part(draw(numbers(50, 99)), draw(st.one_of(numbers(0, 49), numbers(101, 200))))


@settings(max_examples=200)
@given(st.one_of(malformed_points(), malformed_robots(), malformed_problems()))
def test_malformed_input_is_refused_by_an_error_of_our_own(refused):
    with pytest.raises(CtrError) as caught:
        refused()
    assert len(str(caught.value)) > 15


@st.composite
def damaged_files(draw: st.DrawFn) -> bytes:
    """A good centreline file with a few bytes replaced, cut or inserted, or just any bytes."""
    rows = "\n".join(",".join(f"{x:.3f}" for x in point) for point in draw(good_points()))
    content = bytearray(b"x_mm,y_mm,z_mm\n" + rows.encode())
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(content)))
        content[at : at + draw(st.integers(0, 4))] = draw(st.binary(max_size=4))
    return draw(st.one_of(st.just(bytes(content)), st.binary(max_size=60)))


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(damaged_files())
def test_a_damaged_file_is_a_curve_or_is_refused(tmp_path, content):
    path = tmp_path / "path.csv"
    path.write_bytes(content)
    curve: Curve | None = None
    with contextlib.suppress(CtrError):
        curve = read_csv(path)
    if curve is not None:
        assert np.isfinite(curve.point(np.linspace(0, curve.length, 50))).all()


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=80))
def test_a_robot_file_of_any_bytes_is_refused(tmp_path, content):
    path = tmp_path / "robot.toml"
    path.write_bytes(content)
    with pytest.raises(CtrError, match=r"robot\.toml"):
        Robot.from_toml(path)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(CtrError, match="cannot be read"):
        problem_from_file(tmp_path / "nowhere.csv")
