"""Loads that change during a motion: their numbers and files, plans under them, and where they are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loaded_plans import turned

from ctr_nlp import Load, LoadOverTime, Plan, forces, read_load
from ctr_nlp.exceptions import LoadError
from ctr_nlp.models.loads import load_from_dict

pytestmark = pytest.mark.interpreted

NONE, SIDE = Load(), Load(force=(0.0, 0.5, 0.0))
LEANING = Load((0.0, 0.0, -0.2), distributed_force=(0.02, 0.0, 0.0), between=(20.0, 60.0))
COMING = LoadOverTime([NONE, SIDE, LEANING], [0.0, 0.5, 1.0])


@pytest.fixture(scope="module")
def plan():
    return turned().with_modulus(60_000)


def test_numbers_change_linearly_but_for_the_places_between_which_a_force_acts():
    found = COMING.numbers_at(3, np.array([0.0, 0.25, 0.5, 0.75, 1.0]))
    np.testing.assert_allclose(found[:, 1], [0, 0.25, 0.5, 0.25, 0], atol=1e-15)
    np.testing.assert_allclose(found[:, 12], [0, 0, 0, 0.01, 0.02], atol=1e-15)
    np.testing.assert_array_equal(found[:, 15:17], np.tile([20.0, 60.0], (5, 1)))
    assert COMING.conservative
    assert COMING.has_distributed_force
    assert not COMING.has_follower_force
    assert not LoadOverTime([SIDE, Load(axial_moment=1.0)], [0, 1]).conservative


def test_files_hold_loads_over_time(tmp_path):
    (tmp_path / "load.toml").write_text(
        "[[over_time]]\nat = 0\n[[over_time]]\nat = 0.5\nforce = [0.0, 0.5, 0.0]\n[[over_time]]\nat = 1.0\n"
        "force = [0.0, 0.0, -0.2]\ndistributed_force = [0.02, 0.0, 0.0]\nbetween = [20.0, 60.0]\n"
    )
    assert read_load(tmp_path / "load.toml") == COMING
    assert load_from_dict(COMING.to_dict()) == COMING
    assert "(0, 0.5, 0) N at 0.5" in str(COMING)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"over_time": [{"at": 0}]}, r"at of a load over time is \[0.*two or more parts of the motion that rise"),
        ({"over_time": [{"at": 0}, {"at": 0.5}]}, r"to 1, its last one"),
        ({"over_time": [{"at": 0}, {"at": 1}, {"at": 1}]}, r"that rise from 0"),
        ({"over_time": [{"at": 0}, {"force": [0, 1, 0]}]}, r"over_time of a load is .*tables, each with at"),
        ({"over_time": 3}, r"over_time of a load is 3; it must be tables"),
        ({"over_time": [], "force": [0, 0, 1]}, r"over_time and other keys"),
        ({"over_time": [{"at": 0}, {"at": 1, "colour": 1}]}, r"key 'colour' is unknown in a load"),
    ],
)
def test_what_is_no_load_over_time_is_refused(data, message):
    with pytest.raises(LoadError, match=message):
        load_from_dict(data)


def test_loads_that_act_along_different_places_are_refused():
    with pytest.raises(LoadError, match="must be the same places"):
        LoadOverTime([LEANING, replace(LEANING, between=(0.0, 9.0))], [0, 1])


def test_a_load_that_does_not_change_is_a_constant_one(plan):
    changing, constant = plan.with_load(LoadOverTime([LEANING, LEANING], [0, 1])), plan.with_load(LEANING)
    np.testing.assert_allclose(changing.shape, constant.shape, atol=1e-9)
    np.testing.assert_allclose(changing.stability, constant.stability, atol=1e-9)


def test_every_frame_is_that_of_a_robot_under_the_load_of_its_time(plan):
    found = plan.with_load(COMING)
    assert not found.meta["snaps"]
    parts = np.linspace(0, 1, len(plan.time))
    for k, numbers in enumerate(COMING.numbers_at(plan.robot.d, parts)):
        here = Load(numbers[:3], distributed_force=numbers[12:15], between=(20.0, 60.0))
        alone = plan.with_load(here)
        np.testing.assert_allclose(found.shape[k], alone.shape[k], atol=1e-6)
        assert found.stability[k] == pytest.approx(alone.stability[k], abs=1e-6)
    assert abs(found.shape - plan.shape)[1:].max(axis=(1, 2)).min() > 0.05


def test_a_file_of_a_plan_keeps_its_load_over_time(plan, tmp_path):
    found = plan.with_load(COMING)
    found.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again == found
    assert again.evaluated_load == COMING
    assert "a load over time" in repr(again)


def test_what_needs_a_constant_load_says_so(plan):
    under, told = plan.with_load(COMING), "this one changes over time"
    for refused in (lambda: under[1:], under.reversed, lambda: under + under):
        with pytest.raises(LoadError, match=told):
            refused()


def test_forces_are_borne_beside_the_load_of_the_frame(plan):
    """As those of a plan under the load that every frame has at its time, all the time."""
    found = forces(plan.with_load(COMING), directions=6)
    parts = np.linspace(0, 1, len(plan.time))
    for k, numbers in enumerate(COMING.numbers_at(plan.robot.d, parts)):
        here = Load(numbers[:3], distributed_force=numbers[12:15], between=(20.0, 60.0))
        alone = forces(plan.with_load(here), directions=6)
        np.testing.assert_allclose(found.snapping_forces[k], alone.snapping_forces[k], rtol=1e-3)
        np.testing.assert_allclose(found.compliance[k], alone.compliance[k], rtol=1e-3)
