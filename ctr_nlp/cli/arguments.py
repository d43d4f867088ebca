"""Options that several programs have, and how their values are read."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from ctr_nlp.cli.output.file import check_file
from ctr_nlp.codegen.cache import COMPILE_VARIABLE
from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array

DEFAULT_SETTINGS = Settings()
ROBOT_HELP = (
    "robot file, or the name of a robot that comes with the package, such as stock_1 (default: the problem's own "
    "robot, and within an anatomy's wall that of the package which fits the path best)"
)
"""Help of the option for the robot."""
CHOICE_JOBS = 2
"""Processes by which robots are compared, unless another number is given."""
FRAME_SETTINGS = ("motion_weight", "jump_width", "seed")
"""Names of add_settings' options that settings_from takes where frames are solved one by one."""


def add_problem_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for robot, number of frames and duration to `parser`."""
    parser.add_argument("--robot", metavar="FILE.toml|NAME", help=ROBOT_HELP)
    add_frames_option(parser)
    add_duration_option(parser)


def add_duration_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the duration of a motion to `parser`."""
    parser.add_argument(
        "--duration", metavar="S", type=float, default=10.0, help="of the motion, in seconds (default 10)"
    )


def add_frames_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the number of frames of a motion to `parser`."""
    parser.add_argument("--frames", metavar="T", type=whole, default=100, help="number of frames (default 100)")


def add_settings(
    parser: argparse.ArgumentParser, motion: str = f"{DEFAULT_SETTINGS.motion_weight:g}", jumps: bool = True
) -> None:
    """Add the options for the numbers of Settings, apart from the wall's, to `parser`.

    motion: what the help says of the default of lambda, the weight of motion. jumps: whether there is an option
    for the width of curvature jumps, which two-stage formulations smooth.
    """
    parser.add_argument(
        "--stability-margin",
        metavar="MU",
        type=_margin,
        default=DEFAULT_SETTINGS.stability_margin,
        help="least margin of every configuration on the elastic model, from 0 (snap) to 1 (no tube acts on "
        f"another); none: any (default {DEFAULT_SETTINGS.stability_margin:g})",
    )
    group = parser.add_argument_group("weights and starts")
    add_numbers(group, ("motion-weight", "S2", f"lambda of the motion term in s^2 (default: {motion})"))
    if jumps:
        what = f"final width of two-stage's smoothed curvature jumps (default {DEFAULT_SETTINGS.jump_width:g})"
        add_numbers(group, ("jump-width", "MM", what))
    group.add_argument("--seed", metavar="N", type=whole, default=0, help="of the random starts (default 0)")


def add_numbers(parser: argparse._ActionsContainer, *options: tuple[str, str, str]) -> None:
    """Add options for numbers, None where not given, to `parser`; options: name, placeholder and help of each."""
    for name, metavar, what in options:
        parser.add_argument(f"--{name}", metavar=metavar, type=float, help=what)


def add_triple(
    parser: argparse._ActionsContainer, name: str, what: str, metavar: tuple[str, ...] = ("X", "Y", "Z")
) -> None:
    """Add an option for three numbers, None where not given, to `parser`.

    name: of the option, without dashes. what: its help. metavar: placeholders of the numbers.
    """
    parser.add_argument(f"--{name}", metavar=metavar, nargs=3, type=float, help=what)


def settings_from(arguments: argparse.Namespace, *names: str) -> Settings:
    """Return Settings with the stability margin and the other options in `names` that were given; raises
    OptionError.

    arguments: parsed options. names: of settings, whose options have the same names.
    """
    given = {name: value for name in names if (value := getattr(arguments, name, None)) is not None}
    return Settings(**given, stability_margin=arguments.stability_margin)


def _margin(text: str) -> float | None:
    """Return the stability margin that `text` stands for, None for `none`."""
    try:
        return None if text == "none" else float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor none") from error


def add_compile_option(parser: argparse.ArgumentParser) -> None:
    """Add --no-compile to `parser`, for this process and those that it starts."""

    class Switch(argparse.Action):
        def __call__(self, *_: Any) -> None:
            # A variable of the environment, which worker processes inherit.
            os.environ[COMPILE_VARIABLE] = "0"

    parser.add_argument(
        "--no-compile",
        action=Switch,
        nargs=0,
        help=f"solve without compiled code, as {COMPILE_VARIABLE}=0 does everywhere",
    )


def add_out_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the option for the output folder to `parser`; a `default` that contains PROBLEM, PLAN or NAME is for
    the help alone, else it is used.
    """
    parser.add_argument(
        "--out",
        metavar="DIR",
        default=None if any(word in default for word in ("PROBLEM", "PLAN", "NAME")) else default,
        help="folder for the results: new, empty, or with those of an earlier run, which are replaced; files of "
        f"yours in it stay (default {default})",
    )


