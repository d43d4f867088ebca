"""Options of commands on loaded robots, and how their values are read."""

from __future__ import annotations

import argparse
from dataclasses import replace

from ctr_nlp.cli.arguments import add_triple
from ctr_nlp.models import Model, model_named, model_with_load
from ctr_nlp.models.loads import Load, LoadOverTime, read_load, with_modulus
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot


def add_modulus_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for Young's modulus of a robot's tubes to `parser`."""
    parser.add_argument(
        "--youngs-modulus",
        metavar="MPA",
        type=float,
        help="of the tubes, in MPa (nitinol has about 60000), where the robot file has only their ratio, as that "
        "of Table I does (default: the robot's own)",
    )


def add_load_options(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add the options for a load, a file or a tip force alone, to `parser`; required: whether one must be
    given.
    """
    group = parser.add_mutually_exclusive_group(required=required)
    told = "load on the robot, constant or changing over time (`ctr-nlp new load FILE.toml` writes a template)"
    group.add_argument("--load", metavar="FILE.toml", help=told)
    add_triple(group, "force", "a force at the tip alone, in N, in the directions of the base")


def read_plan(arguments: argparse.Namespace) -> Plan:
    """Load the plan that `arguments` name, with Young's modulus where that was given.

    Raises LoadError where the modulus cannot be set, and OutputError where the plan cannot be read.
    """
    plan = Plan.load(arguments.plan)
    return plan if arguments.youngs_modulus is None else plan.with_modulus(arguments.youngs_modulus)


def load_from(arguments: argparse.Namespace) -> Load | LoadOverTime:
    """Return the load that the options of add_load_options in `arguments` ask for; raises LoadError."""
    return Load(force=arguments.force) if arguments.load is None else read_load(arguments.load)


def robot_with_modulus(robot: Robot, arguments: argparse.Namespace) -> Robot:
    """Return the robot with the Young's modulus in `arguments`, if any; raises LoadError."""
    return robot if arguments.youngs_modulus is None else with_modulus(robot, arguments.youngs_modulus)


def problem_with_modulus(problem: Problem, arguments: argparse.Namespace) -> Problem:
    """Return the problem, its robot with the Young's modulus in `arguments`, if any; raises LoadError."""
    return replace(problem, robot=robot_with_modulus(problem.robot, arguments))


def has_load(arguments: argparse.Namespace) -> bool:
    """Tell whether `arguments` have a load, from --load or --force."""
    return arguments.load is not None or arguments.force is not None


def model_from_options(model: str, arguments: argparse.Namespace) -> Model:
    """Return the model called `model`, under the load in `arguments`, if any; raises LoadError, OptionError."""
    if not has_load(arguments):
        return model_named(model)
    return model_with_load(model, load_from(arguments))
