"""Verdicts: whether a plan does what a motion through a lumen is for, computed from the data of the plan.

A verdict has one of three words. ``yes`` and ``no`` are the result of a check that was made. ``NOT CHECKED`` says
that no check was made, or that the model in use cannot predict the result; it never counts as ``yes``.

Shapes count only on a model that can predict snapping (the elastic one). On any other model a tip that misses its
target is a ``no``, but a tip that reaches it proves nothing about real tubes, which twist each other.
:meth:`Plan.check` evaluates a plan on the elastic model and on simulated robots within the tolerances.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.measures import (
    DeepestPoint,
    arrival,
    describe_place,
    describe_shortcut,
    e3,
    find_deepest_points,
    find_most_used_limit,
    largest_error,
)
from ctr_nlp.plan.plan_data import PlanData, load_of
from ctr_nlp.plan.sample_outcomes import SampleOutcomes, sample_outcomes

YES, NO, NOT_CHECKED = "yes", "no", "NOT CHECKED"
"""The words of a verdict."""
BIFURCATION_MARGIN = 1e-3
"""A stability margin this small between frames belongs to a bifurcation: the margin is 0 at one point of the path,
and chance decides which branch the robot takes."""
MARGIN_SLACK = 0.005
"""Shortfall of the stability margin that is accepted. Planners raise the margins of frames until the shortfall
between frames is less (planning/stability_refinement.py)."""
FORCE_SLACK_FRACTION = 0.02
"""Part of the allowed force by which it may be exceeded: forces are computed to 1 %."""
MIN_REPORTED_SHORTNESS_MM = 0.05
"""Length, mm, by which a robot must be shorter than its path for the reason of *arrives* to say so."""
ROBUSTNESS_VERDICT_NAME = "holds on built robots"
"""The verdict on simulated robots within the tolerances."""
REACHED_VERDICT_NAMES = "solved", "stable", "within_limits", "arrives", "within_wall", "holds"
"""Verdicts that are all *yes* where the end of a path is reached, in the order in which they are checked
(docs/reached.md).
"""


class Verdict(NamedTuple):
    """The result of one check.

    Attributes
    ----------
    matter : str
        What was checked, in words.
    word : str
        ``YES``, ``NO`` or ``NOT_CHECKED``.
    number : float or None
        The figure that decides, in `unit`; None where there is none.
    unit : str
        Unit of `number`.
    why : str
        One or two sentences with the limit and the frame.
    value : str
        `number` with its unit, and further figures, as tables show them.

    Notes
    -----
    ``print`` shows the check, its word and the reason; ``repr`` all attributes.

    Examples
    --------
    >>> print(Verdict("stable", "no", 0.02, "", "The least margin is 0.02."))
    stable: no (The least margin is 0.02)
    """

    matter: str
    word: str
    number: float | None
    unit: str
    why: str
    value: str = ""

    def __str__(self) -> str:
        """Return the check, its word and the reason."""
        return f"{self.matter}: {self.word} ({self.why.rstrip('.')})"


class Verdicts(NamedTuple):
    """All verdicts on one plan, see docs/concepts/verdicts.md.

    Attributes
    ----------
    solved : Verdict
        Every frame is a solution of its optimisation problem; NOT CHECKED for motions that were given, not solved.
        Number: frames solved.
    arrives : Verdict
        In the last frame the tip is within ``arrival_tolerance`` of the target's end, and the robot lies along
        the path. Number: mm.
    follows : Verdict
        In the worst frame the error e2 is at most ``error_allowed``. Number: mm.
    stable : Verdict
        The stability margin asked for holds at and between frames. Number: least margin.
    within_limits : Verdict
        Positions, order, carriages, speeds and accelerations are allowed. Number: percent of the limit.
    within_wall : Verdict
        Where the robot leans on a wall that gives, the wall's force at one place is at most the one allowed in any
        frame or between frames. Number: N. Otherwise, no place is further beyond a wall than ``contact_allowed``,
        in any frame or between frames, and none is nearer to a body that the robot keeps out of than its margin.
        Number: mm beyond the wall that is missed by most.
    holds : Verdict
        At least ``share`` of the simulated robots stay on their branch, arrive, and press into the wall by at most
        :data:`~ctr_nlp.plan.sample_outcomes.SAMPLE_CONTACT_ALLOWED_MM`. Number: their share.
    """

    solved: Verdict
    arrives: Verdict
    follows: Verdict
    stable: Verdict
    within_limits: Verdict
    within_wall: Verdict
    holds: Verdict

    def __str__(self) -> str:
        """Return a line for each verdict: the check, its word and the reason."""
        return "\n".join(map(str, self))

    @property
    def failed_names(self) -> tuple[str, ...]:
        """Names of the verdicts that are *no*."""
        return tuple(verdict.matter for verdict in self if verdict.word == NO)

    @property
    def unchecked_names(self) -> tuple[str, ...]:
        """Names of the verdicts that are *NOT CHECKED*."""
        return tuple(verdict.matter for verdict in self if verdict.word == NOT_CHECKED)

    @property
    def end_reached(self) -> bool:
        """Whether the end of the path is reached: all REACHED_VERDICT_NAMES are *yes*."""
        return all(getattr(self, name).word == YES for name in REACHED_VERDICT_NAMES)

    @property
    def end_reached_as_described(self) -> bool:
        """Whether the robot as described reaches the end: all REACHED_VERDICT_NAMES but *holds* are *yes*."""
        return all(getattr(self, name).word == YES for name in REACHED_VERDICT_NAMES if name != "holds")


SHORT_NAMES = {name: name.removeprefix("within_").replace("_", " ") for name in Verdicts._fields}
"""Names of the verdicts for the heads of narrow columns."""


def verdicts(plan: PlanData) -> Verdicts:
    """Compute the verdicts on a plan from its shapes, margins and samples.

    Parameters
    ----------
    plan : PlanData
        The plan; its options have the thresholds (``arrival_tolerance``, ``error_allowed``, ``contact_allowed``,
        ``share``, ``stability_margin``), and where they are missing the defaults of :class:`Settings` apply.

    Returns
    -------
    Verdicts
        One verdict for each check.
    """
    return Verdicts(
        Verdict("solved", *_judge_solved(plan)),
        Verdict("arrives", *_judge_arrival(plan)),
        Verdict("follows", *_judge_shape_error(plan)),
        Verdict("stable", *_judge_stability(plan)),
        Verdict("within limits", *_judge_limits(plan)),
        Verdict("within the wall", *_judge_wall_contact(plan)),
        Verdict(ROBUSTNESS_VERDICT_NAME, *_judge_robustness(plan)),
    )


Judgement = tuple[str, float | None, str, str, str]
"""Word, number, unit, sentences and value of a verdict."""


def _judge_solved(plan: PlanData) -> Judgement:
    """Check that every frame was solved.

    Frames that were only interpolated count as not checked, and so do those that were given and have no KKT
    residual: of a motion from another program, or by hand.
    """
    frames = len(plan.time)
    interpolated = len(plan.meta.get("interpolated", []))
    unsolved = int((~plan.success).sum()) - interpolated
    given = int((plan.success & np.isnan(plan.kkt)).sum())
    solved = frames - unsolved - interpolated - given
    value = f"{solved} of {frames} frames"
    if unsolved:
        return NO, solved, "frames", f"{unsolved} of {frames} frames were not solved.", value
    if interpolated:
        return NOT_CHECKED, solved, "frames", f"{interpolated} of {frames} frames are interpolated.", value
    if given:
        why = f"{given} of {frames} frames were given, not solved: they have no KKT residual."
        return NOT_CHECKED, solved, "frames", why, value
    planned = load_of(plan.meta, "planned_load")
    under = "" if planned is None else f" under {planned}"
    why = f"All {frames} frames were solved on the {plan.meta['model']} model{under}.{_cost_of_clearance(plan)}"
    return YES, solved, "frames", why, f"{frames} frames"


def _cost_of_clearance(plan: PlanData) -> str:
    """Return a sentence on how much larger e3 is for keeping off the wall; empty where that is not known."""
    free = plan.meta.get("e3_free")
    found = e3(plan)
    if plan.free is None or not free or found is None or not plan.as_planned:
        return ""
    return f" Keeping off the wall costs {100 * max(found / free - 1, 0.0):.1f} % of e3."


def _judge_arrival(plan: PlanData) -> Judgement:
    """Check that the tip ends at the target's end, and comes there along the path; number: distance in mm."""
    tolerance = float(option(plan, "arrival_tolerance"))
    end = arrival(plan)
    if end is None:
        return NOT_CHECKED, None, "mm", "The robot's shape in the last frame is not known.", ""
    value = f"{end.distance:.2f} mm, {end.angle_deg:.1f}°"
    why = (
        f"The tip ends {end.distance:.2f} mm and {end.angle_deg:.1f}° from the target's end; "
        f"{tolerance:g} mm is allowed."
    )
    shortcut = describe_shortcut(plan, tolerance)
    if end.distance <= tolerance and shortcut is not None:
        why += f" It does not come along the path: {shortcut}. The robot cannot follow this path."
        return NO, end.distance, "mm", why, value
    if end.short >= MIN_REPORTED_SHORTNESS_MM:
        # A sentence of its own, since only the tip's distance has a limit. A body that lies along the path is at
        # most as much shorter as its tip is away from the end.
        cuts = ", because it cuts the bends" if end.distance <= min(tolerance, end.short) else ""
        why += f" The robot is {end.short:.1f} mm shorter than the path{cuts}."
    return _judge_by_shape(plan, end.distance <= tolerance, end.distance, "mm", why, value)


