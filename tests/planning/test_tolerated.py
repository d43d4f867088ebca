"""Plans for all robots that tolerances allow: what is planned for, and who is lost."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from ctr_nlp import (
    Limits,
    Problem,
    Robot,
    Settings,
    Tolerances,
    Tube,
    curve_from_formula,
    growing,
    solve_horizon,
    table_i_robot,
)
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.plan.sample_motions import find_failure_frames
from ctr_nlp.robot.samples import perturb_robot, sample_robots
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES
from ctr_nlp.robust import solve_robust
from ctr_nlp.robust import trials as trials_module
from ctr_nlp.robust.tolerance_scenarios import scenarios_from_tolerances, two_level_orthogonal_array
from ctr_nlp.robust.trials import CERTIFICATION_SAMPLES, TRIAL_FIRST_SAMPLE_SEED, Trials

TUBES = Tube(150, 90, 0.012, 3, 2), Tube(300, 140, 0.015, 1.8, 1.2)


def deviations(robot, scenarios):
    """By what part (S, d) curvature and bending stiffness of scenarios differ from a robot's, and offsets."""
    parts = scenarios.numbers / np.where(robot.numbers == 0, 1.0, robot.numbers) - 1
    names = TUBE_NUMBER_NAMES.index("root_curvature"), TUBE_NUMBER_NAMES.index("bending_stiffness")
    return np.concatenate([*(parts[..., name] for name in names), scenarios.offsets], axis=1)


@pytest.mark.parametrize("count", range(1, 25))
def test_balanced_deviations_have_no_mean_unit_variance_and_no_correlation(count):
    found = two_level_orthogonal_array(count)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose(found.T @ found / len(found), np.eye(count), atol=1e-15)


def test_scenarios_have_the_mean_and_the_covariance_of_the_tolerances():
    robot = replace(table_i_robot(), tolerances=Tolerances(curvature=[0.01, 0.02, 0.03], motor_zero=0.05))
    scenarios = scenarios_from_tolerances(robot)
    found = deviations(robot, scenarios)
    assert abs(found[0]).max() == 0
    assert scenarios.weights[0] == 0
    np.testing.assert_allclose(found[1:].mean(axis=0), 0, atol=1e-15)
    bands = np.r_[0.01, 0.02, 0.03, [0.02] * 3, [0.05] * 3]
    np.testing.assert_allclose(np.cov(found[1:].T, bias=True), np.diag(bands**2 / 3), atol=1e-15)


def test_scenarios_are_as_correlated_as_a_covariance_says():
    generator = np.random.default_rng(3)
    factor = 0.01 * generator.standard_normal((15, 15))
    covariance = factor @ factor.T
    robot = replace(table_i_robot(), tolerances=Tolerances(distribution="normal", covariance=covariance))
    robot = robot.with_limits(beta=[(0, 20), (0, 40), (0, 60)])
    found = deviations(robot, scenarios_from_tolerances(robot))
    places = [5 * tube + name for name in (0, 1, 4) for tube in range(3)]
    np.testing.assert_allclose(np.cov(found[1:].T, bias=True), covariance[np.ix_(places, places)], atol=1e-12)


@pytest.mark.parametrize(
    ("tolerances", "message"),
    [
        (Tolerances(0, 0, motor_zero=0), "all tolerances of the robot are 0"),
        (Tolerances(curved_length=1.0), "curved_length of tolerances"),
    ],
)
def test_what_cannot_be_planned_for_is_refused(tolerances, message):
    with pytest.raises(OptionError, match=message):
        scenarios_from_tolerances(replace(table_i_robot(), tolerances=tolerances))


@pytest.fixture(scope="module")
def problem():
    """A straight path, which two strongly curved tubes can follow only by opposing each other."""
    robot = Robot(TUBES, Limits(beta=[(0, 85), (0, 135)]), tolerances=Tolerances(0.05, 0.05, motor_zero=0.05))
    path = curve_from_formula(lambda u: (0, 0, u), 0.0, 120.0)
    return Problem("straight", robot, growing(path, 12))


@pytest.fixture(scope="module")
def plain(problem):
    return solve_horizon(problem, model="elastic", settings=Settings(arrival_weight=0.0))


def test_a_robust_plan_keeps_robots_that_a_plain_one_loses(problem, plain):
    robust, draws = solve_robust(problem), sample_robots(problem.robot, 60, 5)
    assert robust.complete
    lost = [
        int((find_failure_frames(problem.robot, draws, plan.q, "elastic") > 0).sum()) for plan in (plain, robust)
    ]
    assert lost[0] > 5
    assert lost[1] <= 1
    certificate = robust.meta["certificate"]
    assert certificate["held"] == (certificate["lost"] <= 1)
    assert certificate["draws"] >= 500


