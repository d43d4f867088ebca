"""Forces from measured shapes, beside the loads that the shapes were computed under.

Shapes come from plans under a load: a force along the body acts there between two places, and not on the pieces on
which the estimate looks for it.
"""

import json

import numpy as np
import pytest

import ctr_nlp as ctr
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, MeasurementError
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.force_estimation import estimate_forces
from ctr_nlp.robot.samples import sample_robots

NOISE = 0.3
SIGMA = np.linspace(0.05, 1.0, 20)
EXACT = ctr.Tolerances(curvature=0, bending_stiffness=0, torsional_ratio=0, curved_length=0, motor_zero=0)
ROUGH = ctr.Tolerances(curvature=0.02, bending_stiffness=0.02, torsional_ratio=0, curved_length=0, motor_zero=0.02)


def slim(tolerances=EXACT):
    tubes = [(150, 60, 1 / 100, 2.0, 1.6), (230, 110, 1 / 70, 1.4, 1.1), (320, 150, 1 / 60, 0.9, 0.6)]
    return ctr.Robot(
        tuple(ctr.Tube(*numbers, youngs_modulus=60_000.0) for numbers in tubes), tolerances=tolerances
    )


Q = np.array([0.3, 1.0, 0.6, 30.0, 80.0, 125.0, 0.0, 0.0])


def shape_under(load, robot=None, q=Q):
    """The shape (101, 3) of a robot at q under a load."""
    robot = slim() if robot is None else robot
    line = ctr.curve_from_points([[0.0, 0.0, z] for z in np.linspace(0, q[5], 30)])
    plan = ctr.plan_through(ctr.Problem("straight", robot, ctr.growing(line, 1)), q[None])
    return (plan if load is None else plan.with_load(load)).shape[0]


def measured(shape, seed=0, q=Q, force=(0.0, 0.0, 0.0), noise=NOISE):
    places = np.rint(100 * SIGMA).astype(int)
    points = shape[places] + np.random.default_rng(seed).normal(size=(len(places), 3)) * noise
    none = np.full((1, 3), np.nan)
    return Measurements(
        q[None],
        none,
        none,
        points[None],
        places[None] / 100,
        np.full(1, np.nan),
        np.zeros(1, int),
        force=np.array(force),
    )


def test_a_force_at_the_tip_is_found_within_its_deviations():
    force = np.array([0.1, -0.06, 0.02])
    (found,) = estimate_forces(slim(), measured(shape_under(ctr.Load(force=tuple(force)))), NOISE)
    assert found.kind == "tip"
    assert np.sqrt(np.mean(((found.force - force) / found.deviations) ** 2)) < 2.5
    assert found.weights["tip"] > 0.5
    assert found.deviations.max() < 0.15
    assert 0 < found.least_tip_force < 0.1


def test_a_contact_at_mid_body_is_no_force_at_the_tip():
    push = np.array([0.0, 0.25, 0.0])
    load = ctr.Load(distributed_force=tuple(push / 4), between=(83.0, 87.0))
    (found,) = estimate_forces(slim(), measured(shape_under(load)), NOISE)
    assert found.kind == "body"
    assert (abs(found.force) < 0.02).all()
    assert abs(found.place - 85.0) < 4 * found.place_deviation
    assert abs(found.body_force[1] - 0.25) < 4 * found.body_deviations[1]
    assert "along the body" in str(found)


@pytest.mark.slow
def test_without_a_force_none_is_reported():
    (found,) = estimate_forces(slim(), measured(shape_under(None), seed=3), NOISE)
    assert found.kind == "none"
    assert "no force is detected" in str(found)


def test_a_sensor_that_was_moved_is_not_explained_by_a_force():
    (found,) = estimate_forces(slim(), measured(shape_under(None) + np.array([3.0, 0.0, 0.0])), NOISE)
    assert found.kind == "unexplained"
    assert "not as described" in str(found)


@pytest.mark.slow
def test_a_known_weight_is_taken_off():
    weight = (0.0, 0.08, 0.0)
    (found,) = estimate_forces(slim(), measured(shape_under(ctr.Load(force=weight)), seed=1, force=weight), NOISE)
    assert found.kind == "none"


@pytest.mark.slow
def test_doubt_about_the_tubes_makes_forces_less_certain():
    taken = measured(shape_under(ctr.Load(force=(0.1, 0.0, 0.0))))
    (exact,), (rough,) = (estimate_forces(slim(each), taken, NOISE) for each in (EXACT, ROUGH))
    assert (rough.deviations > exact.deviations).all()
    assert rough.least_tip_force > exact.least_tip_force


