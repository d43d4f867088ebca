"""Error against roughness: a front that nothing of ours lies below."""

import numpy as np
import pytest
from common import NAMES, named_problem

from ctr_nlp import problem_from_file
from ctr_nlp.cli.plan_options import DEFAULT_SWEEP_WEIGHTS_S2
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.planning.horizon import Horizon
from ctr_nlp.studies.pareto_front import (
    COMPARED_VARIANTS,
    compute_pareto_front,
    sweep_motion_weights,
)


def quiet(label):
    return lambda done, total, note: None


def on_the_front(points, roughness):
    """The least e3 in mm that the front reaches at a roughness or less, along straight lines as drawn."""
    front = sorted((p.roughness, p.e3) for p in points if p.method == "horizon" and p.solved)
    rough, errors = np.array(front).T
    return float(np.interp(roughness, rough, np.minimum.accumulate(errors)))


def test_heavier_weights_give_smoother_motions_of_no_less_objective():
    horizon = Horizon(named_problem("cos", 8), model="dominant")
    plans = sweep_motion_weights(horizon, horizon.solve(), (1e-3, 1e-5, 1e-4), quiet)
    weights = [plan.meta["options"]["motion_weight"] for plan in plans]
    assert weights == [1e-5, 1e-4, 1e-3]
    assert all(plan.complete for plan in plans)
    steps = [float(((np.diff(plan.q, axis=0) * plan.robot.mm_per_unit) ** 2).sum()) for plan in plans]
    assert steps == sorted(steps, reverse=True)
    objectives = [plan.objective.mean() for plan in plans]
    assert objectives == sorted(objectives)


def test_the_methods_beside_the_front_lie_above_it():
    horizon = Horizon(named_problem("cos", 10), model="dominant")
    points = compute_pareto_front(horizon, horizon.solve(), DEFAULT_SWEEP_WEIGHTS_S2[::3], Settings(), quiet)
    assert [p.method for p in points[-len(COMPARED_VARIANTS) :]] == list(COMPARED_VARIANTS)
    for point in points[-len(COMPARED_VARIANTS) :]:
        assert on_the_front(points, point.roughness) <= point.e3 + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*NAMES, "chaste_ts002_RLL", "chaste_ts002_LLL", "chaste_ts002_RML", "hra_vhm_left_main"]
)
def test_neither_per_frame_methods_nor_the_seeds_lie_below_the_front(shared_data, name):
    problem = named_problem(name) if name in NAMES else problem_from_file(shared_data / "airways" / f"{name}.csv")
    horizon = Horizon(problem, model="dominant")
    points = compute_pareto_front(horizon, horizon.solve(), DEFAULT_SWEEP_WEIGHTS_S2, Settings(), quiet)
    for point in points[-len(COMPARED_VARIANTS) :]:
        if point.method != "euclidean":  # which knows no limits of speed, and may gain by that
            assert on_the_front(points, point.roughness) <= point.e3 + 1e-6, point
