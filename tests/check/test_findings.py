"""The checker's verdicts beside made-up motions, whose figures are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ctr_nlp.check import checker
from ctr_nlp.check.checker import NO, NOT_COVERED, YES, CheckResult
from ctr_nlp.check.plan_file import PlanFile
from ctr_nlp.check.walls import measure_clearance

LENGTH = 100.0
TUBE = {"length": 150.0, "curved_length": 60.0, "curvature": 0.005, "outer_diameter": 3.0, "inner_diameter": 2.0}
TUBE |= {"poisson_ratio": 0.3, "youngs_modulus": 1.0, "pre_torsion": 0.0}
INNER = TUBE | {"length": 200.0, "curved_length": 80.0, "outer_diameter": 1.8, "inner_diameter": 1.0}
TOLERANCES = {
    "tip_force": 0.0,
    "distribution": "uniform",
    "covariance": None,
    "diameter": 0.0,
    "rotation_lag": 0.1,
}
TOLERANCES |= {"curvature": [0.02, 0.0], "bending_stiffness": 0.03, "torsional_ratio": 0.0, "curved_length": 0.0}
TOLERANCES |= {"motor_zero": 0.05}


def straight(*aside):
    """Shapes (T, 101, 3) along z, all of whose points but the first are aside by these mm."""
    shape = np.zeros((len(aside), 101, 3))
    shape[..., 2] = np.linspace(0, LENGTH, 101)
    shape[:, 1:, 0] = np.array(aside)[:, None]
    return shape


def judged(*aside, beta=LENGTH, degrees=0.0, deepest=(), kept_out=(), known=True, **options):
    """Verdicts on a motion along a straight target, by these distances in mm from it."""
    frames = len(aside)
    arrays = {"target": straight(*np.zeros(frames)), "beta": np.full((frames, 1), beta)}
    file = PlanFile(arrays, {"options": options}, None, "")
    file.__dict__["walls"] = [SimpleNamespace(kept_out=each) for each in kept_out]
    clearance = np.full((frames, 10, 101), 1.0 if known else np.nan)
    shape, margin = straight(*aside), np.full((frames, 10), 0.5)
    e2 = checker.measure_errors(shape, arrays["target"])
    found = CheckResult(file, {}, shape=shape, e2=e2, margin=margin, clearance=clearance, tip_degrees=degrees)
    return checker._judge_shapes(replace(found, deepest=np.array(deepest, dtype=float)))


def test_last_tip_decides_whether_a_motion_arrives():
    assert judged(9.0, 1.5)["arrives"][:3] == (YES, 1.5, 0.5)
    assert judged(0.0, 2.5)["arrives"][:3] == (NO, 2.5, -0.5)
    assert judged(0.0, 2.5, arrival_tolerance=3.0)["arrives"].word == YES
    assert judged(0.0, np.nan)["arrives"].word == NOT_COVERED


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"degrees": 89.0}, YES),
        ({"degrees": 91.0}, NO),
        ({"beta": LENGTH - 9.0}, YES),
        ({"beta": LENGTH - 11.0}, NO),
        ({"beta": LENGTH + 11.0}, YES),
        ({"degrees": 91.0, "arrival_tolerance": 11.0}, YES),
    ],
)
def test_robot_must_arrive_along_the_path(changes, word):
    found = judged(0.0, 0.0, **changes)["arrives"]
    assert found.word == word
    assert (found.why == checker.DETOUR) == (word == NO)


def test_tip_that_arrives_beside_the_path_does_not_count():
    aside = straight(0.0)
    aside[0, 1:-1, 0] = 12.0
    arrays = {"target": straight(0.0), "beta": np.full((1, 1), LENGTH)}
    e2 = checker.measure_errors(aside, arrays["target"])
    file = PlanFile(arrays, {}, None, "")
    file.__dict__["walls"] = []
    found = CheckResult(file, {}, shape=aside, e2=e2, margin=np.ones((1, 10)), clearance=np.ones((1, 10, 101)))
    assert checker._judge_shapes(found)["arrives"].why == checker.DETOUR


def test_errors_are_means_by_trapezoids():
    shape, target = np.zeros((2, 101, 3)), np.zeros((2, 101, 3))
    shape[0, 0, 0] = shape[1, 50, 1] = 10.0
    np.testing.assert_allclose(checker.measure_errors(shape, target), [np.sqrt(0.5), 1.0])


def test_worst_frame_decides_whether_a_motion_follows():
    found = judged(1.0, 1.8, 0.5)["follows"]
    assert found.word == YES
    assert found.number == pytest.approx(1.8, rel=0.01)
    assert "in frame 2" in found.why
    assert judged(1.0, 2.5, 0.0)["follows"].word == NO
    assert judged(1.0, 2.5, 0.0, error_allowed=3.0)["follows"].word == YES
    assert judged(np.nan, 0.0)["follows"].word == NOT_COVERED


def test_each_wall_has_its_own_limit():
    assert judged(0.0)["within_wall"].word == NOT_COVERED
    assert judged(0.0, deepest=[0.4], kept_out=[False])["within_wall"][:2] == (YES, 0.4)
    assert judged(0.0, deepest=[0.6], kept_out=[False])["within_wall"][:2] == (NO, 0.6)
    assert judged(0.0, deepest=[0.6], kept_out=[False], contact_allowed=0.7)["within_wall"].word == YES
    assert judged(0.0, deepest=[0.1, 0.3], kept_out=[True, False])["within_wall"][:2] == (NO, 0.1)
    assert judged(0.0, deepest=[-0.1, 0.3], kept_out=[True, False])["within_wall"][:2] == (YES, 0.0)
    clear = judged(0.0, deepest=[-0.123], kept_out=[False])["within_wall"]
    assert clear.number == 0.0  # contact is never negative
    assert "0.12 mm clear" in clear.why
    assert judged(0.0, deepest=[0.4], kept_out=[False], known=False)["within_wall"].word == NOT_COVERED


class Flat:
    """A wall at x = 0 whose triangles are 0.3 mm nearer than its smooth surface."""

    def left(self, points):
        return points[..., 0]

    def left_exactly(self, points):
        return points[..., 0] - 0.3


def test_places_that_may_be_the_nearest_are_measured_at_triangles():
    points = np.zeros((2, 4, 3))
    points[..., 0] = [[1.2, 1.5, 1.9, 3.0], [1.9, 2.4, 4.0, 9.0]]
    radius = np.ones((2, 4))
    smooth = points[..., 0] - 1.0
    of_each, of_all, of_second = smooth.copy(), smooth.copy(), smooth.copy()
    of_each[[0, 0, 1], [0, 1, 0]] -= 0.3  # within 0.6 mm of the least of its robot, and 1 mm of the wall
    of_all[0, :2] -= 0.3
    of_second[1, 0] -= 0.3
    np.testing.assert_allclose(measure_clearance([Flat()], points, radius), of_each)
    np.testing.assert_allclose(measure_clearance([Flat()], points, radius, known=smooth.min()), of_all)
    known = np.array([[-9.0], [1.0]])
    np.testing.assert_allclose(measure_clearance([Flat()], points, radius, known), of_second)
    np.testing.assert_allclose(measure_clearance([Flat()], points, radius, known=-np.inf), smooth)
    assert np.isinf(measure_clearance([], points, radius)).all()


def test_outermost_tube_counts_up_to_its_end():
    beta, radius = np.array([[50.0, 20.5], [100.0, 100.0]]), np.array([[3.0, 2.5], [2.0, 1.0]])
    found = checker.find_radius(beta, radius)
    assert [(found[0] == 3.0).sum(), (found[1] == 2.5).sum()] == [51, 21]
    assert [found[0, 51], found[1, 21], found[0, -1]] == [2.0, 1.0, 2.0]


def robot_file(frames=3, arrays=None, tolerances=None, **meta):
    """The file of a robot of two tubes that stands still."""
    given = {"alpha": np.zeros((frames, 2)), "beta": np.tile([40.0, 70.0], (frames, 1))}
    given |= {"theta": np.zeros((frames, 2)), "time": np.arange(1.0, frames + 1)}
    robot = {"tubes": [TUBE, INNER], "limits": {}, "tolerances": TOLERANCES | (tolerances or {})}
    return PlanFile(given | (arrays or {}), {"robot": robot, "model": "elastic", "problem": {}} | meta, None, "")


@pytest.mark.parametrize(
    ("beta", "covered"),
    [
        ([0.0, 0.0], True),
        ([40.0, 70.0], True),
        ([-0.1, 70.0], False),
        ([40.0, 39.9], False),
        ([150.1, 160.0], False),
    ],
)
def test_tubes_must_be_where_the_equations_apply(beta, covered):
    reason = checker._find_reason_not_covered(robot_file(arrays={"beta": np.tile(beta, (3, 1))}))
    assert reason == ("" if covered else "Tubes are further out than they are long, or out of order.")


def test_unknown_frames_and_loads_are_not_covered():
    unknown = robot_file(arrays={"alpha": np.full((3, 2), np.nan)})
    assert checker._find_reason_not_covered(unknown) == "Frames have no configuration."
    for name in ("load", "planned_load"):
        assert "under a load" in checker._find_reason_not_covered(robot_file(**{name: {"force": [0, 0, 1]}}))
    assert checker._find_reason_not_covered(robot_file(load=None, planned_load={})) == ""


def test_samples_are_those_of_the_file_or_drawn_from_its_bands():
    parts, lags = checker._take_samples(robot_file(), 500)
    half = np.abs(parts).max(axis=0)
    assert parts.shape == (500, 2, 5)
    np.testing.assert_allclose(half[0], [0.02, 0.03, 0.0, 0.0, 0.05], rtol=0.05)
    np.testing.assert_allclose(half[1], [0.0, 0.03, 0.0, 0.0, 0.05], rtol=0.05)
    np.testing.assert_allclose(parts[..., 1].mean(axis=0), 0.0, atol=0.005)
    assert lags.min() >= 0
    np.testing.assert_allclose(lags.max(axis=0), 0.1, rtol=0.05)
    own = {"draws_parts": np.ones((4, 2, 5)), "draws_lags": np.ones((4, 2))}
    assert len(checker._take_samples(robot_file(arrays=own), 3)[0]) == 3
    assert checker._take_samples(robot_file(), 0) is None
    for change in ({"tip_force": 0.1}, {"distribution": "normal"}, {"covariance": []}, {"diameter": 0.01}):
        assert checker._take_samples(robot_file(tolerances=change), 3) is None


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({}, "No samples were simulated."),
        ({"tip_force": 0.1}, "Samples under a tip force or of other tolerances than uniform ones."),
    ],
)
def test_reason_for_missing_samples_is_given(change, why):
    straight_target = np.zeros((3, 101, 3))
    arrays = {"target": straight_target, "target_direction": np.tile([0.0, 0, 1], (3, 1))}
    arrays |= {"success": np.ones(3, dtype=bool), "kkt": np.zeros(3)}
    found = checker.examine_motion(robot_file(arrays=arrays, tolerances=change), 2 * bool(change))
    assert found.findings["holds"].word == NOT_COVERED
    assert found.findings["holds"].why.startswith(why)


def with_samples(parts, lags, **arrays):
    """The result on a robot that stands still, with these samples."""
    given = {"target": np.zeros((3, 101, 3)), "target_direction": np.tile([0.0, 0, 1], (3, 1))}
    given |= {"success": np.ones(3, dtype=bool), "kkt": np.zeros(3)}
    given |= {"draws_parts": np.array(parts), "draws_lags": np.array(lags)}
    return checker.examine_motion(robot_file(arrays=given | arrays), len(parts))


def test_samples_like_the_robot_touch_the_wall_as_it_does():
    z = np.linspace(-5, 90, 96)
    table = np.stack([0 * z, 0 * z, z, 0 * z + 4.0], axis=-1)
    found = with_samples(np.zeros((2, 2, 5)), np.zeros((2, 2)), lumen=table)
    assert found.deepest[0] > 1.0
    np.testing.assert_allclose(found.samples["contacts"], found.deepest[0], atol=1e-6)
    np.testing.assert_allclose(found.samples["tips"], found.shape[-1, -1] + np.zeros((2, 3)), atol=1e-6)
    np.testing.assert_allclose(found.samples["errors"], found.e2 + np.zeros((2, 1)), atol=1e-6)
    np.testing.assert_allclose(found.shape[0], found.shape[2], atol=1e-9)
    assert found.samples["pressed"].all()


def test_the_frame_of_the_least_margin_is_named():
    margin = np.full((4, 10), 0.5)
    margin[2, 3] = 0.3
    found = checker._judge_stability(margin, [], 0.1)
    assert (found.word, found.number) == (YES, 0.3)
    assert found.why == "The least margin is around frame 3."
    assert checker._judge_stability(margin, [2], 0.1).why == "The robot snaps on the way to frame 2."


def test_the_last_frames_tip_is_compared_with_the_targets_end():
    beta = np.array([[40.0, 50.0], [40.0, 60.0], [40.0, 90.0]])
    given = {"target": np.zeros((3, 101, 3)), "target_direction": np.tile([0.0, 0, 1], (3, 1))}
    given |= {"success": np.ones(3, dtype=bool), "kkt": np.zeros(3)}
    moved, still = (
        checker.examine_motion(robot_file(arrays=given | {"beta": each})) for each in (beta, beta[[2, 2, 2]])
    )
    assert moved.tip_degrees == pytest.approx(still.tip_degrees, abs=1e-6)
    others = checker.examine_motion(robot_file(arrays=given | {"beta": beta[[1, 1, 1]]}))
    assert abs(moved.tip_degrees - others.tip_degrees) > 1


class NearlyRound:
    """A cylinder whose smooth field leaves 0.2 mm more room than its triangles."""

    kept_out = False

    def left(self, points):
        return 4.0 - np.hypot(points[..., 0], points[..., 1])

    def left_exactly(self, points):
        return self.left(points) - 0.2


def test_contact_of_samples_is_measured_at_triangles():
    given = {"target": np.zeros((3, 101, 3)), "target_direction": np.tile([0.0, 0, 1], (3, 1))}
    given |= {"success": np.ones(3, dtype=bool), "kkt": np.zeros(3)}
    given |= {"draws_parts": np.zeros((2, 2, 5)), "draws_lags": np.zeros((2, 2))}
    file = robot_file(arrays=given)
    file.__dict__["walls"] = [NearlyRound()]
    found = checker.examine_motion(file, 2)
    assert found.deepest[0] > 1.0
    np.testing.assert_allclose(found.samples["contacts"], found.deepest[0], atol=1e-6)


@pytest.mark.parametrize(
    ("success", "kkt", "word", "number"),
    [
        ([True, True, True], [0.0, 0.005, 0.01], YES, 3),
        ([True, True, True], [0.0, 0.005, 0.02], NO, 2),
        ([True, True, False], [0.0, 0.005, 0.02], NO, 2),
        ([True, True, True], [0.0, np.nan, 0.001], NOT_COVERED, 2),
    ],
)
def test_frames_are_solved_where_their_residual_is_small(success, kkt, word, number):
    found = checker._judge_solved(robot_file(arrays={"success": np.array(success), "kkt": np.array(kkt)}))
    assert (found.word, found.number) == (word, number)


def test_innermost_tube_begins_where_its_motor_is():
    alpha = np.tile([0.0, 0.4], (3, 1))
    lags = [[0.0, 0.1], [0.0, 0.0], [0.1, 0.0]]
    tips = with_samples(np.zeros((3, 2, 5)), lags, alpha=alpha).samples["tips"]
    assert np.linalg.norm(tips[0] - tips[1]) < 1e-6  # it does not turn, so that its play is not taken up
    assert np.linalg.norm(tips[2] - tips[1]) > 0.1


def test_samples_on_another_branch_are_lost():
    """Robots that are turned as a whole are on the nominal one's branch; with one tube turned they are not."""
    parts = np.zeros((3, 2, 5))
    parts[0, :, 4], parts[1, 0, 4], parts[2, 0, 4] = 1.5, 1.5, 0.5
    found = with_samples(parts, np.zeros((3, 2)))
    assert found.samples["lost"].tolist() == [False, True, False]
    assert np.isnan(found.samples["tips"]).all(axis=1).tolist() == [False, True, False]
    assert np.isnan(found.samples["contacts"]).tolist() == [False, True, False]


