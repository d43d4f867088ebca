"""Configurations in another order or unit: refused with the reading that would fit, and good ones never."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.view.exchange.configuration_checks import check_configurations

ROBOT = table_i_robot()
LENGTHS = np.array([tube.length for tube in ROBOT.tubes])
FRAMES, DURATION = 20, 20.0


@pytest.fixture(scope="module")
def problem():
    curve = curve_from_formula(lambda u: (0.001 * u**2, 0.0, u), 0.0, 100.0)
    return Problem("parabola", ROBOT, growing(curve, FRAMES), duration=DURATION)


def motion(rng, problem):
    """Good configurations (T, 8): smooth, within all limits, as long as the target."""
    u = np.linspace(0, 1, FRAMES)[:, None]
    first, change = rng.uniform(-3, 3, 3), rng.uniform(0.5, 3, 3) * rng.choice([-1, 1], 3)
    inner = np.asarray(problem.target.lengths)[:, None]
    parts = np.sort(rng.uniform(0.1, 0.45, 2))
    beta = np.hstack([parts[:1] * inner, parts[1:] * inner, inner])
    theta = rng.uniform(0.05, 0.3, 2) * u
    return np.hstack([first + change * u, beta, theta])


def exchanged(q):
    return q[:, [3, 4, 5, 0, 1, 2, 6, 7]]


CORRUPTIONS = {
    "alpha and beta were exchanged": exchanged,
    "lengths were in metres": lambda q: q * [1, 1, 1, 1e-3, 1e-3, 1e-3, 1, 1],
    "lengths were in cm": lambda q: q * [1, 1, 1, 0.1, 0.1, 0.1, 1, 1],
    "lengths were in µm": lambda q: q * [1, 1, 1, 1e3, 1e3, 1e3, 1, 1],
    "beta had the other sign": lambda q: q * [1, 1, 1, -1, -1, -1, 1, 1],
    "position of each tube's base": lambda q: q - [0, 0, 0, *LENGTHS, 0, 0],
    "from the innermost one": lambda q: q[:, [2, 1, 0, 5, 4, 3, 6, 7]],
    "tube by tube, alpha_1": lambda q: q[:, [0, 3, 1, 4, 2, 5, 6, 7]],
    "theta stood first": lambda q: q[:, [6, 7, 0, 1, 2, 3, 4, 5]],
    "angles were in degrees": lambda q: (
        q * np.r_[np.full(3, 180 / math.pi), 1, 1, 1, 180 / math.pi, 180 / math.pi]
    ),
}


@pytest.mark.parametrize("seed", range(25))
def test_good_motions_are_taken(seed, problem):
    check_configurations(motion(np.random.default_rng(seed), problem), problem)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("cause", CORRUPTIONS)
def test_another_order_or_unit_is_refused_with_the_reading_that_fits(cause, seed, problem):
    q = CORRUPTIONS[cause](motion(np.random.default_rng(seed), problem))
    with pytest.raises(OptionError, match="would fit if") as refused:
        check_configurations(q, problem)
    assert cause in str(refused.value)


@pytest.mark.parametrize("seed", range(40))
def test_two_mistakes_at_once_are_not_taken_in_silence(seed, problem):
    rng = np.random.default_rng(seed)
    first, second = rng.choice(list(CORRUPTIONS), 2, replace=False)
    good = motion(rng, problem)
    q = CORRUPTIONS[second](CORRUPTIONS[first](good))
    if np.allclose(q, good):  # metres and micrometres cancel
        return
    with pytest.raises(OptionError):
        check_configurations(q, problem)


def test_small_angles_in_degrees_are_within_what_a_robot_does(problem):
    """Nothing tells one degree from one rad, so that neither is refused."""
    q = motion(np.random.default_rng(0), problem)
    q[:, :3] = np.linspace(0, 5, FRAMES)[:, None]
    q[:, 6:] = 0
    check_configurations(q, problem)


def test_a_motion_that_is_too_fast_or_too_short_is_left_to_the_verdicts(problem):
    q = motion(np.random.default_rng(1), problem)
    fast, short = q.copy(), q.copy()
    fast[:, 0] = 12 * np.sin(np.arange(FRAMES))
    short[:, 3:6] = np.array([20.0, 30.0, 40.0])
    for each in (fast, short):
        check_configurations(each, problem)


def test_alpha_beyond_ten_turns_is_named(problem):
    q = motion(np.random.default_rng(2), problem)
    q[4, 1] = 70.0
    with pytest.raises(
        OptionError, match=r"alpha_2 in frame 5 is 70 rad; it must lie in \[-62.83, 62.83\] rad, ten"
    ):
        check_configurations(q, problem)


def write(path: Path, q: np.ndarray) -> Path:
    if path.suffix == ".mat":
        savemat(path, {"q": q})
        return path
    kinds = ("alpha_{}_rad", "beta_{}_mm")
    header = [*(kind.format(i) for kind in kinds for i in (1, 2, 3)), "theta_x_rad", "theta_y_rad"]
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header, *q.tolist()])
    return path


@pytest.mark.parametrize("suffix", [".mat", ".csv"])
@pytest.mark.parametrize("cause", ["alpha and beta were exchanged", "angles were in degrees"])
def test_import_writes_nothing_where_another_reading_fits(cause, suffix, problem, tmp_path, capsys):
    q = CORRUPTIONS[cause](motion(np.random.default_rng(3), problem))
    out = tmp_path / "out"
    call = [str(write(tmp_path / f"q{suffix}", q)), "--problem", "arc", "--duration", "20", "--out", str(out)]
    assert main(["import", *call]) == 2
    assert cause in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_degrees_of_a_shared_case_are_refused(shared_data, tmp_path, capsys):
    out = tmp_path / "out"
    robot = str(shared_data / "cases/robots/gym2_wide.toml")
    call = [str(shared_data / "cases/q_degrees.mat"), "--problem", str(shared_data / "cases/ok_curve.mrk.json")]
    for options in ([], ["--robot", robot]):
        assert main(["import", *call, *options, "--out", str(out)]) == 2
        message = " ".join(capsys.readouterr().err.split())
        assert "must lie in [-62.83, 62.83] rad, ten turns" in message
        assert "would fit if angles were in degrees" in message
        assert not out.exists()
    assert Robot.from_toml(robot).d == 3
