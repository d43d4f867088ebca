"""Options of the programs that plan, in groups; None, or False, where not given."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

from ctr_nlp.anatomy.reading import ACCEPTABLE, FORMS, MM_PER_UNIT, SPACES, WALLS_OF_MASKS, ReadOptions
from ctr_nlp.anatomy.suffixes import CENTRELINE_SUFFIXES, MASK_SUFFIXES, MESH_SUFFIXES
from ctr_nlp.cli.arguments import (
    DEFAULT_SETTINGS,
    add_entry_option,
    add_live_option,
    add_numbers,
    add_triple,
    count,
    whole,
)
from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads.tissue import AIRWAY_WALL_STIFFNESS_N_PER_MM2, CONTACT_FORCE_ALLOWED_N
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp import default_model
from ctr_nlp.ocp.settings import ARRIVAL_WEIGHT, THRESHOLDS
from ctr_nlp.ocp.terms import ShapeDistance, Term, TipDirection, TipPosition
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.monte_carlo import DEFAULT_PLAN_SAMPLES
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import MOST_LOST

HORIZON_FORMULATION = "horizon"
"""The formulation that solves all frames in one program."""
DEFAULT_SWEEP_WEIGHTS_S2 = tuple(10.0 ** (k / 2 - 8) for k in range(13))
"""Lambdas of a sweep for which none are given, s^2."""
PER_FRAME_ONLY_OPTIONS = ("direction", "jump_width")
"""Options that only frame-by-frame formulations have."""
HORIZON_ONLY_OPTIONS = (
    "arrival_weight",
    "contact_force",
    "wall_stiffness",
    "end",
    "initial",
    "starts",
    "exhaustive",
    "jobs",
    "sweep_motion_weight",
    "live",
)
"""Options that only a horizon has."""
WALL_SETTING_NAMES = ("clearance", "contact_weight")
"""Settings that the options of add_wall_options set."""
THRESHOLD_HELP = {
    "arrival_tolerance": ("MM", "distance from the target's end within which the tip arrives in the last frame"),
    "error_allowed": ("MM", "shape error e2 allowed in any frame"),
    "contact_allowed": ("MM", "how far the robot may be beyond the wall anywhere, since tissue gives a little"),
    "share": ("PART", "share of the simulated robots that must keep their branch, arrive and keep off the wall"),
}
"""Placeholder and help of the options for the thresholds of verdicts."""


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Add the option for the model to plan on to `parser`."""
    parser.add_argument("--model", choices=KINEMATIC_MODELS, help="(default elastic; with two stages dominant)")


def model_from(arguments: argparse.Namespace) -> str:
    """Return the name of the model in `arguments`, or the default of the formulation."""
    named: str | None = arguments.model
    return named or default_model(arguments.formulation)


def add_evaluate_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the option for the model on which a plan's shapes are computed to `parser`.

    default: which model is usual, in words for the help.
    """
    told = f"model on which the plan's shapes are found (default: {default})"
    parser.add_argument("--evaluate", choices=KINEMATIC_MODELS, help=told)


def add_motion_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of every motion to `parser`: its start, its direction, and limits of the motors."""
    group = parser.add_argument_group("the motion")
    group.add_argument("--start", metavar="Q.json", help="configuration at time 0, where the robot stands now")
    group.add_argument("--retract", action="store_true", help="plan the retraction: the frames in opposite order")
    group.add_argument("--lock-tilt", action="store_true", help="no arm: the tilt stays 0")
    for kind, units in (("speed", "rad/s, mm/s, rad/s"), ("acceleration", "rad/s^2, mm/s^2, rad/s^2")):
        add_triple(group, kind, f"largest {kind}s in {units} (default: the robot's)", ("ALPHA", "BETA", "THETA"))


def with_motion_options(problem: Problem, arguments: argparse.Namespace) -> Problem:
    """Return the problem with limits and direction from add_motion_options' options in `arguments`."""
    robot = problem.robot.with_locked_tilt() if arguments.lock_tilt else problem.robot
    for kind in ("speed", "acceleration"):
        if getattr(arguments, kind) is not None:
            names = (f"alpha_{kind}", f"beta_{kind}", f"theta_{kind}")
            robot = robot.with_limits(**dict(zip(names, getattr(arguments, kind), strict=True)))
    problem = replace(problem, robot=robot)
    return problem.retraction() if arguments.retract else problem


