"""Targets, their samples, and the problems that hold them."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from scipy.integrate import quad
from strategies import robots_with_q

from ctr_nlp import Problem, curve_from_formula, growing, problem_from_file, sequence, shape_curve, table_i_robot
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID, Target

OFF_GRID = np.linspace(0, 1, 733)


def cosine_path():
    return curve_from_formula(lambda u: (10 * ca.cos(0.044 * u) - 10, 0, u), 0.0, 45.45 * math.pi)


def line(length):
    return curve_from_formula(lambda u: (0, 0.6 * u, 0.8 * u), 0.0, length)


def write_line(path, length):
    rows = "\n".join(f"0,{0.6 * s},{0.8 * s}" for s in np.linspace(0, length, 40))
    path.write_text(f"x_mm,y_mm,z_mm\n{rows}\n", encoding="utf-8")
    return path


def test_growing_advances_by_the_paths_own_parameter():
    """Frame j of the cosine ends where u = j / T of its range, though arc length runs faster than u."""
    frames = growing(cosine_path(), 10).sample()
    for j, frame in enumerate(frames, start=1):
        u = 45.45 * math.pi * j / 10
        np.testing.assert_allclose(frame.points[-1], [10 * math.cos(0.044 * u) - 10, 0, u], atol=1e-6)


def test_growing_covers_a_cosine_unevenly_and_a_line_evenly():
    cosine, straight = np.diff(growing(cosine_path(), 20).lengths), np.diff(growing(line(100), 20).lengths)
    assert np.ptp(cosine) > 0.05 * cosine.mean()
    np.testing.assert_allclose(straight, 5)


def test_growing_along_a_piece_advances_by_arc_length():
    piece = cosine_path().part(10, 110)
    np.testing.assert_allclose(growing(piece, 4).lengths, [25, 50, 75, 100])


def test_the_last_frame_is_the_whole_path():
    path = cosine_path()
    assert growing(path, 7).lengths[-1] == pytest.approx(path.length, abs=1e-9)


def test_samples_lie_at_uniform_arc_lengths():
    frame = growing(cosine_path(), 1).sample()[0]
    chords = np.linalg.norm(np.diff(frame.points, axis=0), axis=1)
    np.testing.assert_allclose(chords, frame.length / 100, rtol=2e-4)


@pytest.mark.parametrize("part", [0.3, 1.0])
def test_turning_is_the_integral_of_curvature(part):
    u_end = 45.45 * math.pi * part
    frame = growing(cosine_path(), 10).sample()[round(10 * part) - 1]

    def rate(u):
        return 10 * 0.044**2 * abs(math.cos(0.044 * u)) / (1 + (0.44 * math.sin(0.044 * u)) ** 2)

    truth, _ = quad(
        rate, 0, u_end, points=[math.pi / 2 / 0.044 * k for k in (1, 3) if math.pi / 2 / 0.044 * k < u_end]
    )
    assert frame.turning[0] == 0
    assert frame.turning[-1] == pytest.approx(truth, rel=1e-5)


def test_turning_of_an_arc_grows_evenly():
    arc = curve_from_formula(lambda u: (80 * ca.cos(u), 80 * ca.sin(u), 0), 0.0, 1.5)
    np.testing.assert_allclose(growing(arc, 1).sample()[0].turning, 1.5 * SIGMA_GRID, atol=1e-9)


@pytest.mark.parametrize("path", [cosine_path(), line(120)], ids=["cosine", "line"])
def test_a_frame_interpolates_between_its_samples(path):
    frame = growing(path, 1).sample()[0]
    np.testing.assert_allclose(frame.at(OFF_GRID), path.point(OFF_GRID * path.length), atol=1e-3)


@given(robots_with_q(varying=False))
def test_a_frame_interpolates_shapes_whose_curvature_jumps(case):
    """A cubic misses a jump of curvature in the middle of a cell of h mm by jump h^2 / 64; here two of 2 k."""
    robot, q = case
    curve = shape_curve(robot, q)
    frame = sequence([curve]).sample()[0]
    bound = max(tube.root_curvature for tube in robot.tubes) * (curve.length / 100) ** 2 / 16 + 1e-5
    np.testing.assert_allclose(frame.at(OFF_GRID), curve.point(OFF_GRID * curve.length), atol=bound)


def test_quadrature_is_the_trapezoidal_rule_on_sigma():
    values = np.random.default_rng(0).normal(size=101)
    assert values @ QUADRATURE == pytest.approx(np.trapezoid(values, SIGMA_GRID))


def test_a_sequence_follows_whole_shapes(robot):
    q = np.array([[0, 0, 0, 20, 40, 60, 0, 0], [0, 1, 2, 30, 60, 90, 0, 0.0]])
    target = sequence([shape_curve(robot, row) for row in q])
    assert target.lengths == (60, 90)


@pytest.mark.parametrize("frames", [0, -1, 2.5, "3", True, None])
def test_a_number_of_frames_that_is_not_positive_and_whole_is_refused(frames):
    with pytest.raises(ProblemError, match="frames"):
        growing(line(50), frames)


def test_a_target_without_frames_is_refused():
    with pytest.raises(ProblemError, match="a target has no frames; give at least one"):
        Target((), ())


# Problems


def test_a_path_half_a_percent_too_long_is_accepted(robot):
    assert Problem("line", robot, growing(line(150 * 1.0049), 3)).frames == 3


def test_a_longer_path_is_refused_with_both_lengths(robot):
    with pytest.raises(ProblemError, match=r"151\.00 mm long and the robot reaches 150\.00 mm"):
        Problem("line", robot, growing(line(151), 3))


@pytest.mark.parametrize("duration", [0, -1, math.nan, math.inf, "ten", None])
def test_a_duration_that_is_not_positive_is_refused(robot, duration):
    with pytest.raises(ProblemError, match="duration"):
        Problem("line", robot, growing(line(50), 3), duration)


def test_dt_is_the_duration_over_the_frames(robot):
    assert Problem("line", robot, growing(line(50), 4), 10.0).dt == 2.5


def test_a_file_becomes_a_target_along_z_from_the_origin(tmp_path):
    problem = problem_from_file(write_line(tmp_path / "path.csv", 100), frames=2)
    assert problem.name == "path"
    np.testing.assert_allclose(problem.target_frames[-1].points[[0, -1]], [[0, 0, 0], [0, 0, 100]], atol=1e-6)
    np.testing.assert_allclose(problem.to_robot @ [0, 60, 80, 1], [0, 0, 100, 1], atol=1e-9)


@pytest.mark.parametrize(("options", "first"), [({}, 0), ({"reverse": True}, 200), ({"trim": "start"}, 50)])
def test_reverse_and_trim_choose_where_a_file_begins(tmp_path, options, first):
    """A 200 mm line before a robot that reaches 150 mm: to_robot takes the first followed point to the origin."""
    options = {"trim": "end"} | options
    problem = problem_from_file(write_line(tmp_path / "path.csv", 200), frames=2, **options)
    np.testing.assert_allclose(problem.to_robot @ [0, 0.6 * first, 0.8 * first, 1], [0, 0, 0, 1], atol=1e-6)
    assert problem.target.lengths[-1] == pytest.approx(150)


def test_a_file_too_long_is_refused_unless_it_may_be_trimmed(tmp_path):
    with pytest.raises(ProblemError, match="trim"):
        problem_from_file(write_line(tmp_path / "path.csv", 200))


def test_an_unknown_end_to_trim_is_refused(tmp_path):
    with pytest.raises(OptionError, match=r"trim is 'middle'.*'start' or 'end'"):
        problem_from_file(write_line(tmp_path / "path.csv", 50), trim="middle")


@pytest.mark.parametrize("name", ["chaste_ts002_LLL", "chaste_ts002_RLL", "chaste_ts002_RML", "hra_vhm_left_main"])
def test_a_real_airway_becomes_a_problem_with_its_lumen(shared_data, name):
    path = shared_data / "airways" / f"{name}.csv"
    problem = problem_from_file(path, table_i_robot(), frames=3, trim="start")
    frame = problem.target_frames[-1]
    assert frame.length <= 150 * 1.005
    assert (frame.radius > 0).all()
    there = np.loadtxt(path, delimiter=",", skiprows=1)[-1, :3]
    np.testing.assert_allclose(problem.to_robot @ [*there, 1], [*frame.points[-1], 1], atol=0.01)
