"""Arguments that several programs take, and how their values are read."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctr_nlp.anatomy.files import CENTRELINES, MASKS
from ctr_nlp.cli.output.file import check_file
from ctr_nlp.codegen.cache import SWITCH
from ctr_nlp.exceptions import OptionError
from ctr_nlp.figures.film import check_film
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.models import MODELS
from ctr_nlp.support.values import floats
from ctr_nlp.target.fit import check_radii
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

FILE_OPTIONS = ("branch", "entry", "target", "insertion", "tilt", "reverse", "smoothing", "trim")
"""What add_file_options adds."""


def add_problem_options(parser: argparse.ArgumentParser) -> None:
    """Robot, number of frames and duration."""
    parser.add_argument("--robot", metavar="FILE.toml", help="robot file (default: the problem's own robot)")
    parser.add_argument("--frames", metavar="T", type=whole, default=100, help="number of frames (default 100)")
    parser.add_argument(
        "--duration", metavar="S", type=float, default=10.0, help="of the motion, in seconds (default 10)"
    )


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """The model to plan on, and the one that errors are taken on."""
    parser.add_argument("--model", choices=MODELS, default="dominant", help="(default dominant)")
    parser.add_argument(
        "--evaluate",
        choices=MODELS,
        help="model on which the plan's shapes are found (default: the one planned on)",
    )


def add_stability_option(parser: argparse.ArgumentParser) -> None:
    """How stable configurations of the elastic model must be."""
    margin = Settings().stability_margin
    parser.add_argument(
        "--stability-margin",
        metavar="MU",
        type=_margin,
        default=margin,
        help="least margin of every configuration on the elastic model, from 0 (snap) to 1 (no tube acts on "
        f"another); none: any (default {margin:g})",
    )


def add_wall_options(parser: argparse.ArgumentParser) -> None:
    """How the lumen's wall counts; None where not given."""
    defaults = Settings()
    group = parser.add_argument_group("the lumen's wall, where radii are known")
    group.add_argument(
        "--clearance",
        metavar="MM",
        type=float,
        help=f"to keep between tubes and wall (default {defaults.clearance:g})",
    )
    group.add_argument(
        "--contact-weight",
        metavar="MM",
        type=float,
        help="what a mm less of it costs in a frame, beside the mean square error in mm^2; 0: the wall does not "
        f"count (default {defaults.contact_weight:g})",
    )
    group.add_argument(
        "--clearance-cost",
        metavar="PART",
        type=float,
        help="by what part of itself the error e3 may grow for clearance; where it would grow by more, contact "
        f"costs less; inf: contact always costs its full weight (default {defaults.clearance_cost:g})",
    )
    group.add_argument(
        "--contact-allowed",
        metavar="MM",
        type=float,
        help="how far any place of the robot may be beyond the wall before the plan is not within it "
        f"(default {defaults.contact_allowed:g}: tissue gives a little)",
    )


def walled(settings: Settings, arguments: argparse.Namespace, problem: Problem) -> Settings:
    """Settings with what add_wall_options' arguments say; raises OptionError, and ProblemError without a wall."""
    names = "clearance", "contact_weight", "clearance_cost", "contact_allowed"
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    if any(given.values()):
        check_radii(problem)
    return replace(settings, **given)


def _margin(text: str) -> float | None:
    try:
        return None if text == "none" else float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor none") from error


def add_compile_option(parser: argparse.ArgumentParser) -> None:
    """--no-compile, which holds for this process and those that it starts."""

    class Switch(argparse.Action):
        def __call__(self, *_: Any) -> None:
            os.environ[SWITCH] = "0"

    parser.add_argument(
        "--no-compile", action=Switch, nargs=0, help=f"solve without compiled code, as {SWITCH}=0 does everywhere"
    )


