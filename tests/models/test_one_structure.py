"""The elastic model as one text for one structure, a robot a thread: built for this processor, and as CUDA."""

from __future__ import annotations

import ctypes
import re

import numpy as np
import pytest

from ctr_nlp import Robot, Tube, table_i_robot
from ctr_nlp.codegen import cache
from ctr_nlp.codegen.cuda import build_ptx
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import model_named
from ctr_nlp.models.elastic.compiled import get_compiled_elastic
from ctr_nlp.models.elastic.following import follow_substeps
from ctr_nlp.models.elastic.one_structure import write_source
from ctr_nlp.models.protocol import subdivide_motion

TWO_TUBES = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
SIGMA = np.linspace(0, 1, 11)
NVRTC = "nvidia.cuda_nvrtc"


def poses(robot, count):
    """Random configurations, some of which make the robot fall."""
    rng, d = np.random.default_rng(4), robot.d
    beta = np.sort(rng.random((count, d)), axis=1) * robot.upper[d : 2 * d]
    return np.hstack([rng.uniform(-np.pi, np.pi, (count, d)), beta, rng.uniform(-0.5, 0.5, (count, 2))])


def address(array):
    return ctypes.c_void_p(array.ctypes.data)


def built(robot):
    """The text of a robot's structure, compiled for this processor, and the struct of its parameters."""
    text = write_source(robot.structure, card=False)
    parameters = get_compiled_elastic(robot.structure).parameters
    return ctypes.CDLL(str(cache.library(text, lambda: text))), parameters


@pytest.mark.parametrize("robot", [TWO_TUBES, pytest.param(table_i_robot(), marks=pytest.mark.slow)])
def test_a_robot_a_thread_has_the_same_equilibria(robot):
    library, parameters = built(robot)
    q = poses(robot, 2000)
    expected = model_named("elastic").rest_states(robot, q, SIGMA)
    numbers = robot.numbers.ravel(order="F").copy()
    x, tips, margins, points = (
        np.empty(np.shape(each)) for each in (expected.x, expected.tips, expected.margins, expected.points)
    )
    given = address(numbers), ctypes.c_long(0), address(q), ctypes.c_long(len(q)), address(SIGMA)
    library.rest_of_each(parameters, *given, ctypes.c_long(len(SIGMA)), *map(address, (x, tips, margins, points)))
    np.testing.assert_allclose(x, expected.x, atol=1e-11)
    np.testing.assert_allclose(margins, expected.margins, atol=1e-11)
    np.testing.assert_allclose(points, expected.points, atol=1e-9)
    np.testing.assert_allclose(tips, expected.tips, atol=1e-10)


def test_a_robot_a_thread_moves_as_alone():
    library, parameters = built(TWO_TUBES)
    # The outer tube is turned by up to six radians against the inner one: some robots snap.
    turned = [np.array([angle, 0, 60, 80, 0.1, -0.2]) for angle in np.linspace(0, 6, 15)]
    ways = [subdivide_motion(np.linspace([0, 0, 60, 80, 0, 0], end, 5), 4) for end in turned]
    goals = np.array([way.q for way in ways])
    x, fell = np.empty(goals.shape), np.zeros(len(goals), dtype=np.int64)
    numbers = TWO_TUBES.numbers.ravel(order="F").copy()
    given = (
        address(numbers),
        ctypes.c_long(0),
        address(goals),
        ctypes.c_long(len(goals)),
        ctypes.c_long(goals.shape[1]),
    )
    library.motion_of_each(parameters, *given, address(x), address(fell))
    assert 0 < (fell > 0).sum() < len(fell)
    for way, found in zip(ways, x, strict=True):
        alone = follow_substeps(TWO_TUBES.structure, TWO_TUBES.numbers, way, way.q, margins=False)
        np.testing.assert_allclose(found[np.append(0, np.arange(4, 17, 4))], alone.x, atol=1e-9)


@pytest.mark.parametrize("robot", [TWO_TUBES, pytest.param(table_i_robot(), marks=pytest.mark.slow)])
def test_the_text_for_cards_compiles_without_a_card(robot):
    pytest.importorskip(NVRTC, reason="the extra gpu is not installed")
    ptx = build_ptx(write_source(robot.structure, card=True))
    assert ".target sm_90" in ptx
    assert re.findall(r"\.visible \.entry (\w+)\(", ptx) == ["rest_of_each", "motion_of_each"]


def test_a_text_that_is_no_cuda_is_refused():
    pytest.importorskip(NVRTC, reason="the extra gpu is not installed")
    with pytest.raises(OptionError, match=r"NVRTC cannot compile for compute_90: .*error"):
        build_ptx("__global__ void f( {")