def add_horizon_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of motions that are solved over all frames at once to `parser`."""
    group = parser.add_argument_group("all frames at once")
    group.add_argument("--end", metavar="Q.json", help="configuration of the last frame")
    group.add_argument(
        "--sweep-motion-weight",
        metavar="S2",
        nargs="*",
        type=float,
        help="also solve for these weights and draw error against roughness beside other methods "
        f"(default {DEFAULT_SWEEP_WEIGHTS_S2[0]:g} to {DEFAULT_SWEEP_WEIGHTS_S2[-1]:g})",
    )
    group.add_argument(
        "--initial", metavar="PLAN.npz", nargs="+", help="plans to start from, instead of frame by frame"
    )
    group.add_argument(
        "--starts",
        metavar="N",
        type=whole,
        help="number of candidate motions solved to the end (default: the most promising after a few frames)",
    )
    group.add_argument("--exhaustive", action="store_true", help="solve every candidate motion to the end")
    group.add_argument(
        "--jobs", metavar="N", type=whole, help="parallel processes that solve candidates (default 1)"
    )
    end = (
        "cost in mm^2 of each mm between the tip and the target's end, in each frame of the last tenth of the "
        f"motion; three times as much beyond --arrival-tolerance (default {ARRIVAL_WEIGHT:g}, "
        "on the dominant model 0)"
    )
    add_numbers(group, ("arrival-weight", "MM", end))
    group.add_argument(
        "--contact-force",
        metavar="N",
        nargs="?",
        const=CONTACT_FORCE_ALLOWED_N,
        type=float,
        help="let the robot lean on the wall, with at most this force on any 10 mm of it; forces then count "
        f"instead of --contact-allowed (without N {CONTACT_FORCE_ALLOWED_N:g})",
    )
    group.add_argument(
        "--wall-stiffness",
        metavar="N/MM2",
        type=float,
        help="of the wall that it leans on, in N/mm for every mm of length (default "
        f"{AIRWAY_WALL_STIFFNESS_N_PER_MM2:g}, of an airway)",
    )
    add_live_option(group, "the motion as it is solved for, or with --jobs the best yet,")


def add_robust_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to `parser` that choose between all robots within the tolerances and the nominal one."""
    group = parser.add_argument_group("robust planning, for robots within the tolerances")
    which = group.add_mutually_exclusive_group()
    which.add_argument(
        "--robust",
        action="store_true",
        help="plan for all robots within the tolerances of the robot file, with the horizon or joint formulation, "
        "and certify the plan on simulated robots (default for horizon on the elastic model without a load)",
    )
    which.add_argument(
        "--nominal",
        action="store_true",
        help="plan for the robot as described alone, which takes a few seconds (default otherwise)",
    )
    part = "share of robots that may fail, that is snap or end on another branch; 95 percent confidence"
    add_numbers(group, ("most-lost", "PART", f"{part} (default {MOST_LOST:g})"))
    corners = (
        "also keep the robots at the corners of the tolerances from snapping, as far as that goes; much slower"
    )
    group.add_argument("--guards", action="store_true", default=None, help=corners)
    add_tip_force(group)


def add_tip_force(group: argparse._ActionsContainer) -> None:
    """Add the option for the tip force that a robot's tolerances allow to `group`."""
    force = "force that may act at the tip at any time, in any direction (default: tip_force of the robot file)"
    add_numbers(group, ("tip-force", "N", force))


def with_tip_force_option(problem: Problem, arguments: argparse.Namespace) -> Problem:
    """Return the problem, its robot's tolerances with the tip force in `arguments`, if any; raises RobotError."""
    if arguments.tip_force is None:
        return problem
    tolerances = replace(problem.robot.tolerances, tip_force=arguments.tip_force)
    return replace(problem, robot=replace(problem.robot, tolerances=tolerances))