def _judge_shape_error(plan: PlanData) -> Judgement:
    """Check that e2 is within its limit in every frame that has a shape; number: the largest e2 in mm."""
    allowed = float(option(plan, "error_allowed"))
    worst = largest_error(plan)
    if worst is None:
        return NOT_CHECKED, None, "mm", "The robot's shape is not known in any frame.", ""
    why = (
        f"The error is largest in frame {worst.frame}: e2 is {worst.e2:.2f} mm; {allowed:g} mm is allowed. "
        f"e3, over all frames, is {worst.e3:.3g} mm."
    )
    value = f"{worst.e2:.2f} mm in frame {worst.frame}"
    unknown = int((~plan.reached_frames).sum())
    if unknown and worst.e2 <= allowed:
        why += f" The shape is not known in {unknown} of {len(plan.time)} frames."
        return NOT_CHECKED, worst.e2, "mm", why, value
    return _judge_by_shape(plan, worst.e2 <= allowed, worst.e2, "mm", why, value)


def _judge_by_shape(plan: PlanData, good: bool, number: float, unit: str, why: str, value: str) -> Judgement:
    """Return a verdict that rests on shapes: *yes* only where the model predicts how real tubes twist."""
    if good and not plan.can_snap:
        why += f" The {plan.evaluated_model_name} model cannot predict how real tubes twist; use the elastic one."
        return NOT_CHECKED, number, unit, why, value
    return YES if good else NO, number, unit, why, value


