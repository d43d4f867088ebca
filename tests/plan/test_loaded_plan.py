"""Plans of robots that bear a load: what is told of them, kept in their files, and made of them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import truth
from loaded_plans import FRAMES, made, turned

from ctr_nlp import Load, Plan, summary
from ctr_nlp.exceptions import LoadError, OptionError, OutputError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.plan import summary_text
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES

WEAK = Load(force=(0.0, 0.05, 0.0))


@pytest.fixture(scope="module")
def plain() -> Plan:
    """Its robot's moduli are ratios."""
    return turned()


@pytest.fixture(scope="module")
def nitinol(plain: Plan) -> Plan:
    return plain.with_modulus(60_000)


def test_a_plan_bears_a_load(nitinol):
    """Shapes and margins are those of the loaded model, and everything told of the plan says so."""
    found = nitinol.with_load(WEAK)
    model = Loaded(WEAK)
    x = np.array([model.rest(nitinol.robot, q) for q in nitinol.q])
    np.testing.assert_allclose(found.shape, model.points(nitinol.robot, x, np.linspace(0, 1, 101)), atol=1e-6)
    np.testing.assert_allclose(found.stability, model.margins(nitinol.robot, x), atol=1e-6)
    assert found.evaluated_load == WEAK
    assert found.evaluated_model == model
    assert found.verdicts.stable.word == YES
    told = "under a tip force of (0, 0.05, 0) N"
    assert told in repr(found)
    assert told in found.verdicts.stable.why
    assert summary_text.title(summary(found)).endswith(f", {told}")
    assert found.verdicts.solved.why == "All 4 frames were solved on the elastic model."


def test_a_load_that_is_planned_for_is_named_once_beside_what_the_wall_costs(nitinol):
    meta = nitinol.meta | {"e3_free": 1.0}
    free = replace(nitinol, free=nitinol.q, meta=meta)
    planned = replace(free.with_load(WEAK), meta=free.with_load(WEAK).meta | {"planned_load": WEAK.to_dict()})
    for plan, times in (
        (planned, 1),
        (planned.with_load(Load(force=(0.0, 0.1, 0.0))), 1),
        (free.with_load(WEAK), 0),
    ):
        assert plan.verdicts.solved.why.count("under a tip force") == times
        assert ("Keeping off the wall costs" in plan.verdicts.solved.why) == plan.as_planned


def test_without_its_load_it_is_the_plan_of_before(nitinol):
    again = nitinol.with_load(WEAK).evaluate_on("elastic")
    assert again.evaluated_load is None
    assert again.evaluated_model is KINEMATIC_MODELS["elastic"]
    np.testing.assert_allclose(again.shape, nitinol.shape)
    none = nitinol.with_load(Load())
    np.testing.assert_allclose(none.shape, nitinol.shape, atol=1e-3)
    np.testing.assert_allclose(none.stability, nitinol.stability, atol=1e-4)


def test_a_modulus_changes_no_shape_without_a_load(plain, nitinol):
    again = nitinol.evaluate_on("elastic")
    np.testing.assert_allclose(again.shape, plain.shape, atol=1e-9)
    np.testing.assert_allclose(again.stability, plain.stability, atol=1e-9)
    assert [tube.youngs_modulus for tube in nitinol.robot.tubes] == [60_000, 60_000]


def test_a_file_keeps_the_load(nitinol, tmp_path):
    found = nitinol.with_load(replace(WEAK, densities=6.45, down=(0, 0, 1)))
    found.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again == found
    assert again.evaluated_load == found.evaluated_load


def test_a_file_with_a_wrong_load_is_no_plan(nitinol, tmp_path):
    wrong = replace(nitinol, meta=nitinol.meta | {"load": {"force": [0, 0, 1e9]}})
    wrong.save(tmp_path / "plan.npz")
    with pytest.raises(OutputError, match=r"is not a plan: force of a load is 1e\+09 N; it must be at most 100 N"):
        Plan.load(tmp_path / "plan.npz")


@pytest.mark.parametrize("frames", [1, 2])
def test_a_snap_under_a_load_is_told(shared_data, frames):
    """The margin is 0.2 without it. Where the robot comes to rest is not known, and no number stands for it."""
    case = truth.case(shared_data, 21)
    found = made(case.robot, np.stack([case.q] * frames)).with_modulus(60_000).with_load(Load(force=(-0.5, 0, 0)))
    numbers = summary(found)
    assert [snap["jump"] for snap in numbers["snaps"]] == [None]
    (remark,) = [each for each in summary_text.remarks(found, numbers) if each.startswith("snap")]
    assert remark.startswith("snap on the way to frame 1: ")
    assert remark.endswith("where the robot comes to rest under the load is not known")
    assert found.verdicts.stable.word == NO
    assert found.verdicts.arrives.word == NOT_CHECKED
    assert not found.reached_frames.any()
    json.dumps(numbers, allow_nan=False)


def test_a_load_without_an_energy_has_no_margin(nitinol):
    found = nitinol.with_load(Load(force=(0.05, 0, 0), axes="tool"))
    assert found.reached_frames.all()
    assert found.verdicts.stable.word == NOT_CHECKED
    assert found.verdicts.stable.why.endswith("has no energy and therefore no margin.")


def test_what_is_made_of_a_plan_bears_its_load(nitinol):
    found = nitinol.with_load(WEAK)
    assert found[1:3].evaluated_load == found.resampled(7).evaluated_load == WEAK
    (middle,) = found.resampled(2 * FRAMES - 1).shape[2:3]
    np.testing.assert_allclose(middle, found.shape[1], atol=1e-6)
    assert (found + found).evaluated_load == WEAK
    with pytest.raises(OptionError, match="the load of two plans to be joined differs"):
        _ = found + nitinol


def test_draws_of_a_plan_bear_its_load(nitinol):
    loaded, free = (each.robustness(2).e2 for each in (nitinol.with_load(Load(force=(0, 3, 0))), nitinol))
    assert loaded.shape == free.shape
    assert abs(loaded - free).max() > 0.1


def test_what_cannot_be_loaded_is_refused(plain, nitinol):
    with pytest.raises(LoadError, match=r"youngs_modulus of tube 1 is 1; .*, or give one by with_modulus"):
        plain.with_load(WEAK)
    with pytest.raises(LoadError, match="load is None; it must be a Load"):
        plain.with_load(None)
    with pytest.raises(LoadError, match=r"densities of a load has 3 numbers"):
        nitinol.with_load(Load(densities=(6, 6, 6), down=(0, 0, 1)))
    with pytest.raises(LoadError, match="a modulus before the load"):
        nitinol.with_load(WEAK).with_modulus(2.0)
