"""Calibrations of robots that are known: are tubes and zeros found as well as the program says?

The robot of Table I with tubes within +-10 % (curvature, bending stiffness) and zeros within +-0.05 rad, 60 random
poses, 10 points of the shape with 0.5 mm noise in every coordinate, and a sensor that stands anywhere. Told are in
how many trials all parameters that the data determine are within 3 of their own standard deviations, and errors on
60 further poses, beside those of a fit to the same measurements without noise.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

import numpy as np
from identification import measure_random_poses
from scipy.spatial.transform import Rotation

from ctr_nlp import Calibration, Measurements, Robot, Tolerances, calibrate, table_i_robot
from ctr_nlp.identify.calibration.parameters import BASE
from ctr_nlp.identify.calibration.prediction import Prediction, flat_measured
from ctr_nlp.identify.calibration.residuals import errors
from ctr_nlp.models import model_named
from ctr_nlp.robot.samples import RobotSamples, sample_robots
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.typing import Array

POSES, PLACES, NOISE = 60, 10, 0.5
KNOWN = Tolerances(0.1, 0.1, motor_zero=0.05)
ELASTIC = model_named("elastic")
WITHIN = 3.0
APART = 5.0
"""mm: a shape that is further from the true one is that of another equilibrium, which lie apart at a fork."""


def main() -> int:
    """Make the trials and print what comes of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100, help="robots (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the first one (default 0)")
    arguments = parser.parse_args()
    robot = replace(table_i_robot(), tolerances=KNOWN)
    rows = []
    for seed in range(arguments.seed, arguments.seed + arguments.trials):
        rows.append(trial(robot, seed))
        print(f"trial {seed}: " + ", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    found = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    worst = found["largest_deviation"]
    share = (worst < WITHIN).mean()
    print(f"\nall determined parameters within {WITHIN:g} standard deviations: {share:.0%} of trials")
    print(f"of all determined parameters: {1 - found['outside'].sum() / found['determined'].sum():.2%}")
    ratio = found["held_out_mm"] / found["optimum_mm"]
    print(
        f"held-out error over that of the noise-free optimum: mean {ratio.mean():.3f}, largest {ratio.max():.3f}"
    )
    same = found["elsewhere"] == 0
    told = f"mean {ratio[same].mean():.3f}, largest {ratio[same].max():.3f}"
    print(f"the same where all poses are on the robot's branch ({same.sum()} trials): {told}")
    print(f"held-out poses at which the fit is on another branch: {found['elsewhere'].sum():.0f}")
    print(f"held-out distance from the true shape: mean {found['true_mm'].mean():.3f} mm")
    print(f"seconds of a fit: median {np.median(found['seconds']):.2f}")
    return 0


def trial(robot: Robot, seed: int) -> dict[str, float]:
    """One robot measured and calibrated."""
    own = sample_robots(robot, 1, seed)
    random = np.random.default_rng([seed, 7])
    turn, place = Rotation.random(random_state=random).as_matrix(), random.uniform(-200, 200, 3)
    seen, unseen = (_measured(robot, own, turn, place, 2 * seed + k, NOISE) for k in range(2))
    clear, truth = (_measured(robot, own, turn, place, 2 * seed + k, 0.0) for k in range(2))
    begin = time.process_time()
    found = calibrate(robot, seen, held_out=0)
    seconds = time.process_time() - begin
    optimum = calibrate(robot, clear, held_out=0)
    deviations = _deviations(found, own)
    return {
        "largest_deviation": float(abs(deviations).max()),
        "determined": float(len(deviations)),
        "outside": float((abs(deviations) >= WITHIN).sum()),
        "held_out_mm": _error(found, unseen),
        "optimum_mm": _error(optimum, unseen),
        "true_mm": _error(found, truth),
        "elsewhere": float((_errors(found, truth) > APART).sum()),
        "seconds": seconds,
    }


def _measured(robot: Robot, own: RobotSamples, turn: Array, place: Array, seed: int, noise: float) -> Measurements:
    """Shapes of a robot at random poses, in the axes of a sensor."""
    seen = measure_random_poses(robot, own, ELASTIC, np.linspace(1 / PLACES, 1, PLACES), noise, seed, POSES)
    return replace(seen, points=seen.points @ turn.T + place)


def _deviations(found: Calibration, own: RobotSamples) -> Array:
    """By how many of their standard deviations the tubes' determined parameters are off."""
    each = zip(found.parameters.each, found.fit.values, found.fit.sigma, found.standing, strict=True)
    return np.array(
        [
            (value - own.deviations[0, one.number - 1, DEVIATION_NAMES.index(one.kind)]) / sigma
            for one, value, sigma, standing in each
            if one.number is not None and one.kind in DEVIATION_NAMES and standing == "determined"
        ]
    )


def _error(found: Calibration, measured: Measurements) -> float:
    """The root mean square distance between measured and predicted places at other poses, mm."""
    return float(np.sqrt(np.mean(_errors(found, measured) ** 2)))


def _errors(found: Calibration, measured: Measurements) -> Array:
    """That of every pose, (T,) mm."""
    values = np.array(found.fit.values)
    values[found.parameters.columns(*BASE)] = 0.0  # found.bases have them
    predicted = Prediction(found.parameters, measured, ELASTIC, list(found.bases)).predict_values(values).flat()
    return errors(flat_measured(measured) - predicted)


if __name__ == "__main__":
    sys.exit(main())
