"""Arrival: the tip at the target's end where the motion ends.

A horizon minimises a mean over frames, eq. (9). Most frames lie in the easy part of a path, so the mean neglects
the last frames: they end 2 to 13 mm off where 0.2 mm would increase the mean hardly at all. This term adds a cost
of the end. In frame j the distance from the tip p to the target's end costs

    w h(|p - p_j| - r - f_j) + (EXCESS_ARRIVAL_FACTOR - 1) w h(|p - p_j| - R - f_j),    f_j = ARRIVAL_FUNNEL_MM (1
    - part_j) / ARRIVAL_MOTION_FRACTION

in the last ARRIVAL_MOTION_FRACTION of the motion, and nothing before. The tip should be within r and has to be
within R, which is just less than the tolerance that the plan is judged by: beyond R a mm costs
EXCESS_ARRIVAL_FACTOR times as much. The balls shrink towards the end, so that the tip enters them gradually
instead of jumping there in the last frame. h(x) is 0 for x <= 0: a plan that arrives pays nothing. Beyond, h is x
- PENALTY_ROUNDING_MM / 2, an exact penalty with a rounded corner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ctr_nlp.models import Model
from ctr_nlp.models.inner import Inner
from ctr_nlp.ocp.nlp import CostTerm
from ctr_nlp.ocp.settings import ARRIVAL_WEIGHT, Settings
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.ocp.terms.tip import TipOnlyTerm
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array

ARRIVAL_MOTION_FRACTION = 0.1
"""Part of the motion, at its end, in which the term counts."""
ARRIVAL_FUNNEL_MM = 2.0
"""mm by which the ball is larger where the term sets in than in the last frame."""
AIMED_TOLERANCE_FRACTION, AIMED_TOLERANCE_FRACTION_PERTURBED, REQUIRED_TOLERANCE_FRACTION = 0.15, 0.5, 0.85
"""Fractions of the tolerance: within which the tip should be in the last frame, of the nominal robot and of
perturbed robots, and within which it has to be. The rest is reserved for effects that are not modelled.
"""
EXCESS_ARRIVAL_FACTOR = 3.0
"""How many times more a mm costs beyond what is required."""
PENALTY_ROUNDING_MM = 0.3
"""mm over which the penalty sets in."""
TIP_DISTANCE_SMOOTHING_MM = 0.01
"""mm: added to the distance as a square, so that it has a slope where it is 0."""


def smooth_excess(value: Any, width: float = PENALTY_ROUNDING_MM) -> Any:
    """Return a smooth max(value, 0) that is exactly 0 where value <= 0.

    Parameters
    ----------
    value : casadi expression
        mm.
    width : float
        Over which the slope grows from 0 to 1, mm.

    Returns
    -------
    casadi expression
        value^2 / (2 width) up to width, value - width / 2 beyond; continuous with its slope.
    """
    above = ca.fmax(value, 0)
    within = ca.fmin(above, width)
    # Both pieces in one expression: w^2 / (2 width) below width, where within = above, and above - width /
    # 2 beyond.
    return within * (above - within / 2) / width


@dataclass(frozen=True, eq=False)
class ArrivalTerm(TipOnlyTerm):
    """The cost of the distance by which the tip misses the target's end, in the last frames of a motion.

    Parameters
    ----------
    weight : float
        Cost of a mm of it in a frame, mm^2.
    radius : float
        Distance from the target's end within which the tip may be in the last frame at no cost, mm.
    required : float
        Distance beyond which each mm costs EXCESS_ARRIVAL_FACTOR times as much, mm.
    perturbed_extra_radius : float
        How much larger the radius is for perturbed robots than for the nominal one, mm.
    """

    weight: float
    radius: float
    required: float
    perturbed_extra_radius: float = 0.0
    name = "arrival"
    of_settings = True

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return shapes of the target's end, mm, the weight, mm^2 a mm, the radius and the required one, mm.

        structure: not used.
        """
        single = dict.fromkeys(("arrival_weight", "arrival_radius", "arrival_required"), (1, 1))
        return {"arrival_end": (1, 3), **single}

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the values for a frame; the weight is 0 before the last part of the motion."""
        return self.values(frame.points[-1:], frame.motion_fraction)

    def values(self, end: Array, part: float) -> dict[str, Any]:
        """Return the parameters of the term at one moment of a motion.

        Parameters
        ----------
        end : ndarray
            The target's end at that moment, (1, 3) mm.
        part : float
            Part of the motion that has passed, from 0 to 1.

        Returns
        -------
        dict
            Values by the names of `parameters`.
        """
        # The tip comes near bit by bit: in the frames before the last one it may be further away, by a distance
        # that falls evenly to zero.
        funnel = ARRIVAL_FUNNEL_MM * (1 - part) / ARRIVAL_MOTION_FRACTION
        return {
            "arrival_end": end,
            # A parameter, so that frames before the last part have the same program.
            "arrival_weight": self.weight if part > 1 - ARRIVAL_MOTION_FRACTION else 0.0,
            "arrival_radius": self.radius + funnel,
            "arrival_required": self.required + funnel,
        }

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return one cost, written in the tip's position: that of body. parameters: symbols by name."""
        # As a layer of its own: second derivatives are taken over three coordinates instead of over x.
        tip = Inner.of([ca.SX(ca.horzcat(*body.points))])
        away = tip.symbols[0] - parameters["arrival_end"]
        distance = ca.sqrt(ca.sumsqr(away) + TIP_DISTANCE_SMOOTHING_MM**2)
        missed = smooth_excess(distance - parameters["arrival_radius"])
        missed += (EXCESS_ARRIVAL_FACTOR - 1) * smooth_excess(distance - parameters["arrival_required"])
        return Parts(costs=(CostTerm(self.name, parameters["arrival_weight"] * missed),), inner=(tip,))