@pytest.mark.parametrize(("most_lost", "samples"), [(0.01, 500), (0.002, 1497), (1e-4, 29956)])
def test_as_many_robots_are_simulated_as_it_takes_to_be_certain(most_lost, samples):
    """Where no more are lost than allowed, and no less certainly so; scipy has Clopper's and Pearson's bound."""
    trials = Trials(table_i_robot(), KINEMATIC_MODELS["elastic"], most_lost)
    assert trials.certificate_samples == samples
    allowed = trials.allowed_failures(samples)
    for lost, holds in ((allowed, True), (allowed + 1, False)):
        bound = binomtest(lost, samples, alternative="less").proportion_ci(0.95, "exact").high
        assert (bound <= most_lost) == holds


def test_a_search_is_stricter_than_the_certificate_and_costs_little():
    for most_lost in (0.1, 0.01, 1e-3):
        trials = Trials(table_i_robot(), KINEMATIC_MODELS["elastic"], most_lost)
        few = trials.search_samples
        assert trials.allowed_failures(few, 0.998) <= trials.allowed_failures(few)
    assert Trials(table_i_robot(), KINEMATIC_MODELS["elastic"], 1e-5).search_samples == 5000


def test_a_plan_that_passes_the_search_by_luck_is_not_certified(problem, plain, monkeypatch):
    """One robot in 2,000 is lost: not among the 5,000 of the search, here, but among those of the certificate."""
    trials = Trials(problem.robot, KINEMATIC_MODELS["elastic"], 1e-4)
    seen = []

    def find(_, group, *given):
        seen.append(len(group))
        lost = np.arange(sum(seen) - len(group), sum(seen)) % 2000 == 1999
        return lost * 2 if sum(seen) > 5000 else np.zeros(len(group), dtype=int)

    monkeypatch.setattr(trials_module, "find_failure_frames", find)
    assert trials(plain.q, 0).few
    assert sum(seen) == 5000
    told = trials.certify_plan(plain, 1).meta["certificate"]
    assert not told["held"]
    assert not told["certified"]
    assert 6 <= told["lost"] < 10


@pytest.mark.parametrize("share", [0.002, 0.05, 0.3])
def test_samples_that_count_do_not_depend_on_calls(share, monkeypatch):
    """Robots whose first motor is far off are lost; calls of at most 50 samples or of 1,000."""
    robot = table_i_robot()
    monkeypatch.setattr(
        trials_module,
        "find_failure_frames",
        lambda _, group, *given: (group.offsets[:, 0] > 0.02 - 0.04 * share) * 3,
    )
    found = []
    for most in (50, 1000):
        monkeypatch.setattr(trials_module, "MAX_TRIAL_SAMPLES_PER_CALL", most)
        found.append(Trials(robot, KINEMATIC_MODELS["elastic"], 0.001)(np.zeros((2, 8)), 0))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_motion_on_which_many_are_lost_bears_a_part_of_the_tolerances(problem, plain):
    trials = Trials(problem.robot, KINEMATIC_MODELS["elastic"])
    lost = trials(plain.q, 0)
    assert not lost.few
    assert 6 <= len(lost.frames) <= lost.sample_count < trials.search_samples
    draws = sample_robots(problem.robot, trials.search_samples, TRIAL_FIRST_SAMPLE_SEED)
    gone = find_failure_frames(problem.robot, draws[: lost.sample_count], plain.q, "elastic")
    np.testing.assert_array_equal(gone[gone > 0], lost.frames)
    np.testing.assert_array_equal(draws.numbers[: lost.sample_count][gone > 0], lost.numbers)
    told = trials.certify_plan(plain, 1).meta["certificate"]
    assert not told["held"]
    assert not told["certified"]
    fresh = plain.with_samples(CERTIFICATION_SAMPLES, TRIAL_FIRST_SAMPLE_SEED + 1)
    assert told["holds"] == pytest.approx(fresh.verdicts.holds.number * CERTIFICATION_SAMPLES)
    bound = binomtest(
        CERTIFICATION_SAMPLES - told["holds"], CERTIFICATION_SAMPLES, alternative="less"
    ).proportion_ci(0.95, "exact")
    assert told["holds_at_least"] == pytest.approx(1 - bound.high)
    assert sum(told["lost_in"].values()) == told["lost"] >= 6
    assert 0 <= told["borne"] < 1
    others = sample_robots(problem.robot, 200, 7)
    shrunk = perturb_robot(problem.robot, told["borne"] * others.deviations, others.backlash)
    assert (find_failure_frames(problem.robot, shrunk, plain.q, "elastic") > 0).mean() <= 0.02
