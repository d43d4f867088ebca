"""What robots may be that are not quite known: tolerances, draws, corners, and tubes that follow with play."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import Robot, Tolerances, table_i_robot
from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.samples import RobotSamples, box_vertices_of, sample_robots
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES

WIDE = Tolerances(
    curvature=(0.01, 0.02, 0.03),
    torsional_ratio=0.05,
    curved_length=1.5,
    motor_zero=0.03,
    rotation_lag=(0, 0.1, 0.2),
)


def known_so(tolerances):
    return replace(table_i_robot(), tolerances=tolerances)


def correlated():
    """A covariance in which the curvature of a tube is known by its stiffness, and zeros differ together."""
    rows = np.zeros((15, 15))
    for tube in range(3):
        at = 5 * tube
        rows[at : at + 2, at : at + 2] = [[1e-4, 0.9e-4], [0.9e-4, 1e-4]]
    rows[4::5, 4::5] = 4e-4
    return Tolerances(distribution="normal", covariance=rows)


def test_uniform_draws_fill_their_bands_and_no_more():
    draws = sample_robots(known_so(WIDE), 2000, 5)
    described = known_so(WIDE).numbers
    part = draws.numbers / np.where(described == 0, 1.0, described) - 1
    root, tip = (TUBE_NUMBER_NAMES.index(name) for name in ("root_curvature", "tip_curvature"))
    np.testing.assert_array_equal(part[..., root], part[..., tip])
    for name, bands in (
        ("tip_curvature", (0.01, 0.02, 0.03)),
        ("bending_stiffness", 0.02),
        ("torsional_ratio", 0.05),
    ):
        found = part[..., TUBE_NUMBER_NAMES.index(name)] / bands
        assert (abs(found) <= 1 + 1e-9).all()
        np.testing.assert_allclose(abs(found).max(axis=0), 1, atol=0.02)
        np.testing.assert_allclose(found.std(axis=0), 1 / np.sqrt(3), rtol=0.05)
    grown = (draws.numbers - described)[..., TUBE_NUMBER_NAMES.index("curved_length")]
    assert abs(grown).max() <= 1.5 + 1e-9
    assert (
        draws.numbers[..., TUBE_NUMBER_NAMES.index("length")] == described[:, TUBE_NUMBER_NAMES.index("length")]
    ).all()
    assert abs(draws.offsets).max() <= 0.03
    assert (draws.backlash[:, 0] == 0).all()
    np.testing.assert_allclose(draws.backlash.max(axis=0), (0, 0.1, 0.2), rtol=0.01)


def test_normal_draws_have_the_variance_of_uniform_ones():
    parts = sample_robots(known_so(replace(WIDE, distribution="normal")), 4000, 5).deviations
    np.testing.assert_allclose(parts.std(axis=0), WIDE.bands(table_i_robot().tubes) / np.sqrt(3), rtol=0.05)
    assert (abs(parts) > 1.5 * WIDE.bands(table_i_robot().tubes)).any()


def test_draws_have_the_covariance_that_is_given():
    robot = known_so(correlated())
    found = np.cov(sample_robots(robot, 20_000, 1).deviations.reshape(20_000, 15).T)
    np.testing.assert_allclose(found, robot.tolerances.covariance, atol=1.5e-5)
    np.testing.assert_allclose(robot.tolerances.bands(robot.tubes)[:, 0], 0.01 * np.sqrt(3))


def test_what_a_covariance_leaves_no_doubt_of_does_not_differ_by_rounding():
    covariance = np.zeros((15, 15))
    among = np.array([0, 5, 10, 14])
    spread = np.random.default_rng(0).standard_normal((4, 4))
    covariance[np.ix_(among, among)] = 1e-4 * spread @ spread.T
    robot = replace(table_i_robot(), tolerances=Tolerances(distribution="normal", covariance=covariance))
    root = robot.tolerances.covariance_root(robot.tubes)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-12)
    others = np.setdiff1d(np.arange(15), among)
    assert (root[others] == 0).all()
    assert (sample_robots(robot, 10, 1).deviations.reshape(10, 15)[:, others] == 0).all()


def test_draws_are_those_of_their_seed_and_fewer_are_the_first_of_more():
    for tolerances in (WIDE, replace(WIDE, distribution="normal"), correlated()):
        robot = known_so(tolerances)
        assert sample_robots(robot, 40, 3) == sample_robots(robot, 40, 3)
        assert sample_robots(robot, 40, 3)[:10] == sample_robots(robot, 10, 3)
        assert sample_robots(robot, 10, 4) != sample_robots(robot, 10, 3)


def test_diameters_that_are_off_widen_the_bending_stiffness():
    """Each draw's stiffness is that of a section with diameters off, by hand at the ends; bands to first order."""
    thin = replace(table_i_robot().tubes[2], outer_diameter=1.3, inner_diameter=1.0)
    robot = replace(table_i_robot(), tubes=(*table_i_robot().tubes[:2], thin))
    robot = replace(robot, tolerances=Tolerances(bending_stiffness=0.0, diameter=(0, 0, 0.02)))
    part = sample_robots(robot, 4000, 5).deviations[..., 1]
    assert (part[:, :2] == 0).all()
    most = (1.32**4 - 0.98**4) / (1.3**4 - 1) - 1
    least = (1.28**4 - 1.02**4) / (1.3**4 - 1) - 1
    assert least < part[:, 2].min() < 0.9 * least
    assert 0.9 * most < part[:, 2].max() < most
    band = robot.tolerances.bands(robot.tubes)[2, 1]
    np.testing.assert_allclose(part[:, 2].std(), band / np.sqrt(3), rtol=0.03)
    np.testing.assert_allclose(band, 0.02 * 4 * np.hypot(1.3**3, 1) / (1.3**4 - 1), rtol=1e-12)
    normal = replace(robot, tolerances=replace(robot.tolerances, distribution="normal"))
    np.testing.assert_allclose(
        sample_robots(normal, 4000, 5).deviations[:, 2, 1].std(), band / np.sqrt(3), rtol=0.03
    )
    with pytest.raises(
        RobotError, match=r"diameter of tolerances is 0\.16 mm; .* less than the wall of tube 3, 0\.15 mm"
    ):
        replace(robot, tolerances=Tolerances(diameter=(0, 0, 0.16)))
    with pytest.raises(RobotError, match=r"diameter of tolerances is 0\.02; leave it out where a covariance"):
        replace(correlated(), diameter=0.02)


