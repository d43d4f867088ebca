"""Robots found from measurements, against those that were measured."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensed import TWO, measured_shapes, observations, parts_within, shapes_of, weighed, wide

from ctr_nlp import Load, LoadOverTime, Robot, Tolerances, Tube, calibrate, table_i_robot
from ctr_nlp.cli.measured.calibration_files import robot_file_comment
from ctr_nlp.exceptions import LoadError, MeasurementError, OptionError
from ctr_nlp.identify.calibration.parameters import parameters_of
from ctr_nlp.identify.calibration.residuals import errors, summary_of
from ctr_nlp.models import KINEMATIC_MODELS, model_with_load
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.plan.backlash import BacklashAndDrag, delay_configurations
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.support.value_checks import read_toml


def off(found, parts):
    """By how many standard deviations parameters of tubes are off, by name."""
    rows = zip(found.parameters.each, found.fit.values, found.fit.sigma, strict=True)
    return {
        one.name: (value - parts[one.number - 1, DEVIATION_NAMES.index(one.kind)]) / sigma
        for one, value, sigma in rows
        if one.kind in DEVIATION_NAMES
    }


@pytest.mark.parametrize("seed", range(4))
def test_tubes_and_zeros_are_found_within_three_standard_deviations(seed):
    parts = parts_within(TWO, seed)
    found = calibrate(TWO, measured_shapes(TWO, parts, seed), registered=True, held_out=0)
    assert max(map(abs, off(found, parts).values())) < 3
    assert found.fit.noise.position == pytest.approx(0.5, rel=0.1)
    assert (found.fit.sigma_ratio[found.parameters.columns("curvature", "motor_zero")] < 0.25).all()


def test_a_slice_of_the_synthetic_trials():
    """Three tubes, 60 poses, shapes with 0.5 mm: scripts/studies/calibrate_synthetic.py makes it a hundred."""
    robot = wide(table_i_robot())
    parts = parts_within(robot, 0)
    found = calibrate(robot, measured_shapes(robot, parts, 0, 60, 10), held_out=0)
    determined = [
        name for name, how in zip(found.parameters.names, found.standing, strict=True) if how == "determined"
    ]
    assert {"curvature_1", "curvature_2", "curvature_3"} <= set(determined)
    assert max(abs(z) for name, z in off(found, parts).items() if name in determined) < 3


def test_what_no_shape_shows_is_told_and_stays_as_it_was():
    """Without an arm the common zero is the base's roll; of stiffnesses only ratios show."""
    robot = wide(TWO)
    found = calibrate(robot, measured_shapes(robot, parts_within(robot, 1), 1), held_out=0)
    assert "a common zero of all tubes cannot be distinguished from the base's roll" in found.unidentified
    assert (
        "the data determine only the ratios of the tubes' stiffnesses, not a common factor" in found.unidentified
    )
    zeros = found.fit.covariance[np.ix_(*2 * [found.parameters.columns("motor_zero")])]
    assert zeros.sum() / 4 == pytest.approx(0.05**2 / 3 / 2, rel=0.02)
    known = calibrate(robot, measured_shapes(robot, parts_within(robot, 1), 1), held_out=0, registered=True)
    assert found.unidentified[1:] == known.unidentified


def test_known_weights_at_the_tip_determine_the_modulus():
    """Of tubes that are a fifth stiffer than described, and stiffer than each other by some percent, too."""
    described = with_modulus(wide(TWO), 60_000)
    actual = replace(
        described,
        tubes=tuple(
            replace(tube, youngs_modulus=modulus)
            for tube, modulus in zip(described.tubes, (74_000, 70_000), strict=True)
        ),
    )
    found = calibrate(described, weighed(actual, described), registered=True, held_out=0)
    standing = dict(zip(found.parameters.names, found.standing, strict=True))
    assert standing["youngs_modulus"] == "determined"
    moduli = [tube.youngs_modulus for tube in found.robot.tubes]
    np.testing.assert_allclose(moduli, [74_000, 70_000], rtol=0.03)
    root = found.robot.tolerances.covariance_root(found.robot.tubes)
    sigma = np.sqrt(np.diag(root @ root.T)).reshape(2, -1)[:, DEVIATION_NAMES.index("bending_stiffness")]
    assert (sigma < 0.03).all()
    np.testing.assert_array_less(abs(np.array(moduli) / [74_000, 70_000] - 1), 3 * sigma)
    assert (
        "a common factor of the tubes' stiffnesses cannot be distinguished from their modulus"
        in found.unidentified
    )
    assert not any("only ratios" in sentence for sentence in found.unidentified)