def add_out_option(parser: argparse.ArgumentParser, default: str) -> None:
    """The output folder, None where not given; default: what the help says of it."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for the results: new, empty, or with those of an earlier run, which are replaced; files of "
        f"yours in it stay (default {default})",
    )


def add_film_option(parser: argparse.ArgumentParser) -> None:
    """Whether the motion is also drawn as a film."""
    parser.add_argument(
        "--film",
        metavar="FILE.gif|mp4",
        help="also draw the motion as a film, as long as the motion lasts; an .mp4 needs ffmpeg",
    )


def film_file(arguments: argparse.Namespace) -> Path | None:
    """Where add_film_option's argument wants a film, None for nowhere; raises OptionError, OutputError.

    A file that is there already will be replaced, but no folder or link.
    """
    if arguments.film is None:
        return None
    check_film(arguments.film)
    check_file(Path(arguments.film), "")
    return Path(arguments.film)


def add_live_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Whether a window shows something while the program works."""
    parser.add_argument(
        "--live",
        action="store_true",
        help=f"show {what} in a window, which stays when the program has ended; closing it changes nothing else",
    )


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """What is done to a path from a file before it is followed: FILE_OPTIONS, None where not given."""
    kinds = f"a centreline ({', '.join(CENTRELINES)}) or a mask of the lumen ({', '.join(MASKS)})"
    group = parser.add_argument_group(
        f"where PROBLEM is {kinds}", "Points and directions are in the file's own coordinates, in mm."
    )
    group.add_argument("--branch", metavar="NAME|NUMBER", help="which branch of several; see list_branches.py")
    for option, what in (
        ("entry", "point where the robot enters (default: the branch's first)"),
        ("target", "point where it is to arrive (default: the branch's last); a mask needs both"),
        ("insertion", "direction in which it is inserted (default: that of the path's first 10 mm)"),
    ):
        group.add_argument(f"--{option}", metavar=("X", "Y", "Z"), nargs=3, type=float, help=what)
    group.add_argument(
        "--tilt",
        metavar="DEG",
        type=float,
        help="how far the base may tilt about each axis (default: the robot's)",
    )
    group.add_argument(
        "--reverse", action="store_true", default=None, help="the file's lines run from the tip to the root"
    )
    group.add_argument(
        "--smoothing",
        metavar="MM",
        type=float,
        help="how far the followed curve may keep from the path, never more than half of the lumen's radius "
        "(default 0: through all points)",
    )
    group.add_argument(
        "--trim", choices=("start", "end"), help="which end to drop where it is longer than the robot reaches"
    )


def add_settings(parser: argparse.ArgumentParser) -> None:
    """The numbers of Settings."""
    defaults = Settings()
    add_stability_option(parser)
    group = parser.add_argument_group("weights and widths")
    group.add_argument(
        "--motion-weight",
        metavar="S2",
        type=float,
        default=defaults.motion_weight,
        help=f"lambda of the motion term in s^2 (default {defaults.motion_weight:g})",
    )
    group.add_argument(
        "--jump-width",
        metavar="MM",
        type=float,
        default=defaults.jump_width,
        help=f"final width of two-stage's smoothed curvature jumps (default {defaults.jump_width:g})",
    )
    group.add_argument(
        "--seed", metavar="N", type=whole, default=defaults.seed, help="of the random starts (default 0)"
    )


def settings_from(arguments: argparse.Namespace) -> Settings:
    """The Settings that add_settings' arguments stand for; raises OptionError."""
    return Settings(arguments.motion_weight, arguments.jump_width, arguments.seed, arguments.stability_margin)


def whole(text: str) -> int:
    """A whole number, or argparse's own complaint."""
    try:
        return int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error


def read_start(path: str) -> Array:
    """A configuration from JSON: 2d + 2 numbers, or {"alpha": [...], "beta": [...], "theta": [...]}.

    Raises OptionError.
    """
    expected = 'JSON, a list of 2d + 2 numbers or {"alpha": [...], "beta": [...], "theta": [...]}, in rad and mm'
    try:
        data: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        if isinstance(data, dict):
            data = [*data["alpha"], *data["beta"], *data["theta"]]
        return floats(OptionError, "the configuration", data, (None,))
    except (OSError, ValueError, KeyError, TypeError, RecursionError, OptionError) as error:
        raise OptionError(f"start {path} cannot be read ({error}); it must be {expected}") from error
