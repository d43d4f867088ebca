"""Trade-off between arriving and keeping off the wall, for robots that cannot do both, and its cause.

Costs are priorities (mm^2 for a mm), so that a few weights of arrival trace out the Pareto front. The path's
curvature is compared with the largest one of the tubes present at each point, sum_i EI_i k_i / sum_i EI_i (Dupont
et al., Design and control of concentric-tube robots, IEEE Transactions on Robotics 26(2), 2010).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.models import DEFAULT_MODEL, Model
from ctr_nlp.ocp.settings import ARRIVAL_WEIGHT, Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.paths.lumen import Lumen, outermost_tube_index, outermost_tube_radii
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import Contact, arrival, contacts, e3, find_deepest_point
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import option
from ctr_nlp.planning.horizon import horizon_planner
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.starts.search import with_draft_frames
from ctr_nlp.robot.tube import Tube
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.typing import Array

COMPROMISE_ARRIVAL_WEIGHTS = 0.0, 5.0, 5000.0
"""Weights of arrival, mm^2 a mm, of motions besides the plan's own: contact first, balanced, arrival first."""
CURVATURE_WINDOW_HALF_WIDTH_MM = 5.0
"""Half width, mm, over which a path's curvature is averaged: sharper bends are noise of its points."""


@dataclass(frozen=True)
class Compromise:
    """One motion of the trade-off between arriving and keeping off the wall.

    Attributes
    ----------
    arrival_weight : float
        Cost of a mm by which the tip misses, mm^2 (:class:`Settings`); None for the plan itself.
    tip : float
        Distance of the last tip from the target's end, mm.
    contact : float
        Depth of the deepest contact, mm; negative where the wall stays clear.
    e3 : float
        Mean shape error, mm.
    solved : bool
        Whether every frame was solved.
    where : Contact or None
        Where the robot touches deepest; None where it does not.
    """

    arrival_weight: float | None
    tip: float
    contact: float
    e3: float
    solved: bool
    where: Contact | None

    @classmethod
    def of(cls, plan: Plan, arrival_weight: float | None = None) -> Compromise:
        """Take the figures of a plan within a lumen; arrival_weight: that it was made with, None for its own."""
        ends = arrival(plan)
        deepest = find_deepest_point(plan)
        error = e3(plan)
        tip = math.nan if ends is None else ends.distance
        contact = math.nan if deepest is None else deepest.depth
        touched = max(contacts(plan), key=lambda one: one.depth, default=None)
        solved = bool(plan.success.all())
        return cls(arrival_weight, tip, contact, math.nan if error is None else error, solved, touched)


def planned_for(plan: Plan, one: Compromise) -> str:
    """Say which robots a motion of the trade-off was planned for: only a robust plan itself is made for many.

    Parameters
    ----------
    plan : Plan
        The plan.
    one : Compromise
        The plan's own motion, or another one of :func:`compromises`.

    Returns
    -------
    str
        Words for a table or legend.
    """
    own = one.arrival_weight is None
    return "all robots within the tolerances" if own and "certificate" in plan.meta else "the robot as described"


def find_arrival_weight(plan: Plan, one: Compromise) -> float:
    """Return the weight of arrival that a motion of the trade-off was planned with, mm^2 a mm.

    Parameters
    ----------
    plan : Plan
        The plan, made on a model that can predict snapping.
    one : Compromise
        The plan's own motion, or another one of :func:`compromises`.

    Returns
    -------
    float
        Its own weight, or for the plan's motion that of the plan's options.
    """
    if one.arrival_weight is not None:
        return one.arrival_weight
    asked = option(plan, "arrival_weight")
    return ARRIVAL_WEIGHT if asked is None else float(asked)


class PathDemands(NamedTuple):
    """The points of a path that demand most of the tubes, in curvature and in room.

    bend: arc length, mm, where the path's curvature exceeds the largest one of the tubes there by most, or comes
    nearest to it. radius: of the path's bend there, mm. least: smallest radius of those tubes, mm. narrow: arc
    length, mm, where the lumen leaves least room. room: the lumen's radius there less the tube's, mm. tube: its
    number, from 1.
    """

    bend: float
    radius: float
    least: float
    narrow: float
    room: float
    tube: int


