"""Robots in closed loop that bear a known load, and that a force pushes which nobody told of."""

from dataclasses import replace

import numpy as np
import pytest
from loops_of import OFF, ROBOT, SENSORS, made_plan
from near_fold import near_the_fold, plan_through

from ctr_nlp import Load, Loaded, LoadOverTime, Tolerances
from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.identify.closed_loop.feed import Feed
from ctr_nlp.identify.closed_loop.observer import Observer
from ctr_nlp.identify.closed_loop.parameter_differences import FORCE_COMPONENT_NAMES, ParameterDifferences
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.prediction import Predictor
from ctr_nlp.identify.closed_loop.runs import closed_loop, open_loop
from ctr_nlp.identify.closed_loop.tracker import Tracker, TrackerState
from ctr_nlp.models import KINEMATIC_MODELS, model_with_load
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.robot.samples import perturb_robot, sample_robots

STIFF = with_modulus(ROBOT, 60_000)
NEWTONS = 3.0
"""Of the force: the tubes are stiff, and 0.1 N moves their tip by less than a sensor's noise."""
PUSHED = replace(OFF, tip_force=NEWTONS)
ALONE = Tolerances(0.0, 0.0, motor_zero=0.0, tip_force=NEWTONS)
KNOWN = Load(force=(0.0, 0.05, 0.0), densities=6.45, down=(1, 0, 0))


@pytest.fixture(scope="module")
def plan():
    return made_plan().with_modulus(60_000)


def away(run, plan):
    """Root mean square distance from the planned shapes, mm."""
    return float(np.sqrt(((run.shape - plan.shape) ** 2).sum(axis=-1).mean()))


@pytest.mark.parametrize(
    "load", [Load(), pytest.param(KNOWN, marks=pytest.mark.slow)], ids=["pushed", "pushed beside a load"]
)
def test_slopes_of_what_is_measured_match_finite_differences(plan, load):
    of, step, model = ParameterDifferences.of(STIFF, PUSHED), 1e-4, model_with_load("elastic", load)
    predictor = Predictor(model, STIFF.structure, SENSORS.sigma, of.tube_parts, has_tip_force=True)
    found = Observer(model, of, SENSORS, predictor)
    found.move_motors(plan.q[0], 0.0)
    found.move_motors(plan.q[30], 1.0)
    _, slopes = found.expected_reading(1.0)
    assert [of.entries[k][1] for k in of.force_indices] == list(FORCE_COMPONENT_NAMES)
    for k in range(len(of)):
        ends = []
        for side in (1, -1):
            values = side * step * np.eye(len(of))[k]
            own = of.perturbed_robots(values[None])
            draw = perturb_robot(STIFF, own.deviations, own.backlash, values[None, of.force_indices])
            plant = Plant(STIFF, draw, model)
            plant.move_to(plan.q[0], 0.0)
            plant.move_to(plan.q[30], 1.0)
            ends.append(SENSORS.values(plant.sample_shape(SENSORS.sigma)))
        assert slopes[:, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02, abs=0.05)


def test_slopes_over_motors_are_those_of_the_loaded_robot(plan):
    """Alpha, beta and theta, of which the unknowns of a loaded robot hold beta alone."""
    model, q, step = model_with_load("elastic", KNOWN), plan.q[30], 1e-4
    predict = Predictor(model, STIFF.structure, SENSORS.sigma, ())
    load = KNOWN.numbers(STIFF.d)

    def seen(place):
        return predict(model.rest(STIFF, place), STIFF.numbers, STIFF.numbers, 0.5, load)

    slopes = seen(q).of_points.copy()
    for k in range(len(q)):
        ends = [seen(q + side * step * np.eye(len(q))[k]).points.copy() for side in (1, -1)]
        np.testing.assert_allclose(slopes[k], (ends[0] - ends[1]) / (2 * step), rtol=0.01, atol=0.02)


