"""Robots moved step by step: as along whole motions, and as other robots from where they stand."""

import numpy as np
import pytest
from near_fold import LONG, near_the_fold

from ctr_nlp import Load, Loaded, LoadOverTime, table_i_robot
from ctr_nlp.exceptions import LoadError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.elastic import stability
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.robot.samples import perturb_robot


def stepped(model, robot, q):
    """x at every row of q, margins there, and jumps on the way."""
    walker = model.walker(robot.structure, robot.numbers, q[0])
    x, margins, jumps = [walker.x], [walker.margin()], []
    for row in q[1:]:
        jumps.append(walker.move_to(row))
        x.append(walker.x)
        margins.append(walker.margin())
    return np.array(x), np.array(margins), jumps


MODELLED = {
    "elastic": KINEMATIC_MODELS["elastic"],
    "dominant": KINEMATIC_MODELS["dominant"],
    "loaded": Loaded(Load((0.0, 0.1, 0.05))),
}


@pytest.mark.parametrize("name", MODELLED)
def test_step_by_step_a_robot_comes_to_where_the_whole_motion_leads(name):
    robot, model = with_modulus(table_i_robot(), 60_000), MODELLED[name]
    part = np.linspace(0.3, 0.9, 5)[:, None]
    q = np.hstack([(1 - part) * [-0.6, 0.0, 0.6], part * robot.upper[3:6], 0.1 * part, 0.0 * part])
    x, margins, jumps = stepped(model, robot, q)
    found = model.follow(robot, q)
    assert x == pytest.approx(found.x, abs=1e-6)
    assert margins == pytest.approx(found.stability, abs=1e-6, nan_ok=True)
    assert not any(jumps)


def test_a_snap_is_told_as_a_jump_of_the_tips():
    q = np.vstack([near_the_fold(), near_the_fold()[-1:]])
    q[-1, 0] += 0.4
    _, _, (*before, jumps) = stepped(KINEMATIC_MODELS["elastic"], LONG, q)
    assert not any(before)
    assert [abs(jump).max() > 1 for jump in jumps] == [True]


def test_where_a_robot_comes_to_rest_that_snaps_under_a_load_is_not_known():
    model, robot = Loaded(Load((0.0, 0.0, -1e-4))), with_modulus(LONG, 60_000)
    q = np.vstack([near_the_fold(), near_the_fold()[-1:]])
    q[-1, 0] += 0.4
    x, margins, jumps = stepped(model, robot, np.vstack([q, q[:1]]))
    assert np.isfinite(x[:-2]).all()
    assert np.isnan(x[-2:]).all()
    assert np.isnan(margins[-2:]).all()
    assert not any(jumps)


def test_a_load_without_an_energy_has_no_margin_step_by_step():
    robot = with_modulus(table_i_robot(), 60_000)
    q = np.array([0.4, -0.3, 0.2, 30.0, 70.0, 100.0, 0.1, 0.0])
    walker = Loaded(Load(axial_moment=1.0)).walker(robot.structure, robot.numbers, q)
    assert np.isfinite(walker.x).all()
    assert np.isnan(walker.margin())
    with pytest.raises(LoadError, match="this one changes over time"):
        Loaded(LoadOverTime([Load(), Load()], [0, 1])).walker(robot.structure, robot.numbers, q)


def test_a_loaded_robot_becomes_another_and_bears_another_load_where_it_stands():
    robot, q = with_modulus(table_i_robot(), 60_000), np.array([0.4, -0.3, 0.2, 30.0, 70.0, 100.0, 0.1, 0.0])
    parts = np.zeros((1, 3, 5))
    parts[0, :, :2] = [[0.1, -0.2], [-0.08, 0.1], [0.05, 0.15]]
    (other,) = perturb_robot(robot, parts, np.zeros((1, 3))).numbers
    before, after = Load((0.0, 0.1, 0.0)), Load((0.1, -0.1, 0.2))
    walker = Loaded(before).walker(robot.structure, robot.numbers, q)
    twin = walker.copy()
    assert walker.change_tubes(other) == []
    np.testing.assert_allclose(walker.x, Loaded(before).walker(robot.structure, other, q).x, atol=1e-6)
    assert walker.change_load(after.numbers(3)) == []
    own = Loaded(after).walker(robot.structure, other, q)
    np.testing.assert_allclose(walker.x, own.x, atol=1e-6)
    assert walker.margin() == pytest.approx(own.margin(), abs=1e-6)
    np.testing.assert_allclose(twin.x, Loaded(before).walker(robot.structure, robot.numbers, q).x, atol=1e-9)
    assert abs(walker.x - twin.x).max() > 1e-3
    walker.move_to(q + 0.1)
    np.testing.assert_allclose(walker.x, Loaded(after).walker(robot.structure, other, q + 0.1).x, atol=1e-6)


def test_a_robot_becomes_another_where_it_stands():
    robot, model = table_i_robot(), KINEMATIC_MODELS["elastic"]
    q = np.array([0.4, -0.3, 0.2, 30.0, 70.0, 100.0, 0.1, 0.0])
    parts = np.zeros((1, 3, 5))
    parts[..., 0] = 0.1, -0.08, 0.05
    (other,) = perturb_robot(robot, parts, np.zeros((1, 3))).numbers
    walker = model.walker(robot.structure, robot.numbers, q)
    twin = walker.copy()
    assert walker.change_tubes(other) == []
    assert walker.x == pytest.approx(model.walker(robot.structure, other, q).x, abs=1e-6)
    assert twin.x == pytest.approx(model.rest(robot, q), abs=1e-6)
    assert twin.margin() == pytest.approx(float(stability.margins(robot.tube_numbers, twin.x[None])[0]))
