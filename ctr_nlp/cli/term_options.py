"""Options of further terms of the objective."""

from __future__ import annotations

import argparse
import math

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.terms import ShapeDistance, Term, TipDirection, TipPosition
from ctr_nlp.target.target import SIGMA


def add_term_options(parser: argparse.ArgumentParser) -> None:
    """What counts beside the mean distance of the whole shape; None where not given."""
    group = parser.add_argument_group("what counts beside the mean distance of the shape, not with two stages")
    group.add_argument(
        "--tip-direction-weight",
        metavar="W",
        type=float,
        help="weight of the squared angle between the tip and the target's end, in mm^2/rad^2 (default 0)",
    )
    group.add_argument(
        "--tip-weight",
        metavar="W",
        type=float,
        help="weight of the squared distance between the tip and the target's end, without unit (default 0)",
    )
    group.add_argument(
        "--depth-power",
        metavar="P",
        type=float,
        help="the shape's distance counts in proportion to sigma^P, so that deeper parts of the robot count more "
        "(default 0: all parts alike)",
    )


def terms_from(arguments: argparse.Namespace) -> list[Term]:
    """The terms that add_term_options' arguments ask for; raises OptionError."""
    terms = list[Term]()
    if arguments.depth_power is not None:
        if not 0 <= arguments.depth_power < math.inf:
            raise OptionError(f"--depth-power is {arguments.depth_power:g}; it must be a finite number >= 0")
        terms.append(ShapeDistance(depth_weights=SIGMA**arguments.depth_power))
    if arguments.tip_direction_weight is not None:
        terms.append(TipDirection(arguments.tip_direction_weight))
    if arguments.tip_weight is not None:
        terms.append(TipPosition(arguments.tip_weight))
    return terms
