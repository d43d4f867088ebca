"""Calibrations on two published data sets, with errors on observations that the fit did not see.

Neither set is part of this repository: clone github.com/hjhdog1/ConcentricTubes (three tubes, 131 s of motion, an
electromagnetic sensor at the tip) or github.com/comet-lab/CTR_Kinematic_Verification (two and three tubes, single
poses, an optical marker), and give the folder.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ctr_nlp import Calibration, Limits, Measurements, Robot, Tolerances, Tube, calibrate
from ctr_nlp.identify.calibration.residuals import errors, summary_of
from ctr_nlp.typing import Array, Index

KINDS = "curvature", "bending_stiffness", "torsional_ratio", "curved_length", "motor_zero"
LAGS = "rotation_lag", "lag_per_overlap", "drag"
WIDE = Tolerances(0.3, 0.3, torsional_ratio=0.2, curved_length=5.0, motor_zero=0.2)
"""What is known beforehand of tubes that somebody else has made and described."""
MOTION = "jointTipTrajectory_measured_short.txt"
POSES = "data_script_cSharp_api/data_files"
SEEN = "Enabled"
FLEXIBLE = 0.5
"""Poisson's ratio of plastic tubes."""


def main() -> int:
    """Calibrate what is there, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hjhdog1", metavar="DIR", type=Path, help="where ConcentricTubes was cloned to")
    parser.add_argument("--comet-lab", metavar="DIR", type=Path, help="where CTR_Kinematic_Verification was")
    parser.add_argument("--folds", metavar="N", type=int, default=5, help="for errors held out (default 5)")
    arguments = parser.parse_args()
    if not (arguments.hjhdog1 or arguments.comet_lab):
        parser.error("give --hjhdog1 or --comet-lab, or both")
    if arguments.hjhdog1:
        _motion(arguments.hjhdog1, arguments.folds)
    if arguments.comet_lab:
        for tubes in (2, 3):
            measured = poses(arguments.comet_lab / POSES, tubes)
            kinds = (*KINDS, "tip_offset")
            _print(
                f"comet-lab, {tubes} tubes", calibrate(plastic(tubes), measured, kinds, held_out=arguments.folds)
            )
    return 0


def _motion(folder: Path, folds: int) -> None:
    robot, measured = balanced(), motion(folder / MOTION)
    for name, kinds in (("static, delay", ()), ("lag and delay", LAGS)):
        found = calibrate(robot, measured, (*KINDS, "sensor_delay", *kinds), held_out=folds)
        _print(f"hjhdog1, {name}", found)


def _print(name: str, found: Calibration) -> None:
    print(f"\n{name}: {len(found.measured)} observations, {found.measured.recordings} recordings")
    for what, residuals in (
        ("as described, registered", found.nominal_residuals),
        ("fitted", found.fit.residuals),
        ("held out", found.held_out),
    ):
        if (told := summary_of(errors(residuals))) is not None:
            print(f"  {what:26s} mean {told['mean']:.2f}  95 % {told['q95']:.2f}  largest {told['max']:.2f} mm")
    if found.floor is not None:
        print(f"  half the gap between passes over one pose {found.floor:.2f} mm")
    for one, value, sigma, standing in zip(
        found.parameters.each, found.fit.values, found.fit.sigma, found.standing, strict=True
    ):
        if not one.kind.startswith("base_"):
            print(f"  {one.name:20s} {value: .4f} +- {sigma:.4f} {one.unit:7s} {standing}")
    for sentence in found.unidentified:
        print(f"  - {sentence}")


def balanced() -> Robot:
    """The robot of hjhdog1/ConcentricTubes as MechanicsBasedKinematics/CTRFactory.cpp (buildCTR) describes it.

    Stiffnesses 1, 1 and 2 / 7; diameters are not told and do not matter.
    """
    lengths, curved, radii = (150.0, 167.0, 270.3938), (150.0, 150.0, 86.3938), (265.0, 265.0, 55.0)
    diameters, stiffness = ((2.8, 2.4), (2.3, 1.9), (1.8, 1.4)), (1.0, 1.0, 2 / 7)
    tubes = [
        Tube(length, part, 1 / radius, outer, inner, youngs_modulus=EI / (math.pi / 64 * (outer**4 - inner**4)))
        for length, part, radius, (outer, inner), EI in zip(
            lengths, curved, radii, diameters, stiffness, strict=True
        )
    ]
    return Robot(tuple(tubes), Limits(beta=[(0.0, length) for length in lengths]), WIDE)


def motion(path: Path) -> Measurements:
    """Time, rotations, translations of carriages, and the tip's place in the robot's base frame, mm.

    Rotations are written within half a turn; here they count on.
    """
    table = np.loadtxt(path)
    lengths = np.array([tube.length for tube in balanced().tubes])
    q = np.hstack([np.unwrap(table[:, 1:4], axis=0), lengths + table[:, 4:7], np.zeros((len(table), 2))])
    return _tips(q, table[:, 7:10], table[:, 0], np.zeros(len(table), dtype=int))


def plastic(tubes: int) -> Robot:
    """The robot of comet-lab/CTR_Kinematic_Verification as data_script_cSharp_api/fkin_comp.m describes it."""
    described = [
        Tube(140, 50, 0.01364, 3.3, 2.792, FLEXIBLE, 1935.0),
        Tube(220, 50, 0.01273, 2.64, 2.132, FLEXIBLE, 1935.0),
        Tube(300, 50, 0.01665, 1.98, 1.472, FLEXIBLE, 1935.0),
    ][:tubes]
    return Robot(tuple(described), Limits(beta=[(0.0, tube.length) for tube in described]), WIDE)


def poses(folder: Path, tubes: int) -> Measurements:
    """The mean tip of every pose in the axes of the home marker, a recording a file."""
    q, tips, recordings = list[Array](), list[Array](), list[int]()
    for number, path in enumerate(sorted(folder.glob(f"{tubes}Tube_*/2023-*.csv"))):
        for pose, tip in _means(path, tubes):
            q.append(pose)
            tips.append(tip)
            recordings.append(number)
    if not q:
        sys.exit(f"no poses in {folder}/{tubes}Tube_*/2023-*.csv; give the folder of the whole repository")
    return _tips(np.array(q), np.array(tips), np.full(len(q), np.nan), np.array(recordings))


def _means(path: Path, tubes: int) -> list[tuple[Array, Array]]:
    """Of every pose of a file its q and the mean of its tips, over consecutive rows with the same command."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row[7].strip() == row[16].strip() == SEEN]
    found, group = list[tuple[Array, Array]](), list[Array]()
    for k, row in enumerate(rows):
        group.append(_in_home(row))
        if k + 1 == len(rows) or rows[k + 1][1:7] != row[1:7]:
            moved, turned = ([float(cell) for cell in row[start : start + tubes]] for start in (1, 4))
            pose = np.array([*np.radians(turned), *(50 + np.array(moved)), 0.0, 0.0])
            found.append((pose, np.mean(group, axis=0)))
            group = []
    return found


def _in_home(row: Sequence[str]) -> Array:
    """The tip in the axes of the home marker, mm."""
    tip, place = (np.array([float(cell) for cell in row[start : start + 3]]) for start in (8, 17))
    w, x, y, z = (float(cell) for cell in row[20:24])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.asarray((tip - place) @ turn)


def _tips(q: Array, tip: Array, time: Array, recording: Index) -> Measurements:
    count, unseen = len(q), np.full((len(q), 3), np.nan)
    return Measurements(q, tip, unseen, np.zeros((count, 0, 3)), np.zeros((count, 0)), time, recording)


if __name__ == "__main__":
    sys.exit(main())