def add_wall_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for how the lumen's wall counts, `WALL_SETTING_NAMES`, to `parser`."""
    group = parser.add_argument_group("the lumen's wall, where radii are known")
    for option, metavar, what in (
        ("clearance", "MM", "to keep between tubes and wall"),
        (
            "contact-weight",
            "MM",
            "cost in mm^2 of each mm below --clearance in a frame, added to the mean square error; twenty times "
            "as much beyond --contact-allowed; 0 ignores the wall",
        ),
    ):
        add_numbers(
            group, (option, metavar, f"{what} (default {getattr(DEFAULT_SETTINGS, option.replace('-', '_')):g})")
        )


def add_threshold_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for the thresholds of verdicts, settings.THRESHOLDS, to `parser`."""
    group = parser.add_argument_group("thresholds of the verdicts")
    for name in THRESHOLDS:
        metavar, what = THRESHOLD_HELP[name]
        add_numbers(
            group, (name.replace("_", "-"), metavar, f"{what} (default {getattr(DEFAULT_SETTINGS, name):g})")
        )


def with_thresholds(plan: Plan, arguments: argparse.Namespace) -> Plan:
    """Return the plan, judged by the thresholds in `arguments`; raises OptionError where one is out of range."""
    given = {name: value for name in THRESHOLDS if (value := getattr(arguments, name)) is not None}
    return plan.with_thresholds(**given) if given else plan


def add_check_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for how a finished plan is evaluated to `parser`."""
    group = parser.add_argument_group("evaluation of the plan")
    group.add_argument(
        "--no-evaluate",
        action="store_true",
        help="skip the simulation on the elastic model, for plans made on another model, and the simulated "
        "robots; verdicts that need them are NOT CHECKED",
    )
    usual = f"{DEFAULT_PLAN_SAMPLES}; under a load 0, since loaded ones take a minute for every 200"
    told = f"robots within the tolerances that are simulated, 0 for none (default {usual})"
    group.add_argument("--samples", metavar="N", type=count, help=told)


def evaluate_plan(plan: Plan, arguments: argparse.Namespace) -> Plan:
    """Evaluate a plan as add_check_options' options in `arguments` say; raises RobotError for a bad number of
    samples.
    """
    if arguments.no_evaluate:
        return plan
    loaded = plan.evaluated_load is not None
    if arguments.samples is None and plan.drawn is not None and plan.can_snap:
        return plan  # a robust plan holds the robots that it was certified on
    usual = 0 if loaded else DEFAULT_PLAN_SAMPLES
    return plan.check(usual if arguments.samples is None else arguments.samples)


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for how a path from a file is prepared, problems.FILE_OPTIONS, to `parser`."""
    kinds = f"a centreline ({', '.join(CENTRELINE_SUFFIXES)}) or a mask of the lumen ({', '.join(MASK_SUFFIXES)})"
    group = parser.add_argument_group(
        f"where PROBLEM is {kinds}", "Points and directions are in the file's own coordinates, in mm."
    )
    group.add_argument(
        "--branch", metavar="NAME|NUMBER", help="which branch of several; `ctr-nlp branches` lists them"
    )
    add_entry_option(group, "the branch's first; in a mask the widest end")
    add_triple(group, "target", "point where it is to arrive (default: the branch's last)")
    add_triple(group, "insertion", "direction in which it is inserted (default: that of the path's first 10 mm)")
    add_numbers(group, ("tilt", "DEG", "how far the base may tilt about each axis (default: the robot's)"))
    group.add_argument(
        "--reverse", action="store_true", default=None, help="the file's lines run from the tip to the root"
    )
    smoothing = (
        "how far the followed curve may keep from the path, never more than half of the lumen's radius "
        "(default: 0, through all points, and 2 in a mask)"
    )
    add_numbers(group, ("smoothing", "MM", smoothing))
    trim = (
        "cut a path that is longer than the robot reaches: start moves the robot's base inwards, end stops before "
        "your target"
    )
    group.add_argument("--trim", choices=("start", "end"), help=trim)
    _add_wall_files(group)
    add_reading_options(group)


def _add_wall_files(group: argparse._ActionsContainer) -> None:
    """Add the options for walls besides the radii of a path to `group`."""
    surface = "what the wall of a mask is: its surface (default), or a round lumen with the path's radius"
    group.add_argument("--wall-of-mask", choices=WALLS_OF_MASKS, help=surface)
    kinds = f"a mask or a mesh ({', '.join(MESH_SUFFIXES)}) in the coordinates of PROBLEM's patient"
    group.add_argument(
        "--keep-out",
        metavar="FILE[:LABEL][=MM]",
        nargs="+",
        action="extend",
        help=f"bodies to keep out of, each with a margin in mm (default 0): {kinds}; LABEL is that of a mask",
    )
    group.add_argument(
        "--inside",
        metavar="FILE[:LABEL][=MM]",
        nargs="+",
        action="extend",
        help="surfaces to stay inside of, instead of the path's radii",
    )


def add_reading_options(group: argparse._ActionsContainer) -> None:
    """Add the options for what a person states about a file, those of ReadOptions, to `group`.

    Each is None where it is not given. --pieces is not one of ReadOptions: it names files.
    """
    choices = [
        ("units", tuple(MM_PER_UNIT), "unit of the file's lengths, where it states none"),
        ("space", SPACES, "patient coordinates of the file, where it states none"),
        ("form", FORMS, "which transform of a NIfTI header counts, where they differ"),
    ]
    for name, allowed, what in choices:
        group.add_argument(f"--{name}", choices=allowed, help=what)
    labels = "labels of a mask that are the lumen, where it has several"
    group.add_argument("--pieces", metavar="FILE", nargs="+", help="further files with pieces of the same tree")
    group.add_argument("--label", metavar="N", type=whole, nargs="+", help=labels)
    group.add_argument("--segment", metavar="NAME", help="segment that is the lumen, in a segmentation of several")
    add_numbers(group, ("threshold", "X", "value from which a voxel is lumen, in a probability map"))
    accepted = (
        "accept what is refused otherwise: a path through a leak, entry and target that seem exchanged, steps "
        "between points that are much longer than their neighbours"
    )
    group.add_argument("--accept", choices=ACCEPTABLE, nargs="+", help=accepted)


def add_piece_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments behind the first file to `parser`, which mean the same as --pieces."""
    parser.add_argument(
        "more_files", metavar="PIECE", nargs="*", help="further files with pieces of the same tree"
    )