def compromises(
    problem: Problem,
    plan: Plan,
    *,
    model: str | Model = DEFAULT_MODEL,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    terms: Sequence[Term] = (),
    weights: Sequence[float] = COMPROMISE_ARRIVAL_WEIGHTS,
    progress: Progress | None = None,
) -> list[Compromise]:
    """Find motions of the trade-off between arriving and keeping off the wall, for the nominal robot.

    They have the frames of a draft, 25 to 49, which show the trade-off in a third of the time.

    Parameters
    ----------
    problem : Problem
        Robot and target, within a lumen.
    plan : Plan
        A plan of it, the initial guess of all motions, which have its given start and end.
    model, settings, terms
        As :func:`solve_horizon`.
    weights : sequence of float
        Weights of arrival, mm^2 a mm.
    progress : callable, optional
        Called as ``progress(done, total, note)``.

    Returns
    -------
    list of Compromise
        The plan, and a motion for each weight, from the least contact to the deepest. After Ctrl-C, those that
        were found.

    Raises
    ------
    ProblemError
        No wall is known.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> problem = named_problem("bronchus", frames=10)
    >>> plan = ctr.solve_horizon(problem)
    >>> found = compromises(problem, plan, weights=(0.0,))
    >>> len(found)
    2
    """
    if plan.clearance is None:
        raise ProblemError("the lumen's radii are not known; there is no contact to weigh against arrival")
    found = [Compromise.of(plan)]
    start, end = (plan.options.get(name) for name in ("start", "end"))
    # Every motion starts from the plan at the frames of the draft, so that differences come from the weight alone.
    coarse, picked = with_draft_frames(problem)
    with deferred_interrupt() as interrupted:
        for number, weight in enumerate(weights):
            if interrupted():
                break
            if progress is not None:
                progress(number, len(weights), f"arrival weight {weight:g}")
            asked = replace(settings, arrival_weight=weight)
            planner = horizon_planner(coarse, model, None, start, end, asked, terms)
            motion = planner.solve([plan.q[picked]])
            if not interrupted() and motion.success.all():
                found.append(Compromise.of(motion, weight))
    return sorted(found, key=lambda one: one.contact)


def find_path_demands(plan: Plan) -> PathDemands:
    """Find the points of the path in a plan's last frame that demand most of the tubes.

    Parameters
    ----------
    plan : Plan
        A plan within a lumen.

    Returns
    -------
    PathDemands
        Where the path bends most relative to the tubes there, and where it is narrowest for them. The largest
        curvature is that of all tubes present when they bend to the same side, sum_i EI_i k_i / sum_i EI_i (Dupont
        et al., 2010).
    """
    assert plan.lumen is not None
    beta = plan.beta[-1]
    lumen = Lumen(plan.lumen)
    near = lumen.project(plan.target[-1])
    # Robot and path are compared at equal sigma, as in eq. (8).
    s = SIGMA_GRID * beta[-1]
    asked = _moving_average(np.linalg.norm(near.curvature_vector, axis=-1), s)
    possible = _largest_curvature(plan.robot.tubes, beta, s)
    # The difference of curvatures, 1/mm, not the ratio: it is finite where tubes are straight.
    bend = int(np.argmax(asked - possible))
    # The clearance that a robot would have which follows the path exactly.
    room = near.radius - outermost_tube_radii(plan.robot, beta[None], SIGMA_GRID)[0]
    narrow = int(np.argmin(room))
    tube = int(outermost_tube_index(beta[None], SIGMA_GRID)[0, narrow]) + 1
    with np.errstate(divide="ignore"):
        radius = 1 / asked[bend]
        least = 1 / possible[bend]
    return PathDemands(float(s[bend]), float(radius), float(least), float(s[narrow]), float(room[narrow]), tube)