def _judge_stability(plan: PlanData) -> Judgement:
    """Check that the margin asked for holds at and between frames, without a snap; number: the least margin."""
    if not plan.can_snap:
        return NOT_CHECKED, None, "", "This model cannot predict snapping; use --model elastic.", ""
    # minimum, not fmin: a frame counts as known only where both its margins are.
    margins = np.minimum(plan.stability, plan.stability_between)
    snaps = plan.meta.get("snaps", [])
    asked = option(plan, "stability_margin")
    known = np.isfinite(margins)
    least = float(margins[known].min()) if known.any() else None
    frame = int(np.nanargmin(margins)) + 1 if known.any() else None
    value = "" if least is None else f"{least:.3f} at frame {frame}"
    under = "" if plan.evaluated_load is None else f" under {plan.evaluated_load}"
    # The worst reasons for *no* come first; only then those for which nothing can be said.
    if snaps:
        more = f", and {len(snaps) - 1} times more" if len(snaps) > 1 else ""
        return NO, least, "", f"The robot snaps{under} on the way to frame {snaps[0]['frame']}{more}.", value
    if least is not None and least <= 0:
        return NO, least, "", f"The robot is unstable{under} in frame {frame} or on the way to it.", value
    if least is not None and least <= BIFURCATION_MARGIN:
        why = f"The robot passes a bifurcation around frame {frame}; which branch it follows cannot be predicted."
        return NO, least, "", why, value
    if least is not None and asked is not None and least < float(asked) - MARGIN_SLACK:
        why = f"The stability margin falls to {least:.3f} around frame {frame}; {asked:g} was asked for."
        return NO, least, "", why, value
    if plan.evaluated_load is not None and not plan.evaluated_load.conservative:
        why = "The robot does not snap, but a load with a moment, or one that turns with the tip, has no energy "
        return NOT_CHECKED, least, "", f"{why}and therefore no margin.", value
    if not known.all():
        return NOT_CHECKED, least, "", f"The stability margin is not known in {(~known).sum()} frames.", value
    asked_for = "" if asked is None else f"; {asked:g} was asked for"
    return YES, least, "", f"The least margin{under} is {least:.3f}, around frame {frame}{asked_for}.", value