def add_film_option(parser: argparse.ArgumentParser) -> None:
    """Add the option to `parser` for a film of the motion."""
    parser.add_argument(
        "--film",
        metavar="FILE.gif|mp4",
        help="also draw the motion as a film, as long as the motion lasts; an .mp4 needs ffmpeg",
    )


def add_figures_option(parser: argparse.ArgumentParser) -> None:
    """Add --no-figures to `parser`."""
    parser.add_argument(
        "--no-figures",
        action="store_true",
        help="write no pictures; those of an earlier run into the same folder, of another plan, are removed",
    )


def film_file(arguments: argparse.Namespace) -> Path | None:
    """Return the file of add_film_option's option in `arguments`, None without it; raises OptionError,
    OutputError.

    An existing file will be replaced, but no folder or link.
    """
    if arguments.film is None:
        return None
    from ctr_nlp.view.figures.film import check_film  # brings matplotlib, which takes long to load

    check_film(arguments.film)
    check_file(Path(arguments.film), "")
    return Path(arguments.film)


def add_live_option(parser: argparse._ActionsContainer, what: str) -> None:
    """Add --live to `parser`, a window that shows `what` while the program works."""
    parser.add_argument(
        "--live",
        action="store_true",
        help=f"show {what} in a window, which stays when the program has ended; closing it changes nothing else",
    )


def add_entry_option(parser: argparse._ActionsContainer, default: str) -> None:
    """Add the option for the point where the robot enters to `parser`; default: which point is usual, for the
    help.
    """
    add_triple(parser, "entry", f"point where the robot enters, in the file's coordinates (default: {default})")


def whole(text: str) -> int:
    """Return the whole number in `text`; raises argparse's own error."""
    try:
        return int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error


def count(text: str) -> int:
    """Return the whole number, at least 0, in `text`; raises argparse's own error."""
    if (found := whole(text)) < 0:
        raise argparse.ArgumentTypeError(f"{found} is negative; it must be 0 or more")
    return found


def read_start(path: str, robot: Robot) -> Array:
    """Read a configuration (2d + 2,), rad and mm, of a robot from a JSON file; raises OptionError.

    path: of a file with a list of numbers, or with {"alpha": [...], "beta": [...], "theta": [...]}.
    """
    expected = 'JSON, a list of 2d + 2 numbers or {"alpha": [...], "beta": [...], "theta": [...]}, in rad and mm'
    try:
        data: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        if isinstance(data, dict):
            data = [*data["alpha"], *data["beta"], *data["theta"]]
        found = floats(OptionError, "the configuration", data, (None,))
    except (OSError, ValueError, KeyError, TypeError, RecursionError, OptionError) as error:
        raise OptionError(f"configuration {path} cannot be read ({error}); it must be {expected}") from error
    wanted = len(robot.axes)
    if len(found) != wanted:
        raise OptionError(
            f"configuration {path} has {len(found)} numbers; a robot of {robot.d} tubes has {wanted}: "
            f"{', '.join(robot.axes)}"
        )
    return found