def test_corners_are_all_ends_of_all_bands():
    robot = known_so(Tolerances(bending_stiffness=(0.02, 0, 0), motor_zero=(0, 0.02, 0), rotation_lag=0.1))
    found = box_vertices_of(robot)
    assert len(found) == 2**5
    assert len(np.unique(found.deviations.reshape(32, 15), axis=0)) == 32
    bands = robot.tolerances.bands(robot.tubes)
    np.testing.assert_allclose(abs(found.deviations), np.tile(bands, (32, 1, 1)), rtol=1e-12)
    assert (found.backlash == 0.1).all()
    some = box_vertices_of(robot, 20)
    assert len(some) == 20
    np.testing.assert_allclose(abs(some.deviations), np.tile(bands, (20, 1, 1)), rtol=1e-12)


def test_corners_of_a_covariance_are_as_far_off_along_its_axes():
    robot = known_so(correlated())
    parts = box_vertices_of(robot).deviations.reshape(-1, 15)
    np.testing.assert_allclose(parts.T @ parts / len(parts), 3 * np.array(correlated().covariance), atol=1e-12)


def test_tolerances_change_nothing_that_is_compiled_or_planned_with():
    robot = known_so(WIDE)
    assert robot.structure == table_i_robot().structure
    np.testing.assert_array_equal(robot.numbers, table_i_robot().numbers)
    assert sample_robots(robot, 5, 0).structure.transmission_emerges == (True, True, True)
    assert sample_robots(table_i_robot(), 5, 0).structure == robot.structure