def pieces_from(arguments: argparse.Namespace) -> list[str]:
    """Return the files in `arguments` that hold further pieces of a tree."""
    return [*getattr(arguments, "more_files", ()), *(arguments.pieces or ())]


def read_options_from(arguments: argparse.Namespace) -> ReadOptions:
    """Return what add_reading_options' options in `arguments` state about a file; raises OptionError."""
    return ReadOptions(
        arguments.units,
        arguments.space,
        tuple(arguments.label or ()),
        arguments.segment,
        arguments.threshold,
        arguments.form,
        tuple(arguments.accept or ()),
    )


def add_term_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for terms of the objective beside the shape's mean distance, None where not given, to
    `parser`.
    """
    group = parser.add_argument_group("what counts beside the mean distance of the shape, not with two stages")
    angle = "weight of the squared angle between the tip and the target's end, in mm^2/rad^2 (default 0)"
    distance = "weight of the squared distance between the tip and the target's end, without unit (default 0)"
    depth = (
        "the shape's distance counts in proportion to sigma^P, so that deeper parts of the robot count more "
        "(default 0: all parts alike)"
    )
    weights = ("tip-direction-weight", "W", angle), ("tip-weight", "W", distance), ("depth-power", "P", depth)
    add_numbers(group, *weights)


def terms_from(arguments: argparse.Namespace) -> list[Term]:
    """Return the terms of the objective from add_term_options' options in `arguments`; raises OptionError."""
    terms = list[Term]()
    if arguments.depth_power is not None:
        if not 0 <= arguments.depth_power < math.inf:
            raise OptionError(f"--depth-power is {arguments.depth_power:g}; it must be a finite number >= 0")
        terms.append(ShapeDistance(depth_weights=SIGMA_GRID**arguments.depth_power))
    if arguments.tip_direction_weight is not None:
        terms.append(TipDirection(arguments.tip_direction_weight))
    if arguments.tip_weight is not None:
        terms.append(TipPosition(arguments.tip_weight))
    return terms
