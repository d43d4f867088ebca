"""Functions whose places are taken side by side, against the same functions interpreted in one piece."""

import ctypes

import numpy as np
import pytest

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.codegen import cache
from ctr_nlp.codegen.vector import VECTOR_LANES
from ctr_nlp.models import model_named
from ctr_nlp.ocp.joint import joint
from ctr_nlp.ocp.partition import FRAME_FUNCTION_NAMES, partition_program
from ctr_nlp.ocp.sample_groups import group_samples
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import ShapeDistance, TipPosition
from ctr_nlp.ocp.terms.lumen import WALL_SUBSAMPLES
from ctr_nlp.solvers.frame.program import Program

TABLE_I = table_i_robot()
BENT = Robot(
    (
        Tube(120.0, 60.0, (0.004, 0.009), 2.4, 1.9),
        Tube(250.0, 110.0, 0.012, 1.6, 1.2),
    ),
    Limits(beta=[(0, 60), (0, 110)], carriage_gap=3.0),
)
CASES = {
    "dominant": (TABLE_I, "dominant", False, ()),
    "elastic": (TABLE_I, "elastic", False, ()),
    "within a lumen": (TABLE_I, "dominant", True, ()),
    "elastic, within a lumen": (TABLE_I, "elastic", True, ()),
    "linear curvature and a gap": (BENT, "dominant", True, ()),
    "another term beside": (TABLE_I, "dominant", False, (TipPosition(2.0, [1.0, 2.0, 60.0]),)),
    "as few places as there are lanes": (TABLE_I, "dominant", False, (ShapeDistance(stride=10),)),
    "too few places": (TABLE_I, "dominant", False, (ShapeDistance(stride=20),)),
}


def program(robot, model, walled, terms):
    (stage,) = joint(robot, Settings(), model_named(model), terms, walled)
    return stage.nlp


def numbers_of(nlp, robot, rng):
    """A configuration and parameters: none of them is special, and radii and distances are no less than 1."""
    d, p = robot.d, np.abs(rng.normal(size=nlp.p.numel())) + 1
    p[nlp.parameter_slice("tubes")] = robot.numbers.ravel(order="F")
    beta = np.sort(rng.uniform(0.1, 0.9, d)) * robot.upper[d : 2 * d]
    x = np.concatenate([rng.normal(size=d), np.maximum.accumulate(beta), 0.3 * rng.normal(size=2)])
    return np.append(x, rng.random(nlp.slacks)), p


def called(address, inputs, sizes):
    """The outputs of a function in memory."""
    kind = ctypes.POINTER(ctypes.c_double)
    call = ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int
    )(address)
    outputs = [np.full(size, np.nan) for size in sizes]
    given, found = (
        (kind * len(part))(*(each.ctypes.data_as(kind) for each in part)) for part in (inputs, outputs)
    )
    assert call(given, found, None, None, 0) == 0
    return outputs


@pytest.mark.skipif(cache.unavailable_reason() is not None, reason="no C compiler")
@pytest.mark.parametrize("case", CASES)
def test_a_program_in_parts_is_the_program_in_one_piece(case):
    """Values, slopes and second derivatives, to what rounding changes where sums are taken in another order."""
    robot, *form = CASES[case]
    nlp = program(robot, *form)
    compiled, rng = Program(nlp, wait=True), np.random.default_rng(0)
    for _ in range(5):
        x, p = numbers_of(nlp, robot, rng)
        multipliers = [rng.normal(size=1), rng.normal(size=nlp.g.numel())]
        for order, (name, function) in enumerate(zip(FRAME_FUNCTION_NAMES, nlp.functions[:3], strict=True)):
            inputs = [x, p, *multipliers[: 2 * (order == 2)]]
            wanted = [np.asarray(value.full()).ravel(order="F") for value in function.call(inputs)]
            found = called(compiled.functions[name], inputs, [len(each) for each in wanted])
            for one, other in zip(found, wanted, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11 * np.abs(other).max(initial=1.0))


def test_samples_and_places_of_the_wall_are_found():
    """All but samples at the insertion point and the tip, and every tube's own tip: other expressions."""
    groups, shared = group_samples(program(TABLE_I, "dominant", True, ()).expressions)
    assert [group.rows.shape for group in groups] == [(19, 3), *[(11, WALL_SUBSAMPLES)] * 3]
    assert len(shared) == 18
    rows = np.concatenate([group.rows.ravel() for group in groups])
    assert len(np.unique(rows)) == len(rows)


def test_a_group_has_at_least_as_many_places_as_there_are_lanes():
    written = program(*CASES["too few places"]).expressions
    assert group_samples(written)[0] == ()
    assert not any(each.sample_point_parts for each in partition_program(written))
    (group,), _ = group_samples(program(*CASES["as few places as there are lanes"]).expressions)
    assert len(group.rows) == VECTOR_LANES + 1