@pytest.mark.parametrize(
    "sides",
    [
        [[1, 0, 0], [0, -1, 0]],
        pytest.param([[-1, 0, 0], [0, 1, 0]], marks=pytest.mark.slow),
    ],
    ids=["two sides", "the others"],
)
def test_a_force_at_the_tip_is_found(plan, sides):
    """On a robot whose tubes are known; to within what is told to be left of doubt."""
    for force in NEWTONS * np.array(sides):
        draw = perturb_robot(STIFF, np.zeros((1, 2, 5)), np.zeros((1, 2)), force[None])
        plant = Plant(STIFF, draw)
        run = closed_loop(plan, plant, Feed(plant, SENSORS, 1), Tracker(plan, SENSORS, ALONE))
        assert not run.first_failed_frame
        assert (abs(run.means[-1] - force) < 3.5 * run.deviations[-1]).all()
        assert (run.deviations[-1, :2] < np.array([0.35, 0.6]) * NEWTONS / np.sqrt(3)).all()
        assert away(run, plan) < 0.6 * away(open_loop(plan, Plant(STIFF, draw)), plan)


@pytest.mark.slow
def test_tubes_and_a_force_are_told_apart_well_enough_to_steer(plan):
    draws = sample_robots(replace(STIFF, tolerances=PUSHED), 4, 1)
    for k in range(4):
        plant = Plant(STIFF, draws[k : k + 1])
        run = closed_loop(plan, plant, Feed(plant, SENSORS, k), Tracker(plan, SENSORS, PUSHED))
        assert not run.first_failed_frame
        assert not run.stopped
        assert away(run, plan) < 0.7 * away(open_loop(plan, Plant(STIFF, draws[k : k + 1])), plan)


@pytest.mark.slow
def test_a_plan_for_a_known_load_is_tracked_under_it(plan):
    loaded = plan.with_load(KNOWN)
    draws = sample_robots(replace(STIFF, tolerances=OFF), 2, 1)
    for k in range(2):
        plant = Plant(STIFF, draws[k : k + 1], Loaded(KNOWN))
        run = closed_loop(loaded, plant, Feed(plant, SENSORS, k), Tracker(loaded, SENSORS, OFF))
        assert not run.first_failed_frame
        assert not run.stopped
        assert away(run, loaded) < 0.6 * away(
            open_loop(loaded, Plant(STIFF, draws[k : k + 1], Loaded(KNOWN))), loaded
        )


@pytest.mark.slow
def test_a_robot_that_snaps_under_a_load_is_stopped():
    """Where it comes to rest is not known."""
    q = np.vstack([near_the_fold(), near_the_fold()[-1:]])
    q[-1, 0] += 0.4
    plan = plan_through(q, STIFF).with_load(Load((0.0, 0.0, -1e-4)))
    tracker = Tracker(plan, SENSORS, Tolerances(1e-4, 0.0, motor_zero=0.0))
    for place, time in zip(plan.q, plan.time.tolist(), strict=True):
        assert tracker.state is not TrackerState.STOPPED
        tracker.observe(place, time, [])
    assert tracker.state is TrackerState.STOPPED
    assert np.isnan(tracker.observer.jumps[0]).all()


def test_a_force_is_no_part_of_the_robot_that_is_estimated():
    of = ParameterDifferences.of(STIFF, PUSHED)
    robot = of.robot_at(np.append(np.zeros(len(of) - 3), [0.1, 0, 0]), of.covariance)
    assert robot.tolerances.tip_force == 0
    np.testing.assert_allclose(robot.numbers, STIFF.numbers)
    assert of.values_by_name(of.mean)["force_x"] == 0.0


def test_what_cannot_be_tracked_is_refused_at_once(plan):
    with pytest.raises(LoadError, match="modul"):
        Tracker(made_plan(), SENSORS, PUSHED)
    with pytest.raises(LoadError, match="an observer needs a load that stays the same"):
        Tracker(plan.with_load(LoadOverTime([Load(), KNOWN], [0, 1])), SENSORS, OFF)
    draw = perturb_robot(STIFF, np.zeros((1, 2, 5)), np.zeros((1, 2)), np.array([[0.1, 0, 0]]))
    with pytest.raises(LoadError, match="axes of the tool"):
        Plant(STIFF, draw, Loaded(Load(force=(0.0, 0.0, 0.1), axes="tool")))
    with pytest.raises(OptionError, match="does not support loads"):
        KINEMATIC_MODELS["elastic"].walker(STIFF.structure, STIFF.numbers, plan.q[0]).change_load(KNOWN.numbers(2))