LIMITS = {"alpha": [["-inf", "inf"]], "beta": [[0.0, 60.0], [0.0, 80.0]], "theta": [[-1.0, 1.0]]}


@pytest.mark.parametrize(
    ("steps", "limits", "word", "number", "which"),
    [
        ([0, 0, 1, 1, 0, 0], {}, YES, 0.0, "fit of tubes"),
        ([0, 0, 11, 1, 0, 0], {}, NO, 0.0, "range"),
        ([0, 0, 0, 0, 0.6, 0], {}, NO, 0.0, "range"),
        ([0, 0, 0, 0, 0, -0.6], {}, NO, 0.0, "range"),
        ([0, 0, 0, 5.5, 0, 0], {}, NO, 0.0, "range"),
        ([0.2, 0, 0, 0, 0, 0], {"alpha_speed": 0.4}, YES, 100.0, "fit of tubes"),
        ([0.19, 0, 0, 0, 0, 0], {"alpha_speed": 0.4}, YES, 95.0, "speed"),
        ([0.21, 0, 0, 0, 0, 0], {"alpha_speed": 0.4}, NO, 105.0, "speed"),
        ([0, 0, 0, 1.1, 0, 0], {"beta_speed": [1.0, 2.0]}, NO, 110.0, "speed"),
        ([0, 0, 0, 0.9, 0, 0], {"beta_speed": [1.0, 2.0]}, YES, 90.0, "fit of tubes"),
    ],
)
def test_limits_bound_positions_and_rates(steps, limits, word, number, which):
    q = np.array([0, 0, 40, 70, 0, 0]) + np.arange(3)[:, None] * np.array(steps, dtype=float)
    arrays = {"alpha": q[:, :2], "beta": q[:, 2:4], "theta": q[:, 4:], "time": 0.5 * np.arange(1, 4)}
    file = robot_file(arrays=arrays)
    file.meta["robot"]["limits"] = LIMITS | limits
    found = checker._judge_limits(file)
    assert found.word == word
    assert found.number == pytest.approx(number, abs=1e-9)
    assert which in found.why or which == "fit of tubes"


