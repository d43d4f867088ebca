"""Plans tried on draws: what is counted and measured, what a file keeps, and what the verdict says."""

import json
from dataclasses import replace

import numpy as np
import pytest
from near_fold import LONG, near_the_fold, plan_through
from scipy.stats import beta, binomtest

from ctr_nlp import Plan, by_frame, summary
from ctr_nlp.exceptions import OutputError
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.robustness import Robustness, upper_bound
from ctr_nlp.plan.sample_motions import simulate_samples
from ctr_nlp.problems import named_problem
from ctr_nlp.robot.samples import perturb_robot, sample_robots


@pytest.fixture(scope="module")
def plan():
    return plan_through(near_the_fold()).with_samples(30, 4)


def test_what_is_lost_is_counted_and_bounded(plan):
    found = plan.drawn
    draws = sample_robots(LONG, 30, 4)
    moved = simulate_samples(LONG, draws, plan.q, "elastic")
    assert found.lost_count == (moved.lost > 0).sum()
    assert 0 < found.lost_count < 30
    off = draws.offsets[:, 0]
    assert off[found.lost > 0].mean() > off[found.lost == 0].mean()
    assert sum(loss.draws for loss in found.losses_by_frame) == found.lost_count
    assert all(loss.length == pytest.approx(80) for loss in found.losses_by_frame)
    away = np.linalg.norm(moved.shape - plan.target, axis=-1)
    np.testing.assert_allclose(found.largest, away.max(axis=(1, 2)))
    for k in (0, 7):
        np.testing.assert_allclose(found.e3[k], e3(replace(plan, shape=moved.shape[k])), rtol=1e-6)
    np.testing.assert_allclose(found.cloud[-1], moved.shape[:, -1, ::4], rtol=1e-5, atol=1e-5)


def test_costs_are_those_of_one_tolerance_alone(plan):
    costs = {(cost.tube, cost.tolerance): cost for cost in plan.drawn.costs}
    assert set(costs) == {(1, "curvature"), (1, "motor_zero")}
    assert sum(cost.share for cost in costs.values()) == pytest.approx(1)
    parts = np.zeros((2, 2, 5))
    parts[:, 0, 0] = 0.02 / np.sqrt(3), -0.02 / np.sqrt(3)
    shape = simulate_samples(LONG, perturb_robot(LONG, parts, np.zeros((2, 2))), plan.q, "elastic").shape
    squares = [e3(replace(plan, shape=each)) ** 2 for each in shape]
    assert costs[1, "curvature"].growth == pytest.approx(np.sqrt(np.mean(squares)) - e3(plan), rel=1e-6)


def test_it_is_shown_in_a_line(plan):
    found = plan.robustness(20)
    assert repr(found) == f"Robustness({found.summary_sentence[:-1]})"
    assert f"{found.lost_count} of 20 samples" in repr(found)


def test_the_same_seed_gives_the_same(plan):
    assert plan.robustness(30, 4) == plan.drawn
    assert plan.robustness(30, 5) != plan.drawn


def test_groups_of_draws_are_put_together(monkeypatch, plan):
    monkeypatch.setattr("ctr_nlp.plan.monte_carlo.PLAN_SAMPLES_PER_BATCH", 7)
    assert plan.robustness(30, 4) == plan.drawn


@pytest.mark.parametrize(("lost", "count"), [(0, 500), (2, 500), (31, 40), (40, 40), (1, 1)])
def test_the_bound_is_that_of_clopper_and_pearson(lost, count):
    """binomtest finds it by solving for the binomial distribution itself."""
    known = binomtest(lost, count, alternative="less").proportion_ci(0.95, "exact").high
    assert upper_bound(lost, count) == pytest.approx(known, rel=1e-9)
    if lost < count:
        assert upper_bound(lost, count) == pytest.approx(beta.ppf(0.95, lost + 1, count - lost))


def test_none_of_200_is_at_most_one_and_a_half_percent():
    assert upper_bound(0, 200) == pytest.approx(1 - 0.05 ** (1 / 200))