def test_a_load_that_is_there_in_every_pose_tells_of_the_modulus_too():
    """A single straight tube that hangs by its weight."""
    rod = Robot((Tube(200, 150, 0.0, 1.5, 1.0),), tolerances=Tolerances(motor_zero=0.01))
    weight, q = Load(densities=21.0, down=(0, 1, 0)), np.array([[0.0, beta, 0.0, 0.0] for beta in (80, 110, 150)])
    model, soft = model_with_load("elastic", weight), with_modulus(rod, 1_000)
    points = model.points(soft, np.array([model.rest(soft, row) for row in q]), np.linspace(0.25, 1, 4))
    seen = observations(q, points, np.linspace(0.25, 1, 4))
    found = calibrate(with_modulus(rod, 1_300), seen, ["youngs_modulus"], model=model, registered=True, held_out=0)
    assert found.robot.tubes[0].youngs_modulus == pytest.approx(1_000, rel=2e-3)


def test_what_forces_need_is_asked_for():
    seen = weighed(with_modulus(TWO, 60_000), with_modulus(TWO, 60_000), 6)
    with pytest.raises(LoadError, match="modul"):
        calibrate(TWO, seen)
    with pytest.raises(OptionError, match="youngs_modulus can be estimated under a load only"):
        calibrate(with_modulus(TWO, 60_000), replace(seen, force=np.zeros(3)), ["youngs_modulus"])
    with pytest.raises(OptionError, match="dominant"):
        calibrate(with_modulus(TWO, 60_000), seen, model="dominant")
    with pytest.raises(LoadError, match="over time"):
        calibrate(
            with_modulus(TWO, 60_000),
            seen,
            model=model_with_load("elastic", LoadOverTime([Load(), Load()], [0, 1])),
        )


def test_lengths_that_never_come_out_are_held_and_named():
    robot = replace(TWO, tolerances=Tolerances(0.1, 0.0, curved_length=(0, 3.0), motor_zero=0.0))
    found = calibrate(robot, measured_shapes(robot, np.zeros((2, 5)), 2), held_out=0, registered=True)
    standing = dict(zip(found.parameters.names, found.standing, strict=True))
    assert standing == {"curvature_1": "determined", "curvature_2": "determined", "curved_length_2": "held"}
    assert found.unidentified == ("the data barely determine curved length of tube 2",)
    assert found.robot.tubes[1].curved_length == 110


def test_the_sensor_may_stand_anywhere_and_elsewhere_in_every_recording():
    parts = parts_within(TWO, 6)
    seen = measured_shapes(TWO, parts, 6)
    recording = np.arange(len(seen)) % 2
    points, poses = seen.points.copy(), []
    for k, vector in enumerate(([0.5, 2.0, -1.0], [-3.0, 0.1, 0.2])):
        turn, place = Rotation.from_rotvec(vector).as_matrix(), np.array([100.0 * k, -30, 700])
        points[recording == k] = points[recording == k] @ turn.T + place
        poses.append((turn, place))
    found = calibrate(TWO, replace(seen, points=points, recording=recording), held_out=0)
    assert max(map(abs, off(found, parts).values())) < 3
    for (turn, place), (there, at) in zip(found.bases, poses, strict=True):
        assert np.linalg.norm(place - at) < 1
        assert Rotation.from_matrix(turn.T @ there).magnitude() < 0.05


def test_outliers_and_missing_values_change_little():
    parts = parts_within(TWO, 7)
    seen = measured_shapes(TWO, parts, 7)
    points = seen.points.copy()
    random = np.random.default_rng(0)
    points[random.uniform(size=points.shape) < 0.3] = np.nan
    points[random.uniform(size=points.shape[:2]) < 0.05] += 30.0
    found = calibrate(TWO, replace(seen, points=points), registered=True, held_out=0)
    assert max(map(abs, off(found, parts).values())) < 4
    assert found.fit.noise.position < 0.8