def test_a_tube_follows_its_motor_with_play():
    """By hand: with a lag of 0.3 the tube stays until the motor is 0.3 ahead, and again where that turns back."""
    motor = np.array([0.2, 0.5, 1.0, 0.9, 0.5, 0.3, 1.0])
    q = np.zeros((7, 4))
    q[:, 0] = motor
    still, offsets = np.zeros((1, 1)), np.full((1, 1), 0.05)
    none = np.zeros((1, 3)), np.zeros((1, 1, 5))
    draws = RobotSamples(table_i_robot().structure, np.zeros((1, 1, 6)), offsets, still + 0.3, *none)
    fresh = np.zeros(7, dtype=bool)
    fresh[0] = True
    found = draws.tube_configurations(q, fresh)
    np.testing.assert_allclose(found[0, :, 0] - 0.05, [0.2, 0.2, 0.7, 0.7, 0.7, 0.6, 0.7])
    np.testing.assert_array_equal(found[..., 1:], q[None, :, 1:])
    fresh[4] = True
    np.testing.assert_allclose(
        draws.tube_configurations(q, fresh)[0, :, 0] - 0.05, [0.2, 0.2, 0.7, 0.7, 0.5, 0.5, 0.7]
    )


def test_tubes_come_from_where_they_are_aligned_with_the_innermost():
    q = np.zeros((2, 6))
    q[:, :2] = (1.0, 0.4), (1.5, 0.4)
    of_tubes = np.zeros((1, 2, 6)), np.zeros((1, 2)), np.full((1, 2), 0.2)
    draws = RobotSamples(table_i_robot().structure, *of_tubes, np.zeros((1, 3)), np.zeros((1, 2, 5)))
    np.testing.assert_allclose(draws.tube_configurations(q, np.array([True, False]))[0, :, 0], [0.8, 1.3])


@pytest.mark.parametrize("tolerances", [Tolerances(), WIDE, correlated()], ids=["default", "wide", "correlated"])
def test_tolerances_survive_files_and_pickle(tolerances):
    robot = known_so(tolerances)
    for again in (Robot.from_dict(json.loads(json.dumps(robot.to_dict()))), pickle.loads(pickle.dumps(robot))):
        assert again == robot
        assert again.tolerances == tolerances
    assert robot == table_i_robot() if tolerances == Tolerances() else robot != table_i_robot()


def test_a_robot_file_without_tolerances_has_the_usual_ones():
    old = table_i_robot().to_dict()
    del old["tolerances"]
    assert Robot.from_dict(old).tolerances == Tolerances(0.02, 0.02, 0, 0, 0.02, 0)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("curvatures = 0.02", "key 'curvatures' is unknown in tolerances; allowed are curvature, "),
        ("curvature = -0.1", r"curvature of tolerances is -0.1; it must lie in \[0, 0.5\]"),
        (
            "curvature = [0.02, 0.02]",
            "curvature of tolerances has 2 numbers; it must be one, or one for each of 3",
        ),
        ("curvature = 'small'", "curvature of tolerances is 'small'; it must be a number"),
        ("motor_zero = 2", r"motor_zero of tolerances is 2 rad; it must lie in \[0, 1.571\] rad"),
        ("motor_zero = nan", "motor_zero of tolerances is nan"),
        ("distribution = 'gauss'", "distribution of tolerances is 'gauss'; it must be uniform or normal"),
        ("covariance = [[1]]", "covariance of tolerances is of shape .* square of 5 rows a tube: curvature"),
        ("covariance = 3", "covariance of tolerances is of shape"),
        ("covariance = 'x'", "covariance of tolerances is of 'x'"),
    ],
)
def test_malformed_tolerances_are_refused_in_a_line(tmp_path, line, complaint):
    path = tmp_path / "robot.toml"
    tubes = "[[tubes]]\nlength=90\ncurved_length=50\ncurvature=0.01\nouter_diameter={}\ninner_diameter={}\n"
    path.write_text("".join(tubes.format(9 - k, 8.2 - k) for k in range(3)) + f"[tolerances]\n{line}\n")
    with pytest.raises(RobotError, match=complaint) as caught:
        Robot.from_toml(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"distribution": "uniform"}, 'needs distribution = "normal"'),
        ({"curvature": 0.05}, "leave it out where a covariance is given"),
        ({"covariance": np.eye(5)}, "has 5 rows; it must have 15"),
        ({"covariance": np.eye(15) + np.eye(15, k=1)}, "not symmetric"),
        ({"covariance": np.eye(15) + 2 * (np.eye(15, k=1) + np.eye(15, k=-1))}, "has an eigenvalue -"),
        ({"covariance": np.full((15, 15), np.nan)}, "not finite"),
    ],
)
def test_a_covariance_that_is_none_is_refused(change, complaint):
    with pytest.raises(RobotError, match=complaint):
        known_so(replace(correlated(), **change))
