"""`ctr-nlp calibrate`: identify a robot's tubes, motor zeros, backlash and drag from measurements of its shape."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ctr_nlp.cli.arguments import add_figures_option, add_out_option, whole
from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.loads.options import add_load_options, add_modulus_option, model_from_options, robot_with_modulus
from ctr_nlp.cli.measured.calibration_files import (
    as_json,
    error_summaries,
    parameter_rows,
    robot_file_comment,
    write_next,
    write_residuals,
)
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.terminal_output import console, print_table, progress_bar, report_written_files
from ctr_nlp.identify.calibration.calibration import Calibration, calibrate
from ctr_nlp.identify.calibration.consistency import ASSUMED_NOISE_MM, CALIBRATION_FINDINGS
from ctr_nlp.identify.calibration.folds import FOLD_BLOCK_S
from ctr_nlp.identify.calibration.parameters import BASE, PARAMETER_KINDS
from ctr_nlp.identify.calibration.reading import read_measurements
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.robot.shipped import read_robot

FOLDS = 5
CALIBRATION_TABLE_COLUMNS = "parameter", "unit", "before", "+-", "after", "+-", "the data"
STANDING_PHRASES = {
    "determined": "determine it",
    "partly": "determine it in part",
    "held": "hardly determine it: as before",
}
CALIBRATION_ERROR_LABELS = {
    "described": "as described",
    "fitted": "fitted",
    "held_out": "held out",
    "fitted_without_outliers": "fitted, without outliers",
    "held_out_without_outliers": "held out, without outliers",
}


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Find a robot's tubes and its motors' zeros from measured tips, tip poses or points of its "
        "shape; with time, also the lag of its rotations and the delay of the sensor; with known weights at its "
        "tip, also how stiff it is. Write robot.toml, whose tolerances are the covariance of what is left to "
        "doubt (`ctr-nlp plan --robot DIR/robot.toml --robust` plans for it), calibration.json, residuals.csv and "
        "pictures. Parameters that the data cannot identify are reported and keep their values.",
        epilog="Columns: alpha_1.., beta_1.. (theta_x, theta_y), time_s of a motion; force_x, force_y, force_z, "
        "what pulls at the tip, N, in the axes of the base; tip_x, tip_y, tip_z; the "
        "rotation of axes at the tip, z along the robot, as tip_qw, tip_qx, tip_qy, tip_qz; points p1_x, p1_y, "
        "p1_z with p1_sigma or arc length p1_s, p2_x ..; mm, rad and s, or another unit at the end of a name, as "
        "tip_x_m and alpha_1_deg. An empty cell was not measured. Exit status: 0 written, 2 bad input, or "
        "measurements that contradict the robot, nothing written, 130 interrupted, nothing written.",
    )
    what = "what was measured; each file is a recording of its own, with the sensor anywhere"
    parser.add_argument("measured", metavar="MEASURED.csv", nargs="+", help=what)
    what = "the robot as described; its tolerances say how well that is known"
    parser.add_argument("--robot", metavar="ROBOT.toml", required=True, help=what)
    what = (
        f"what to estimate, of {', '.join(PARAMETER_KINDS)} (default: what has a tolerance, under a load the "
        f"modulus, and "
        "of a motion lag and delay)"
    )
    parser.add_argument("--estimate", metavar="NAME", nargs="+", help=what)
    what = "measurements are in the axes of the robot's base; else its pose is estimated, in every recording"
    parser.add_argument("--registered", action="store_true", help=what)
    parser.add_argument("--model", choices=sorted(KINEMATIC_MODELS), default="elastic", help="default: elastic")
    add_load_options(parser, required=False)
    add_modulus_option(parser)
    what = f"folds for errors on what the fit did not see, 0 for none (default {FOLDS})"
    parser.add_argument("--folds", metavar="N", type=whole, default=FOLDS, help=what)
    what = f"seconds of a motion that stay together in a fold (default {FOLD_BLOCK_S:g})"
    parser.add_argument("--block", metavar="S", type=float, default=FOLD_BLOCK_S, help=what)
    parser.add_argument("--next", metavar="N", type=whole, default=0, help="propose N poses that would teach most")
    parser.add_argument("--seed", metavar="N", type=whole, default=0, help="of folds and proposals (default 0)")
    what = f"standard deviation of the sensor in each coordinate, mm (default {ASSUMED_NOISE_MM:g})"
    parser.add_argument("--noise", metavar="MM", type=float, help=what)
    what = (
        "calibrate although this was found: a mistake in the file, a base pose, more left over than noise allows"
    )
    parser.add_argument("--accept", choices=CALIBRATION_FINDINGS, nargs="+", default=[], help=what)
    add_out_option(parser, "runs/calibration")
    add_figures_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    out = Path(arguments.out)
    robot = robot_with_modulus(read_robot(arguments.robot), arguments)
    measured = read_measurements(arguments.measured, robot)
    check_folder(out, "calibration")
    with progress_bar() as labelled:
        found = calibrate(
            robot,
            measured,
            arguments.estimate,
            model=model_from_options(arguments.model, arguments),
            registered=arguments.registered,
            held_out=arguments.folds,
            block=arguments.block,
            next_count=arguments.next,
            seed=arguments.seed,
            progress=labelled("fits"),
            noise=arguments.noise,
            accept=arguments.accept,
        )
    with output_folder(out, "calibration") as staging:
        _write(found, staging, not arguments.no_figures)
        files = sorted(path.name for path in staging.iterdir())
    _print(found)
    report_written_files(out, files)
    return EXIT_SOLVED


def _write(found: Calibration, folder: Path, pictures: bool) -> None:
    (folder / "robot.toml").write_text(found.robot.to_toml(robot_file_comment(found)), encoding="utf-8")
    (folder / "calibration.json").write_text(json.dumps(as_json(found), indent=1) + "\n", encoding="utf-8")
    write_residuals(found, folder / "residuals.csv")
    if len(found.next_q):
        write_next(found, folder / "next.csv")
    if pictures:
        from ctr_nlp.identify.calibration.pictures import save_all  # brings matplotlib, which takes long to load

        save_all(found, folder)


def _print(found: Calibration) -> None:
    """Print the estimated parameters, errors before and after the fit, and remarks on the data."""
    rows = [
        row
        for row in parameter_rows(found)
        if row["name"].rpartition("_")[0] not in BASE and row["name"] not in BASE
    ]
    print_table("what was estimated", CALIBRATION_TABLE_COLUMNS, [_row(row) for row in rows], ("unit", "the data"))
    told = console()
    noise = found.fit.noise
    lines = [
        [CALIBRATION_ERROR_LABELS[name], *of.values()]
        for name, of in error_summaries(found).items()
        if of is not None
    ]
    count = len(found.measured)
    print_table(f"errors of {count} observations, mm", ("robot", "mean", "95 %", "largest"), lines)
    if noise.position == noise.position:
        told.print(f"- a coordinate has a noise of {noise.position:.2g} mm that the robot does not explain")
    if found.measured.repeated:
        count = found.measured.repeated
        were = "is a copy of another, and was" if count == 1 else "are copies of others, and were"
        told.print(f"- of the observations {count} {were} left out")
    if len(found.repeated_poses):
        told.print(f"- {len(found.repeated_poses)} observations have the pose of another; they share its fold")
    if found.floor is not None:
        told.print(
            f"- at the same pose, measurements differ by {2 * found.floor:.2g} mm on average: no model without "
            f"hysteresis can have errors below {found.floor:.2g} mm"
        )
    for sentence in (*found.notes, *found.unidentified):
        told.print(f"- {sentence}")
    if len(found.next_q):
        told.print(
            f"- measuring the {len(found.next_q)} proposed poses leaves {found.next_left[-1]:.0%} of the "
            "uncertainty"
        )


def _row(row: dict[str, Any]) -> list[Any]:
    sizes = [f"{row[name]:.4g}" for name in ("before", "before_sigma", "value", "sigma")]
    return [row["name"], row["unit"], *sizes, STANDING_PHRASES[row["standing"]]]


main = Command("ctr-nlp calibrate", _parser, _run)
