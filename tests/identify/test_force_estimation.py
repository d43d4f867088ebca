"""Forces from measured shapes, beside the loads that the shapes were computed under."""

import json

import numpy as np
import pytest
from force_cases import EXACT, NOISE, ROUGH, SIGMA, Q, measured, random_cases, root_mean_square, shape_under, slim

import ctr_nlp as ctr
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, MeasurementError
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.force_estimation import estimate_forces


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


TOLERANCES = pytest.mark.parametrize("tolerances", [EXACT, ROUGH], ids=["known", "2 %"])
SEED = 77
"""Of cases that were not looked at when the estimate was written."""


def test_errors_of_some_cases_are_within_their_deviations():
    for case in random_cases(EXACT, SEED, 3):
        assert abs(np.concatenate([case.tip_scores, case.body_scores])).max() < 4


@pytest.mark.slow
@TOLERANCES
def test_a_hundred_cases_have_honest_deviations(tolerances):
    """Root mean square of errors over deviations of what is reported."""
    cases = random_cases(tolerances, SEED, 100)
    tips = [case.tip_scores for case in cases if "tip" in case.found.kind]
    bodies = [case.body_scores for case in cases if "body" in case.found.kind]
    assert 0.8 <= root_mean_square(tips) <= 1.25
    assert 0.8 <= root_mean_square(bodies) <= 1.25


@pytest.mark.slow
@TOLERANCES
def test_detectable_forces_along_the_body_are_noticed(tolerances):
    noticed = [case.noticed for case in random_cases(tolerances, SEED, 60, detectable=True) if case.detectable]
    assert len(noticed) > 20
    assert np.mean(noticed) >= 0.95


def test_a_least_force_needs_a_direction():
    (found,) = estimate_forces(slim(), measured(shape_under(None)), NOISE)
    with pytest.raises(MeasurementError, match="direction"):
        found.least_body_force(80.0, np.zeros(3))