def test_a_file_keeps_it_and_older_files_have_none(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again == plan
    assert isinstance(again.drawn, Robustness)
    assert again.drawn.seed == 4
    replace(plan, drawn=None).save(tmp_path / "old.npz")
    assert Plan.load(tmp_path / "old.npz").drawn is None


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"draws_lost": None}, "it has draws_parts and no draws_lost"),
        ({"draws_e2": np.zeros((30, 3))}, r"draws_e2 has shape \(30, 3\), not \(30, 12\)"),
        ({"draws_parts": np.zeros(3)}, "draws_parts has shape"),
        ({"draws_cloud": np.array(["a"])}, "draws_cloud has shape"),
    ],
)
def test_a_damaged_file_is_refused(plan, tmp_path, change, complaint):
    plan.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz") as data:
        arrays = dict(data) | change
    np.savez(tmp_path / "bad.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(OutputError, match=complaint):
        Plan.load(tmp_path / "bad.npz")


def test_a_file_whose_seed_is_none_is_refused(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz") as data:
        arrays = dict(data)
    for draws in ({}, {"seed": "x"}, {"seed": -1}):
        meta = json.loads(str(arrays["meta"])) | {"draws": draws}
        np.savez(tmp_path / "bad.npz", **arrays | {"meta": np.array(json.dumps(meta))})
        with pytest.raises(OutputError, match="seed of meta's draws"):
            Plan.load(tmp_path / "bad.npz")


def test_the_verdict_and_the_summary_say_so(plan):
    assert plan.verdicts.holds.word == "no"
    assert plan.verdicts.holds.number <= 1 - plan.drawn.lost_share
    assert f"{plan.drawn.lost_count} snap or leave the branch" in plan.verdicts.holds.why
    found = json.loads(json.dumps(summary(plan), allow_nan=False))["robustness"]
    assert found["lost"] == plan.drawn.lost_count
    assert found["e3"]["mean"] == pytest.approx(plan.drawn.e3.mean())
    assert found["clearance"] is None
    assert summary(replace(plan, drawn=None))["robustness"] is None
    columns = by_frame(plan)
    assert (columns["e2_draws_median"] <= columns["e2_draws_95"]).all()
    calm = plan_through(near_the_fold(1.0)).with_samples(10, 4)
    ends = {"arrival_tolerance": 500.0, "contact_allowed": 500.0}
    assert calm.with_thresholds(**ends).verdicts.holds.word == "yes"
    assert calm.with_thresholds(**ends).verdicts.holds.number == 1
    assert "leave the branch" not in calm.verdicts.holds.why


def test_what_is_made_of_a_plan_is_not_tried(plan):
    for other in (plan[2:5], plan.reversed(), plan + plan, plan.resampled(5), plan.evaluate_on("dominant")):
        assert other.drawn is None
    assert plan.drawn is not None


def test_clearance_is_that_of_the_draws():
    plan = plan_through(near_the_fold(0.5, 4), radius=30.0).with_samples(5, 1)
    shape = simulate_samples(LONG, sample_robots(LONG, 5, 1), plan.q, "elastic").shape
    for k in range(5):
        radii = np.where(np.linspace(0, 80, 101) > 60 + 1e-9, 1.3, 2.0)
        clear = 30 - np.linalg.norm(shape[k, ..., :2], axis=-1) - radii
        inside = shape[k, ..., 2] < 79
        assert plan.drawn.clearance[k] <= np.where(inside, clear, np.inf).min() + 1e-3
    assert (plan.drawn.contact >= np.maximum(-plan.drawn.clearance, 0)).all()


def test_clearance_of_draws_is_found_as_that_of_a_plan():
    plan = plan_through(near_the_fold(), radius=4.0).with_samples(8, 1)
    moved = simulate_samples(LONG, sample_robots(LONG, 8, 1), plan.q, "elastic")
    for k, shape in enumerate(moved.shape):
        least = Lumen(plan.lumen).clearance(LONG, plan.beta, SIGMA_GRID, shape).min(axis=1)
        np.testing.assert_allclose(plan.drawn.clearance[k], least.min(), atol=1e-6)
        np.testing.assert_allclose(plan.drawn.contact[k], np.maximum(-least, 0).sum(), atol=1e-5)
    assert plan.drawn.contact.max() > 1.0


def test_a_plan_on_the_dominant_model_has_errors_and_loses_nothing():
    problem = named_problem("arc", frames=3)
    q = np.zeros((3, 8))
    q[:, 3:6] = np.linspace((10, 20, 50), (40, 80, 149), 3)
    plan = replace(plan_through(q, problem.robot, "dominant")).with_samples(20, 0)
    assert plan.drawn.lost_count == 0
    assert np.isnan(plan.drawn.margin).all()
    assert plan.drawn.e3.std() > 0
    assert plan.drawn.costs[0].growth > 0