def test_tips_and_directions_alone_tell_curvatures():
    parts = np.zeros((2, 5))
    parts[:, 0] = 0.06, -0.05
    seen = measured_shapes(TWO, parts, 8, noise=0.0, places=2)
    shapes = measured_shapes(TWO, parts, 8, noise=0.0, places=10000).points[:, [-2, -1]]
    along = np.diff(shapes, axis=1)[:, 0]
    direction = along / np.linalg.norm(along, axis=1, keepdims=True)
    found = calibrate(
        TWO,
        observations(seen.q, tip=shapes[:, 1], direction=direction),
        ["curvature"],
        registered=True,
        held_out=0,
    )
    np.testing.assert_allclose(found.fit.values, parts[:, 0], atol=2e-3)
    assert found.fit.noise.direction < 1e-3


def test_what_was_held_out_was_not_fitted():
    parts = parts_within(TWO, 9)
    seen = measured_shapes(TWO, parts, 9, count=20, places=2)
    copies = replace(seen, points=seen.points + 1e-9, repeated=0)
    both = type(seen)(*(np.concatenate([getattr(s, n) for s in (seen, copies)]) for n in FIELDS))
    found = calibrate(TWO, both, registered=True, held_out=4)
    np.testing.assert_array_equal(found.fold[:20], found.fold[20:])
    assert len(found.repeated_poses) == 20
    assert found.floor == pytest.approx(0, abs=1e-6)
    inside, outside = (summary_of(errors(each))["mean"] for each in (found.fit.residuals, found.held_out))
    assert inside < outside < 1.3 * inside


FIELDS = "q", "tip", "direction", "points", "sigma", "time", "recording"


def test_the_robot_found_has_the_tubes_and_what_is_left_to_doubt():
    parts = parts_within(TWO, 10)
    found = calibrate(TWO, measured_shapes(TWO, parts, 10), registered=True, held_out=0)
    for i, tube in enumerate(found.robot.tubes):
        own = found.parameters.parts(found.fit.values)[i]
        assert tube.tip_curvature == pytest.approx(TWO.tubes[i].tip_curvature * (1 + own[0]))
        assert tube.bending_stiffness == pytest.approx(TWO.tubes[i].bending_stiffness * (1 + own[1]))
    root = found.robot.tolerances.covariance_root(found.robot.tubes)
    sigma = np.sqrt(np.diag(root @ root.T)).reshape(2, 5)
    own = found.fit.sigma[found.parameters.names.index("curvature_2")]
    assert sigma[1, 0] == pytest.approx(own / (1 + found.parameters.parts(found.fit.values)[1, 0]), rel=1e-6)
    np.testing.assert_allclose(sigma[:, 2:4] ** 2, 0, atol=1e-12)
    assert Robot.from_dict(found.robot.to_dict()) == found.robot


def test_priors_of_a_covariance_keep_their_correlations():
    """What is measured again begins where the last calibration ended."""
    parts = parts_within(TWO, 11)
    first = calibrate(TWO, measured_shapes(TWO, parts, 11), registered=True, held_out=0)
    seen = measured_shapes(first.robot, np.zeros((2, 5)), 12, count=2, places=1)
    again = parameters_of(first.robot, seen, registered=True)
    root = first.robot.tolerances.covariance_root(first.robot.tubes)
    assert len(again) == len(first.parameters)
    kinds = [(one.number - 1) * 5 + DEVIATION_NAMES.index(one.kind) for one in again.each]
    np.testing.assert_allclose(again.covariance, (root @ root.T)[np.ix_(kinds, kinds)], rtol=1e-9)
    white = again.whitening_matrix @ again.covariance @ again.whitening_matrix.T
    np.testing.assert_allclose(white, np.eye(len(again)), atol=1e-6)


