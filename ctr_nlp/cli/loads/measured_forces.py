"""Part of `ctr-nlp force`: the forces that measured shapes of a robot show."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED
from ctr_nlp.cli.loads.options import robot_with_modulus
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.terminal_output import busy, console, print_table, report_written_files
from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.calibration.reading import read_measurements
from ctr_nlp.identify.force_estimation import (
    BODY,
    DEFAULT_DIRECTION_NOISE_RAD,
    DEFAULT_NOISE_MM,
    TIP_AND_BODY,
    UNEXPLAINED,
    ForceEstimate,
    estimate_forces,
)
from ctr_nlp.robot.shipped import read_robot
from ctr_nlp.support.tables import write_csv

COLUMNS = "shape", "acts", "at the tip N", "along the body N", "at mm", "least at the tip N"
"""Columns of the table of forces."""


def add_measured_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for measured shapes to `parser`."""
    group = parser.add_argument_group("measured shapes")
    what = (
        "the robot that was measured; its tolerances say how well it is known (`ctr-nlp calibrate` narrows them)"
    )
    group.add_argument("--robot", metavar="ROBOT.toml", help=what)
    what = f"standard deviation of the sensor in each coordinate, mm (default {DEFAULT_NOISE_MM:g})"
    group.add_argument("--noise", metavar="MM", type=float, default=DEFAULT_NOISE_MM, help=what)


def estimate_measured_forces(arguments: argparse.Namespace) -> int:
    """Estimate the forces of measured shapes, write and print them, and return the exit status."""
    if arguments.robot is None:
        raise OptionError(
            f"{arguments.plan} is not a plan (.npz); forces from measured shapes need --robot ROBOT.toml"
        )
    robot = robot_with_modulus(read_robot(arguments.robot), arguments)
    measured = read_measurements(arguments.plan, robot)
    out = Path(arguments.out or "runs/measured-force")
    check_folder(out, "force")
    with busy("forces that explain the measured shapes"):
        found = estimate_forces(robot, measured, arguments.noise, DEFAULT_DIRECTION_NOISE_RAD)
    with output_folder(out, "force") as staging:
        rows = [_as_row(j, each) for j, each in enumerate(found)]
        write_text(staging / "forces.json", json.dumps(rows, indent=2, allow_nan=False) + "\n")
        write_csv(staging / "forces.csv", [_flat(row) for row in rows])
        files = sorted(path.name for path in staging.iterdir())
    print_table(f"forces of {len(found)} shapes", COLUMNS, [_table_row(j, each) for j, each in enumerate(found)])
    for j, each in enumerate(found):
        if each.kind == UNEXPLAINED:
            console().print(f"shape {j + 1}: {each}")
    report_written_files(out, files)
    return EXIT_SOME_FAILED if any(each.kind == UNEXPLAINED for each in found) else EXIT_SOLVED


def _as_row(j: int, found: ForceEstimate) -> dict[str, Any]:
    """Return an estimate as numbers by name, with their units; j: the shape, from 0."""
    acts = np.isfinite(found.place)
    return {
        "shape": j + 1,
        "kind": found.kind,
        "probability_elsewhere": found.weights[BODY] + found.weights[TIP_AND_BODY],
        "tip_N": found.force.tolist(),
        "tip_deviation_N": found.deviations.tolist(),
        "body_N": found.body_force.tolist(),
        "body_deviation_N": found.body_deviations.tolist(),
        "body_at_mm": found.place if acts else None,
        "body_at_deviation_mm": found.place_deviation if acts else None,
        "probability": found.probability,
        "least_tip_N": found.least_tip_force,
    }


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with a column for each axis of a vector, and empty cells for None."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, list):
            stem, unit = name.rsplit("_", 1)
            found |= {f"{stem}_{axis}_{unit}": part for axis, part in zip("xyz", value, strict=True)}
        else:
            found[name] = "" if value is None else value
    return found


def _table_row(j: int, found: ForceEstimate) -> list[str]:
    """Return the row of the printed table of a shape."""
    place = f"{found.place:.0f} ± {found.place_deviation:.0f}" if np.isfinite(found.place) else ""
    return [
        str(j + 1),
        found.kind,
        _vector(found.force, found.deviations) if found.deviations.any() else "",
        _vector(found.body_force, found.body_deviations) if found.body_deviations.any() else "",
        place,
        f"{found.least_tip_force:.3f}",
    ]


def _vector(force: Any, deviations: Any) -> str:
    """Write a force and the largest of its standard deviations, N."""
    return " ".join(f"{part:.3f}" for part in force) + f" ± {max(deviations):.3f}"