def _judge_limits(plan: PlanData) -> Judgement:
    """Check positions, order, carriages, speeds and accelerations; number: percent of the most used limit."""
    unit = "% of the limit"
    if not np.isfinite(plan.q).any():
        return NOT_CHECKED, None, unit, "No frame was reached.", ""
    most = find_most_used_limit(plan)
    if most is None:
        return YES, 0.0, unit, "The robot does not move.", f"0 {unit}"
    percent = 100 * most.part
    value = f"{percent:.0f} {unit}"
    if most.exceeded:
        hint = "acceleration" in most.what and "horizon" not in plan.meta.get("formulation", "")
        only = "; only the horizon formulation limits accelerations" * hint
        return NO, percent, unit, f"The {most.what} exceeds its limit{only}.", value
    if not np.isfinite(plan.q).all():
        return NOT_CHECKED, percent, unit, f"{_count_unknown_frames(plan)} frames have no configuration.", value
    return YES, percent, unit, f"The {most.what} comes nearest to its limit.", value


def _count_unknown_frames(plan: PlanData) -> int:
    """Return the number of frames that have no configuration."""
    return int((~np.isfinite(plan.q).all(axis=1)).sum())


def _judge_wall_contact(plan: PlanData) -> Judgement:
    """Check that no point is deeper in a wall than allowed, in or between frames; number: mm of contact.

    Tissue around a lumen gives a little, so that contact up to ``contact_allowed`` counts as within it. The margin
    of a body that the robot keeps out of is not to be touched at all.
    """
    unit = "mm of contact"
    if plan.leans_on_wall:
        return _judge_wall_force(plan)
    if plan.clearance is None:
        return NOT_CHECKED, None, unit, "No wall is known: the path has no radii.", ""
    places = find_deepest_points(plan)
    if not places:
        return NOT_CHECKED, None, unit, "No frame was reached.", ""
    allowed = dict.fromkeys(places, float(option(plan, "contact_allowed")))
    allowed |= {body.name: 0.0 for body in plan.walls if body.keep_out}
    # The wall that is missed by most comes first; without one, the nearest.
    order = sorted(places, key=lambda name: allowed[name] - places[name].depth)
    several = len(order) > 1
    why = " ".join(_describe_deepest_point(plan, places[name], allowed[name], name * several) for name in order)
    worst = places[order[0]]
    of = f" ({order[0]})" * several
    value = f"{-worst.depth:.2f} mm clear{of}"
    if worst.depth > 0:
        value = f"{worst.depth:.2f} mm deep, frame {worst.frame}{of}"
    depth = max(worst.depth, 0.0)
    kept = all(place.depth <= allowed[name] for name, place in places.items())
    if kept:
        unknown = int((~plan.reached_frames).sum())
        if unknown:
            return NOT_CHECKED, depth, unit, f"{why} {unknown} frames have no shape.", value
        if plan.clearance_between is None:
            return NOT_CHECKED, depth, unit, f"{why} Contact between frames was not checked.", value
    return _judge_by_shape(plan, kept, depth, unit, why, value)


def _judge_wall_force(plan: PlanData) -> Judgement:
    """Check that the wall's force at one place is nowhere larger than allowed, in or between frames; number: N."""
    unit = "N at one place"
    assert plan.place_force is not None
    assert plan.place_force_between is not None
    allowed = float(plan.meta["wall_contact"]["limit_N"])
    largest = np.fmax(plan.place_force, plan.place_force_between)
    known = np.isfinite(plan.place_force) & np.isfinite(plan.place_force_between)
    if not known.any():
        return NOT_CHECKED, None, unit, "The wall's forces are not known in any frame.", ""
    worst = int(np.nanargmax(largest))
    force = float(largest[worst])
    deepest = max(find_deepest_points(plan).values(), key=lambda place: place.depth)
    depth = max(deepest.depth, 0.0)
    value = f"{force:.2f} N, {depth:.2f} mm deep, frame {worst + 1}"
    why = (
        f"The wall presses on one place (10 mm of the robot) with {force:.3f} N at most, "
        f"{_force_place(plan, worst)}; {allowed:g} N is allowed. "
        f"The deepest contact is {depth:.2f} mm. {_describe_without_wall(plan)}"
    )
    if force > allowed * (1 + FORCE_SLACK_FRACTION):
        return NO, force, unit, why, value
    if not known.all():
        why += f" Forces are not known in {(~known).sum()} frames."
        return NOT_CHECKED, force, unit, why, value
    return YES, force, unit, why, value