def test_lag_and_delay_are_found_in_a_motion_of_changing_speed(tmp_path):
    random, time = np.random.default_rng(3), np.arange(0, 40, 0.1)
    q = np.zeros((len(time), 6))
    q[:, 0] = 1.2 * np.sin(0.3 * time + 0.5 * np.sin(0.8 * time))
    q[:, 1] = 1.0 * np.sin(0.9 * time) * np.cos(0.17 * time)
    q[:, 2], q[:, 3] = 30 + 15 * np.sin(0.5 * time), 90 + 15 * np.sin(0.4 * time)
    lag = BacklashAndDrag(np.array([0.0, 0.08]), np.zeros(2), np.zeros(2))
    there = delay_configurations(lag.apply_to_motion(TWO, q, time), time, 0.15)
    tip = shapes_of(TWO, np.zeros((2, 5)), there, np.ones(1))[:, 0]
    seen = observations(q, tip=tip + 0.2 * random.standard_normal(tip.shape), time=time)
    found = calibrate(TWO, seen, ["rotation_lag", "sensor_delay"], registered=True, held_out=0)
    values = dict(zip(found.parameters.names, found.fit.values, strict=True))
    assert values["rotation_lag_2"] == pytest.approx(0.08, abs=0.01)
    assert values["sensor_delay"] == pytest.approx(0.15, abs=0.01)
    assert found.robot.tolerances.rotation_lag[1] == pytest.approx(values["rotation_lag_2"])
    assert found.fit.noise.position == pytest.approx(0.2, rel=0.15)
    top, table = robot_file_comment(found).splitlines(), tmp_path / "lag.toml"
    table.write_text("\n".join(top[top.index("[lag]") :]))
    assert BacklashAndDrag(**read_toml(table)["lag"]).play == pytest.approx(
        [values["rotation_lag_1"], values["rotation_lag_2"]], rel=1e-4
    )


def test_at_one_speed_lag_drag_and_delay_look_alike_and_that_is_said():
    time = np.arange(0, 20, 0.1)
    q = np.zeros((len(time), 6))
    q[:, 1], q[:, 2], q[:, 3] = 0.2 * time - 2, 30.0, 90.0
    tip = shapes_of(TWO, np.zeros((2, 5)), q, np.ones(1))[:, 0]
    tip += 0.2 * np.random.default_rng(4).standard_normal(tip.shape)
    seen = observations(q, tip=tip, time=time)
    found = calibrate(TWO, seen, ["rotation_lag", "drag", "sensor_delay"], registered=True, held_out=0)
    assert any("at one speed their effects look alike" in sentence for sentence in found.unidentified)


def test_the_next_poses_teach_more_than_those_at_random():
    parts = parts_within(TWO, 13)
    seen = measured_shapes(TWO, parts, 13, count=6, places=1)
    found = calibrate(TWO, seen, registered=True, held_out=0, next_count=4)
    assert found.next_q.shape == (4, 6)
    assert (np.diff(found.next_left) < 0).all()
    assert found.next_left[0] < 1
    for q in found.next_q:
        found.robot.check(q)
    model = KINEMATIC_MODELS["elastic"]
    x = np.array([model.rest(found.robot, q) for q in found.next_q])
    assert (model.margins(found.robot, x) > 0.29).all()


def test_the_dominant_model_is_calibrated_too():
    parts = np.zeros((2, 5))
    parts[:, 0], parts[:, 4] = (0.08, -0.04), (0.03, -0.02)
    seen = measured_shapes(TWO, parts, 14, model="dominant")
    found = calibrate(TWO, seen, ["curvature", "motor_zero"], model="dominant", registered=True, held_out=0)
    assert max(map(abs, off(found, parts).values())) < 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimate": ["length"]}, "'length' cannot be estimated; choose from curvature, bending_stiffness"),
        ({"estimate": ["drag"]}, "drag can be estimated from motions only, and the measurements have no time_s"),
        ({"estimate": ["tip_offset"]}, "tip_offset needs measured tips"),
        ({"estimate": [], "registered": True}, "nothing to estimate: the robot has no tolerances"),
        ({"held_out": 1}, "number of folds is 1"),
        ({"next_count": -1}, "number of next poses is -1"),
        ({"model": "rigid"}, "model"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(options, message):
    with pytest.raises(OptionError, match=message):
        calibrate(TWO, measured_shapes(TWO, np.zeros((2, 5)), 0, count=8, places=1), **options)


def test_tubes_that_cannot_be_made_are_told():
    """Tube 2 is at the limit of what nitinol bears inside a stiff tube 1, and is measured to be beyond."""
    stiff = replace(TWO.tubes[0], curvature=0.001, youngs_modulus=100.0)
    robot = replace(TWO, tubes=(stiff, replace(TWO.tubes[1], curvature=0.0585)))
    parts = np.zeros((2, 5))
    parts[1, 0] = 0.08
    with pytest.raises(MeasurementError, match="not possible: tube 2 is strained by 6"):
        calibrate(robot, measured_shapes(robot, parts, 0), ["curvature"], registered=True, held_out=0)
