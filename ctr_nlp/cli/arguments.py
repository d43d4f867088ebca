"""Arguments that several programs take, and how their values are read."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import OptionError
from ctr_nlp.models import MODELS
from ctr_nlp.settings import Settings
from ctr_nlp.solvers.cache import SWITCH

Array = npt.NDArray[np.float64]


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


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """What is done to a path from a file before it is followed."""
    group = parser.add_argument_group("where PROBLEM is a centreline file (CSV: x_mm, y_mm, z_mm[, radius_mm])")
    group.add_argument("--reverse", action="store_true", help="follow it from its last point to its first")
    group.add_argument(
        "--trim", choices=("start", "end"), help="which end to drop where it is longer than the robot reaches"
    )
    group.add_argument(
        "--smoothing",
        metavar="MM",
        type=float,
        default=0.0,
        help="how far the followed curve may keep from the points (default 0: through all of them)",
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
    expected = 'a list of 2d + 2 numbers or {"alpha": [...], "beta": [...], "theta": [...]}, in rad and mm'
    try:
        data: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        if isinstance(data, dict):
            data = [*data["alpha"], *data["beta"], *data["theta"]]
        return np.array([float(value) for value in data])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OptionError(f"start {path} cannot be read ({error}); it must be JSON, {expected}") from error