def test_accelerations_and_carriages_have_limits():
    q = np.zeros((3, 6))
    q[:, 2:4], q[2, 0] = (40.0, 70.0), 0.3
    arrays = {"alpha": q[:, :2], "beta": q[:, 2:4], "theta": q[:, 4:], "time": 0.5 * np.arange(1, 4)}
    file = robot_file(arrays=arrays)
    cases = {"alpha_acceleration": (1.3, 1.1), "carriage_gap": (19.0, 21.0)}
    for name, (allowed, exceeded) in cases.items():
        for value, word in ((allowed, YES), (exceeded, NO)):
            file.meta["robot"]["limits"] = LIMITS | {name: value}
            assert checker._judge_limits(file).word == word
    file.arrays["alpha"][0] = np.nan
    unknown = PlanFile(file.arrays, file.meta, None, "")
    assert checker._judge_limits(unknown).word == NOT_COVERED


def test_tubes_without_given_limits_go_to_the_end_of_their_curved_part():
    limits = {"alpha": [["-inf", "inf"]], "beta": None, "theta": [[-1.0, 1.0]]}
    for curvature, word in ((0.005, NO), (0.0, YES)):
        file = robot_file(arrays={"beta": np.tile([61.0, 70.0], (3, 1))})
        file.meta["robot"]["tubes"] = [TUBE | {"curvature": curvature}, INNER]
        file.meta["robot"]["limits"] = limits
        assert checker._judge_limits(file).word == word


def test_tubes_must_fit_in_each_other():
    file = robot_file()
    file.meta["robot"]["limits"] = LIMITS
    assert checker._judge_limits(file).word == YES
    file.meta["robot"]["tubes"] = [TUBE, INNER | {"outer_diameter": 2.1}]
    found = checker._judge_limits(file)
    assert (found.word, found.distance) == (NO, pytest.approx(-0.1, abs=1e-4))
    assert "fit of tubes in each other" in found.why
