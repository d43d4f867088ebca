"""`ctr-nlp export`: write a plan as commands that other machines play, or as shapes for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.cli.console import EXIT_SOLVED, Command
from ctr_nlp.cli.exchange.shapes import write_shapes
from ctr_nlp.cli.output.file import check_file, write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.play_report import print_trajectory
from ctr_nlp.cli.terminal_output import report_written_files
from ctr_nlp.exceptions import OptionError, escape_control_characters
from ctr_nlp.hardware.description import Hardware, simulated_hardware
from ctr_nlp.hardware.exports import BAG, MACHINE_FORMATS, MACHINE_TEXT_FORMATS
from ctr_nlp.hardware.exports.rosbag2 import STORAGES, write_bag
from ctr_nlp.hardware.motion.gcode import GCODE_FEEDS, INVERSE_TIME
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.session import prepare_trajectory
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.view.exchange import formats
from ctr_nlp.view.exchange.formats import SLICER_FORMAT
from ctr_nlp.view.exchange.slicer import SLICER_SPACES


def _parser(prog: str) -> argparse.ArgumentParser:
    every = (*MACHINE_FORMATS, *formats.EXCHANGE_FORMATS)
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Check a plan for some hardware, time it, and write it as commands that other machines play: "
        "csv, a table; gcode, for Grbl and grblHAL, without the tilt; urscript, for the arm that tilts; rosbag2, "
        "a folder with a joint trajectory and joint states. Or write its shapes for other programs: slicer, a "
        "folder for 3D Slicer, in the coordinates of the scan; gltf, an animated scene for viewers, .glb; mat, a "
        "file of MATLAB, version 7, which explains itself; shapes-csv, a table of the points in every frame.",
        epilog="Exit status: 0 where the file or folder was written, 2 where input is bad and nothing is written.",
    )
    parser.add_argument("plan", metavar="PLAN.npz")
    parser.add_argument("--to", choices=every, required=True, metavar="FORMAT", help=", ".join(every))
    parser.add_argument("--hardware", metavar="FILE.toml", help="what commands are for (default: a bench rig)")
    parser.add_argument(
        "--tempo", metavar="X", type=float, help="of commands: part of the plan's own pace, in (0, 1] (default 1)"
    )
    parser.add_argument(
        "--feed",
        choices=GCODE_FEEDS,
        help=f"with --to gcode, what F means (default {INVERSE_TIME}, G93, which Grbl and LinuxCNC know): "
        "per-minute, G94 along all axes, with degrees counted like mm, as Grbl does; per-minute-linear, G94 along "
        "the axes in mm alone, as LinuxCNC and Marlin do",
    )
    parser.add_argument(
        "--storage",
        choices=STORAGES,
        help=f"of a bag (default {STORAGES[0]}; Humble reads sqlite3 without a plugin)",
    )
    parser.add_argument(
        "--space",
        choices=SLICER_SPACES,
        help=f"with --to {SLICER_FORMAT}, for a plan whose path comes from a file that does not state its "
        "patient coordinates: those of that file",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        help="(default: beside the plan, under its name). A file or folder of ours is replaced, no other",
    )
    return parser


def _run(arguments: argparse.Namespace) -> int:
    to = arguments.to
    source = Path(arguments.plan)
    _check_format_options(arguments)
    if to in formats.EXCHANGE_FORMATS:
        write_shapes(source, to, None if arguments.out is None else Path(arguments.out), arguments.space)
        return EXIT_SOLVED
    beside = (
        source.with_name(f"{source.stem}_bag")
        if to == BAG
        else source.with_suffix(MACHINE_TEXT_FORMATS[to].suffix)
    )
    out = Path(arguments.out or beside)
    _check_out(out, to)
    plan = Plan.load(source)
    title = escape_control_characters(plan.meta["problem"]["name"])
    hardware = Hardware.from_toml(arguments.hardware) if arguments.hardware else simulated_hardware(plan.robot)
    with deferred_interrupt() as interrupted:
        trajectory, found = prepare_trajectory(plan, hardware, 1.0 if arguments.tempo is None else arguments.tempo)
        if interrupted():
            raise KeyboardInterrupt
    if to == BAG:
        _write_bag(trajectory, title, out, arguments.storage or STORAGES[0])
    else:
        options = {"feed": arguments.feed} if arguments.feed else {}
        write_text(out, MACHINE_TEXT_FORMATS[to].of(trajectory, title, **options))
    print_trajectory(f"{title} for {len(trajectory.hardware.axes)} axes", trajectory, found)
    report_written_files(out)
    return EXIT_SOLVED


def _check_format_options(arguments: argparse.Namespace) -> None:
    """Raise OptionError for an option that does not go with the format."""
    to = arguments.to
    if arguments.storage and to != BAG:
        raise OptionError(f"--storage goes with --to {BAG}; a {to} file has none")
    if arguments.feed and to != "gcode":
        raise OptionError(f"--feed goes with --to gcode; a {to} file has no feeds")
    if arguments.space and to != SLICER_FORMAT:
        raise OptionError(f"--space goes with --to {SLICER_FORMAT}; a {to} file is in the robot's base frame")
    for option in ("hardware", "tempo"):
        if to in formats.EXCHANGE_FORMATS and getattr(arguments, option) is not None:
            raise OptionError(
                f"--{option} goes with commands of machines ({', '.join(MACHINE_FORMATS)}); --to {to} writes "
                f"shapes"
            )


def _check_out(out: Path, to: str) -> None:
    if to != BAG:
        check_file(out, MACHINE_TEXT_FORMATS[to].opening)
    elif out.suffix in (".mcap", ".db3"):
        raise OptionError(f"--out is {out}, but a bag is a folder: {out.with_suffix('')} will hold such a file")
    else:
        check_folder(out, "bag")


def _write_bag(trajectory: Trajectory, title: str, out: Path, storage: str) -> None:
    with output_folder(out, "bag") as staging:
        made = staging / out.absolute().name  # the bag's file takes its name from the folder that it is made in
        write_bag(trajectory, title, made, storage)
        for file in made.iterdir():
            file.rename(staging / file.name)
        made.rmdir()


main = Command("ctr-nlp export", _parser, _run)