def _force_place(plan: PlanData, j: int) -> str:
    """Return in words where the wall presses most in frame j, from 0."""
    assert plan.wall_force is not None
    assert plan.wall_force_along is not None
    if not np.isfinite(plan.wall_force[j]).any() or not plan.wall_force[j].max():
        return f"on the way to frame {j + 1}"
    along = float(plan.wall_force_along[j, plan.wall_force[j].argmax()])
    tube = min(int((along > plan.beta[j]).sum()), plan.beta.shape[1] - 1) + 1
    return f"around frame {j + 1}, at tube {tube}, {along:.0f} mm along the robot"


def _describe_without_wall(plan: PlanData) -> str:
    """Return a sentence on the stability of a robot from which the wall that it leans on gives way."""
    assert plan.stability_without_wall is not None
    lost = np.flatnonzero(~np.isfinite(plan.stability_without_wall))
    if lost.size:
        return f"If the wall gave way, the robot would snap on the way to frame {lost[0] + 1}."
    least = int(plan.stability_without_wall.argmin())
    return (
        f"If the wall gave way, the stability margin would be {plan.stability_without_wall[least]:.3f} at least, "
        f"in frame {least + 1}."
    )


def _describe_deepest_point(plan: PlanData, place: DeepestPoint, allowed: float, name: str) -> str:
    """Return a sentence on the point where a robot is deepest in a wall, or nearest to it.

    allowed: depth that is allowed, mm. name: of the wall; empty where it is the only one.
    """
    where = f"{place.when} {place.frame}, at tube {place.tube}, {place.arc_length:.0f} mm along the robot"
    if plan.meta["problem"].get("space") is not None:
        where += f", at {describe_place(plan, place.point)}"
    body = next((body for body in plan.walls if body.name == name), None)
    margin = "" if body is None or not body.margin else f" within the margin of {body.margin:g} mm"
    begin = f"{name}: the" if name else "The"
    if place.depth > 0:
        limit = f"{allowed:g} mm is allowed" if allowed else "none is allowed"
        return f"{begin} deepest contact{margin} is {place.depth:.2f} mm {where}; {limit}."
    beyond = margin.replace("within", "beyond")
    return f"{begin} least clearance{beyond} is {-place.depth:.2f} mm {where}."


def _judge_robustness(plan: PlanData) -> Judgement:
    """Check that enough samples stay on their branch, arrive and keep off the wall; number: their share."""
    unit = "of samples"
    if plan.leans_on_wall:
        return NOT_CHECKED, None, unit, "Robots that differ from the nominal one are not simulated on a wall.", ""
    if plan.drawn is None:
        why = "No robots within the tolerances were simulated; `ctr-nlp robust PLAN.npz` does that."
        return NOT_CHECKED, None, unit, why, ""
    if not plan.can_snap:
        why = (
            f"On the {plan.evaluated_model_name} model no robot can snap; use `ctr-nlp robust --evaluate elastic`."
        )
        return NOT_CHECKED, None, unit, why, ""
    found = sample_outcomes(plan)
    wanted = float(option(plan, "share"))
    word = YES if found.share >= wanted else NO
    hint = "" if word == YES or "certificate" in plan.meta else " `ctr-nlp plan --robust` plans for such robots."
    force = plan.robot.tolerances.tip_force
    pushed = f" Each has a tip force of {force:g} N in a random direction." if force else ""
    why = f"{outcome_sentence(found)} {100 * wanted:g} % must hold.{hint}{pushed}"
    return word, found.share, unit, why, f"{100 * found.share:.3g} % of {len(found)}"


def outcome_sentence(found: SampleOutcomes) -> str:
    """Return a sentence on how many simulated robots pass, and how many fail for which reason.

    found: outcomes of the robots. One that fails for several reasons counts for the first of them, so that the
    counts add up.
    """
    missed = f"do not arrive within {found.arrival_tolerance:g} mm"
    if found.shortcut is not None:
        missed = "do not arrive along the path"
    reasons = [
        (found.lost, "snap or leave the branch"),
        (found.missed_target & ~found.lost, missed),
        (
            found.exceeded_contact_limit & ~found.lost & ~found.missed_target,
            f"touch the wall by more than {found.contact_allowed:g} mm",
        ),
    ]
    told = [f"{flags.sum()} {what}" for flags, what in reasons if flags.any()]
    failed = f"; {', '.join(told)}" if told else ""
    wall = "" if found.wall_known else " No wall is known."
    return f"{found.passed_all_checks.sum()} of {len(found)} simulated robots hold{failed}.{wall}"


def option(plan: PlanData, name: str) -> Any:
    """Return the option `name` of a plan, or its default where the plan is older than the option."""
    return plan.options.get(name, Settings().options()[name])