def compromise_sentences(plan: Plan, found: Sequence[Compromise]) -> list[str]:
    """Describe the trade-off, and what stands in the way, in sentences.

    Parameters
    ----------
    plan : Plan
        The plan.
    found : sequence of Compromise
        Of :func:`compromises`.

    Returns
    -------
    list of str
        The least contact of motions that arrive, the least tip error of those that keep off the wall, where the
        robot touches, and what the path demands of the tubes.
    """
    tolerance = float(option(plan, "arrival_tolerance"))
    allowed = float(option(plan, "contact_allowed"))
    arriving = [one for one in found if one.tip <= tolerance]
    clear = [one for one in found if one.contact <= allowed]
    told = list[str]()
    if best := min(arriving, key=lambda one: one.contact, default=None):
        depth = f"presses {best.contact:.2f} mm into the wall" if best.contact > 0 else "stays off the wall"
        told.append(f"Of the motions tried, the best that arrives {depth}; its tip ends {best.tip:.2f} mm off.")
    else:
        told.append(f"None of the motions tried arrives within {tolerance:g} mm.")
    if best := min(clear, key=lambda one: one.tip, default=None):
        told.append(
            f"Of those with at most {allowed:g} mm of contact, the best ends {best.tip:.2f} mm off the target."
        )
    else:
        told.append(f"None of them keeps contact to {allowed:g} mm.")
    # One motion does both: there is nothing to explain.
    if any(one.tip <= tolerance and one.contact <= allowed for one in found):
        return told
    deepest = min(arriving or found, key=lambda one: one.contact).where
    if deepest is not None:
        told.append(
            f"The wall is in the way of tube {deepest.tube}, {deepest.arc_length:.0f} mm along the robot "
            f"({deepest.path:.0f} mm along the path)."
        )
    at = find_path_demands(plan)
    told.append(
        f"The path is hardest to follow {at.bend:.0f} mm along the robot: its radius is {at.radius:.0f} mm, and "
        f"the smallest radius of the tubes is {at.least:.0f} mm. It is narrowest at {at.narrow:.0f} mm, with "
        f"{at.room:.2f} mm of room on each side of tube {at.tube}."
    )
    return told


def pareto_front(found: Sequence[Compromise]) -> list[Compromise]:
    """Return the Pareto front: motions that no other one beats in both the tip's distance and contact.

    Parameters
    ----------
    found : sequence of Compromise
        Motions.

    Returns
    -------
    list of Compromise
        The others, from the least contact to the deepest.
    """

    def beaten(one: Compromise) -> bool:
        return any(
            other.tip <= one.tip and other.contact <= one.contact
            for other in found
            if (other.tip, other.contact) != (one.tip, one.contact)
        )

    return sorted((one for one in found if not beaten(one)), key=lambda one: one.contact)


def _moving_average(values: Array, s: Array) -> Array:
    """Return means of values (n,) at arc lengths s (n,), mm, within CURVATURE_WINDOW_HALF_WIDTH_MM of each."""
    # Means over all samples within the window; near the ends there are fewer of them, and no padding.
    near = abs(s[:, None] - s) <= CURVATURE_WINDOW_HALF_WIDTH_MM
    return np.asarray((near * values).sum(axis=1) / near.sum(axis=1))


def _largest_curvature(tubes: Sequence[Tube], beta: Array, s: Array) -> Array:
    """Return the largest curvature (n,), 1/mm, of tubes with extensions beta (d,) at arc lengths s (n,), mm."""
    bent = np.zeros(len(s))
    stiff = np.zeros(len(s))
    for tube, end in zip(tubes, beta, strict=True):
        from_tip = end - s
        part = np.clip(from_tip / tube.curved_length, 0.0, 1.0)
        # Pre-curvature is linear along the curved part, from its tip to its root; a straight transmission has
        # none.
        curvature = abs(tube.tip_curvature + (tube.root_curvature - tube.tip_curvature) * part)
        # A tube's own end counts as present, against rounding.
        present = from_tip >= -1e-9
        bent += present * (from_tip <= tube.curved_length) * tube.bending_stiffness * curvature
        stiff += present * tube.bending_stiffness
    # Past all tubes both are 0, and so is the quotient.
    return bent / np.maximum(stiff, 1e-300)
