"""A calibration to published measurements of a robot of three tubes: errors as described, fitted and held out.

The file is jointTipTrajectory_measured_short.txt of github.com/hjhdog1/ConcentricTubes: time in s, three
rotations in rad, three translations of the tubes' bases in mm, the tip's position in mm and its rotation, a row a
sample. It is not part of this project; give its path. Folds are blocks of 3 s, and what is retraced in the second
half is in the fold of the first.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from ctr_nlp import Limits, Measurements, Robot, Tolerances, Tube, calibrate
from ctr_nlp.calibration.calibration import errors, summary_of

STATIC = "curvature", "bending_stiffness", "torsional_ratio", "curved_length", "motor_zero", "sensor_delay"
LAGS = "rotation_lag", "lag_per_overlap", "drag"
LENGTHS, CURVED, RADII = (150.0, 167.0, 270.3938), (150.0, 150.0, 86.3938), (265.0, 265.0, 55.0)
STIFFNESS = 1.0, 1.0, 2 / 7
"""Of the robot as its authors describe it; lengths and radii in mm, stiffness as a part of the first tube's."""
DIAMETERS = (2.8, 2.4), (2.3, 1.9), (1.8, 1.4)
"""mm; not told, and of no effect beside the stiffness."""


def described() -> Robot:
    """The robot, with what its numbers may be off by."""
    tubes = []
    for length, curved, radius, (outer, inner), stiffness in zip(
        LENGTHS, CURVED, RADII, DIAMETERS, STIFFNESS, strict=True
    ):
        modulus = stiffness / (np.pi / 64 * (outer**4 - inner**4))
        tubes.append(Tube(length, curved, 1 / radius, outer, inner, youngs_modulus=modulus))
    beta = [(0.0, length) for length in LENGTHS]
    return Robot(tuple(tubes), Limits(beta=beta), Tolerances(0.3, 0.3, 0.2, 5.0, 0.2))


def measured(path: Path) -> Measurements:
    """The motion, with tips alone."""
    rows = np.loadtxt(path)
    angles, tips, count = np.unwrap(rows[:, 1:4], axis=0), rows[:, 7:10], len(rows)
    q = np.hstack([angles, np.array(LENGTHS) + rows[:, 4:7], np.zeros((count, 2))])
    unseen, none = np.full((count, 3), np.nan), np.zeros((count, 0))
    return Measurements(q, tips, unseen, np.zeros((count, 0, 3)), none, rows[:, 0], np.zeros(count, dtype=int))


def main() -> int:
    """Calibrate without and with lags, and print what comes of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="jointTipTrajectory_measured_short.txt")
    arguments = parser.parse_args()
    robot, motion = described(), measured(arguments.file)
    for name, kinds in (("static with delay", STATIC), ("with lags", (*STATIC, *LAGS))):
        begin = time.process_time()
        found = calibrate(robot, motion, kinds)
        print(f"\n{name}: {time.process_time() - begin:.0f} s; retraced tips differ by twice {found.floor:.2f} mm")
        for what, residuals in (
            ("as described", found.before),
            ("fitted", found.fit.residuals),
            ("held out", found.held_out),
        ):
            told = summary_of(errors(residuals))
            assert told is not None
            print(f"{what}: mean {told['mean']:.2f}, 95 % {told['q95']:.2f}, largest {told['max']:.2f} mm")
        for k, parameter in enumerate(found.parameters.names):
            value, sigma = found.fit.values[k], found.fit.sigma[k]
            print(f"{parameter:22s} {value: .4f} +- {sigma:.4f}  {found.standing[k]}")
        for sentence in found.untold:
            print(f"- {sentence}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