@pytest.mark.parametrize("noise", [0.0, -1.0, np.nan, np.inf])
def test_a_noise_that_is_none_is_refused(noise):
    with pytest.raises(MeasurementError, match="noise"):
        estimate_forces(slim(), measured(shape_under(None)), noise)


def test_too_few_values_and_missing_moduli_are_refused():
    few = measured(shape_under(None))
    points = np.full_like(few.points, np.nan)
    points[0, 0, 0] = 1.0
    few = Measurements(Q[None], few.tip, few.direction, points, few.sigma, few.time, few.recording)
    with pytest.raises(MeasurementError, match="1 measured values"):
        estimate_forces(slim(), few)
    with pytest.raises(LoadError, match="modul"):
        estimate_forces(ctr.table_i_robot(), measured(shape_under(None)))


def written(path, shape, seed=0):
    taken = measured(shape, seed)
    names = [f"alpha_{i}" for i in (1, 2, 3)] + [f"beta_{i}" for i in (1, 2, 3)]
    names += [f"p{k}_{axis}" for k in range(1, len(SIGMA) + 1) for axis in ("x", "y", "z", "sigma")]
    values = [*Q[:6], *np.concatenate([taken.points[0], taken.sigma[0][:, None]], axis=1).ravel()]
    path.write_text(",".join(names) + "\n" + ",".join(f"{value:.9g}" for value in values) + "\n")


def test_the_command_writes_the_forces_of_a_table(tmp_path, capsys):
    (tmp_path / "robot.toml").write_text(slim().to_toml())
    written(tmp_path / "measured.csv", shape_under(ctr.Load(force=(0.15, 0.0, 0.0))))
    given = [
        str(tmp_path / "measured.csv"),
        "--robot",
        str(tmp_path / "robot.toml"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["force", *given]) == 0
    (row,) = json.loads((tmp_path / "out" / "forces.json").read_text())
    assert row["kind"] == "tip"
    assert row["tip_N"][0] == pytest.approx(0.15, abs=4 * row["tip_deviation_N"][0])
    assert "tip" in capsys.readouterr().out
    assert (tmp_path / "out" / "forces.csv").read_text().count("\n") == 2


def test_the_command_asks_for_the_robot_that_was_measured(tmp_path, capsys):
    written(tmp_path / "measured.csv", shape_under(None))
    assert main(["force", str(tmp_path / "measured.csv")]) == 2
    assert "--robot" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("tolerances", [EXACT, ROUGH], ids=["known", "2 %"])
def test_a_hundred_cases_have_honest_deviations(tolerances):
    """Root mean square of errors over deviations, and the share of forces elsewhere that are noticed."""
    robot, rng, scores, noticed = slim(tolerances), np.random.default_rng(5), [], []
    samples = sample_robots(robot, 100, 7)
    for case in range(100):
        kind = ("tip", "body", "both")[case % 3]
        tip, push = (rng.normal(size=3) for _ in range(2))
        tip *= (kind != "body") * rng.uniform(0.05, 0.3) / np.linalg.norm(tip)
        push *= (kind != "tip") * rng.uniform(0.05, 0.3) / np.linalg.norm(push)
        place = rng.uniform(40.0, 100.0)
        load = ctr.Load(
            force=tuple(tip),
            **({"distributed_force": tuple(push / 4), "between": (place - 2, place + 2)} if push.any() else {}),
        )
        q = Q.copy()
        q[:3] += rng.uniform(-0.5, 0.5, 3)
        bent = shape_under(load, sampled_robot(robot, samples, case), q + np.pad(samples.offsets[case], (0, 5)))
        if not np.isfinite(bent).all():
            continue
        (found,) = estimate_forces(robot, measured(bent, case, q), NOISE)
        if found.kind in ("tip", "tip and body"):
            scores.extend((found.force - tip) / found.deviations)
        least = np.interp(place, found.places, found.least_body_forces)
        if np.linalg.norm(push) > least:
            noticed.append(found.kind in ("body", "tip and body", "unexplained"))
    assert 0.8 <= np.sqrt(np.mean(np.square(scores))) <= 1.25
    assert np.mean(noticed) >= 0.95


def sampled_robot(robot, samples, k):
    """The robot of a sample, without tolerances."""
    tubes = []
    for tube, off in zip(robot.tubes, samples.deviations[k], strict=True):
        curvature = tuple((1 + off[0]) * each for each in np.atleast_1d(tube.curvature))
        tubes.append(
            ctr.Tube(
                tube.length,
                tube.curved_length,
                curvature if len(curvature) > 1 else curvature[0],
                tube.outer_diameter,
                tube.inner_diameter,
                youngs_modulus=tube.youngs_modulus * (1 + off[1]),
            )
        )
    return ctr.Robot(tuple(tubes), tolerances=EXACT)