def with_arrival(terms: Sequence[Term], settings: Settings, model: Model) -> tuple[Term, ...]:
    """Return terms with the ArrivalTerm of the settings, unless they contain one already.

    Parameters
    ----------
    terms : sequence of Term
        Further terms of the objective.
    settings : Settings
        `arrival_weight`, mm^2 a mm, and `arrival_tolerance`, mm.
    model : Model
        The model that is planned on; by default the end counts on those that can predict snapping.

    Returns
    -------
    tuple of Term
        The terms, and then at most one Arrival.
    """
    # On models that cannot snap the end counts only if asked for: the paper's experiments stay as they
    # were.
    usual = ARRIVAL_WEIGHT if model.can_snap else 0.0
    weight = usual if settings.arrival_weight is None else settings.arrival_weight
    if not weight or any(isinstance(term, ArrivalTerm) for term in terms):
        return tuple(terms)
    tolerance = settings.arrival_tolerance
    wider = (AIMED_TOLERANCE_FRACTION_PERTURBED - AIMED_TOLERANCE_FRACTION) * tolerance
    return (
        *terms,
        ArrivalTerm(weight, AIMED_TOLERANCE_FRACTION * tolerance, REQUIRED_TOLERANCE_FRACTION * tolerance, wider),
    )


def with_frame_arrival(terms: Sequence[Term], settings: Settings, model: Model) -> tuple[Term, ...]:
    """Return terms of single frames with the ArrivalTerm of the settings; under a load, the terms alone.

    Under a load, single frames with this term remain unsolved or touch the wall: frames that are solved one after
    the other cannot prepare for the end.

    Parameters
    ----------
    terms, settings, model
        As for `with_arrival`.

    Returns
    -------
    tuple of Term
        The terms, and then at most one Arrival.
    """
    return with_arrival(terms, settings, model) if model.applied_load is None else tuple(terms)


def find_arrival(terms: Sequence[Term]) -> ArrivalTerm | None:
    """Return the ArrivalTerm among terms; None where there is none."""
    return next((term for term in terms if isinstance(term, ArrivalTerm)), None)
