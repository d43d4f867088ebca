"""Robots of one structure share every compiled program; what is another structure is told by kinds and limits."""

import math
import time

import casadi as ca
import numpy as np
import pytest
from strategies import drawn

from ctr_nlp import Limits, Problem, Robot, Tube, curve_from_formula, growing, table_i_robot
from ctr_nlp.codegen import cache, sample_points
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.protocol import build_sample_function
from ctr_nlp.ocp.frame_solver import FrameResult, sobol_starts
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure

COUNTS = pytest.mark.parametrize("count", [25, pytest.param(1000, marks=pytest.mark.slow)])


def one_frame(robot):
    """A problem of a single frame, as long as most of the robot."""
    radius, length = 80.0, 0.9 * robot.reach
    path = curve_from_formula(
        lambda u: (radius * (ca.cos(u) - 1), 0, radius * ca.sin(u)), 0.0, min(length / radius, 1.5)
    )
    return Problem("drawn", robot, growing(path, 1))


KINDS = [
    *((d, "dominant") for d in (2, 3, 4)),
    *((d, "elastic") for d in (2, 3)),
    pytest.param(4, "elastic", marks=pytest.mark.slow),
]


@COUNTS
@pytest.mark.parametrize(("d", "model"), KINDS)
def test_random_robots_of_one_structure_are_compiled_once(d, model, count, monkeypatch, capsys):
    """The first robot compiles; the others are planned with what it left. Times are told, and not judged."""
    if cache.unavailable_reason():
        pytest.skip("no C compiler")
    written = list[str]()
    monkeypatch.setattr(sample_points, "code", told(written, sample_points.code))
    rng, seconds, failed = np.random.default_rng(d), list[float](), 0
    for number in range(count + 1):
        problem = one_frame(drawn(rng, d))
        if number == 1:
            written.clear()
        assert problem.target_frames
        begin = time.process_time()
        solved = first_solution(problem, KINEMATIC_MODELS[model])
        seconds.append(time.process_time() - begin)
        failed += not solved
    assert written == []
    assert failed < 0.05 * count + 1
    with capsys.disabled():
        median = 1e3 * float(np.median(seconds[1:]))
        print(
            f"\n{count} robots of {d} tubes, {model}: {median:.2f} ms to the first solution, {failed} not solved"
        )


def first_solution(problem, model):
    """Whether one of eight starts leads to a solution; the first that does ends the search."""
    frames = NlpFrames.of(problem, model=model)
    guesses = sobol_starts(problem.robot, problem.target_frames[0], 8)
    return any(
        frames.search_near(
            0, FrameResult(q, x=model.guess(problem.robot, q) if model.several_equilibria else None)
        ).success
        for q in guesses
    )


def told(written, code):
    def counted(functions, lanes):
        written.append(f"{len(functions)} functions")
        return code(functions, lanes)

    return counted


def test_a_structure_says_what_must_be_compiled():
    first, second, third = table_i_robot().tubes
    bent = Tube(first.length, first.curved_length, (0.004, 0.009), first.outer_diameter, first.inner_diameter)
    straight = Tube(second.length, second.curved_length, 0.0, second.outer_diameter, second.inner_diameter)
    robot = Robot((bent, straight, third), Limits(beta=[(0, 50), (0, 150), (0, 150)], carriage_gap=3.0))
    assert robot.structure == Structure(("linear", "straight", "arc"), (False, False, False), True)
    assert table_i_robot().structure == Structure(("arc",) * 3, (False,) * 3, False)


def test_numbers_are_those_of_the_tubes():
    robot = table_i_robot()
    assert robot.numbers.shape == (3, len(TUBE_NUMBER_NAMES))
    for row, tube, numbers in zip(robot.numbers, robot.tubes, robot.tube_numbers, strict=True):
        expected = tube.length, tube.curved_length, tube.tip_curvature, tube.tip_curvature, tube.bending_stiffness
        np.testing.assert_array_equal(row, [*expected, 1.3, 0.0, tube.area])
        hole, whole = (np.pi * diameter**2 / 4 for diameter in (tube.inner_diameter, tube.outer_diameter))
        assert numbers.area == pytest.approx(whole - hole)
        assert numbers.curved_length == tube.curved_length


@pytest.mark.parametrize("name", ["dominant", "elastic"])
def test_symbols_with_a_robots_numbers_are_its_shape(name):
    """For every kind of part at once, and with transmissions that show."""
    tubes = (
        Tube(90, 50, (1 / 200, 1 / 100), 5.7, 4.3),
        Tube(202, 107, 0.0, 3.7, 2.9),
        Tube(390, 150, 1 / 80, 2.1, 1.0),
    )
    robot = Robot(tubes, Limits(beta=[(0, 80), (0, 150), (0, 300)]))
    model, q = KINEMATIC_MODELS[name], np.array([0.4, -0.7, 1.2, 60.0, 120.0, 260.0, 0.2, -0.1])
    x, sigma = model.rest(robot, q), np.linspace(0, 1, 11)
    points, tangents = build_sample_function(model, robot.structure, len(sigma))(x, sigma, robot.numbers, [])
    atol = 1e-9 if name == "dominant" else 0.03
    np.testing.assert_allclose(points.full(), model.points(robot, x[None], sigma)[0], atol=atol)
    np.testing.assert_allclose(tangents.full(), model.tangents(robot, x[None], sigma)[0], atol=1e-3)
    assert math.isclose(float(np.linalg.norm(tangents.full(), axis=1).min()), 1, abs_tol=1e-5)
