"""Verdicts on a plan, one a matter: what each of them needs, found from what the plan itself holds."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.plan.measures import depth, e3, most_used
from ctr_nlp.plan.record import Record, load_of

YES, NO, NOT_ASKED, NOT_KNOWN = "yes", "no", "not asked", "not known"
"""The words of a verdict."""
FORK = 1e-3
"""A stability margin as small as this between frames is that of a fork, where it is 0 at one point of the way."""
MOST_LOST = 0.01
"""The share of a plan's draws that may be lost, where nothing else was asked for."""
SURVIVES = "survives its draws"
"""The matter of robots that are not quite the one described."""
ROUNDING = 1e-6
"""mm by which e3 may exceed its limit: rounding."""


class Verdict(NamedTuple):
    """word: YES, NO, NOT_ASKED or NOT_KNOWN. number: in unit, None where there is none. why: one sentence."""

    matter: str
    word: str
    number: float | None
    unit: str
    why: str


class Verdicts(NamedTuple):
    """Those on one plan."""

    followed: Verdict
    stable: Verdict
    within_limits: Verdict
    within_wall: Verdict
    survives_draws: Verdict

    @property
    def failed(self) -> tuple[str, ...]:
        """The matters whose verdict is no."""
        return tuple(verdict.matter for verdict in self if verdict.word == NO)


def verdicts(plan: Record) -> Verdicts:
    """Those on a plan, with the shapes and margins of the model that it is evaluated on."""
    return Verdicts(
        Verdict("followed", *_followed(plan)),
        Verdict("stable", *_stable(plan)),
        Verdict("within limits", *_within_limits(plan)),
        Verdict("within the wall", *_within_wall(plan)),
        Verdict(SURVIVES, *_survives(plan)),
    )


def largest_e3(free: float, cost: float) -> float:
    """What e3 may be at most, mm, where it is free without the wall and clearance may cost this part of it."""
    return math.inf if math.isinf(cost) else (1 + cost) * free + ROUNDING


Judgement = tuple[str, float | None, str, str]
"""Word, number, unit and sentence of a verdict."""


def _followed(plan: Record) -> Judgement:
    """Whether every frame was solved and has a shape, and clearance raised e3 by no more than it may; e3, mm."""
    frames, number = len(plan.time), e3(plan)
    interpolated = len(plan.meta.get("interpolated", []))
    unsolved, lost = int((~plan.success).sum()) - interpolated, int((~plan.reached).sum())
    if unsolved:
        return NO, number, "mm", f"{unsolved} of {frames} frames were not solved."
    if lost:
        return NO, number, "mm", f"The robot's shape is not known in {lost} of {frames} frames."
    if interpolated:
        return NOT_KNOWN, number, "mm", f"{interpolated} of {frames} frames were interpolated, not solved."
    planned = load_of(plan.meta, "planned_load")
    without = " without a load" if plan.bears else ""
    on = f" on the {plan.meta['model']} model" + (without if planned is None else f" under {planned}")
    on = "" if plan.as_planned and planned is None else on
    told = f"All {frames} frames were solved{on}"
    if plan.free is None or number is None:
        return YES, number, "mm", f"{told}."
    free, cost = plan.meta["e3_free"], float(_option(plan, "clearance_cost"))
    if free is None:
        return NOT_KNOWN, number, "mm", f"{told}; how large e3 would be without the wall is not known."
    here = f"on the {plan.evaluated} one " if plan.evaluated != plan.meta["model"] else ""
    here = here if plan.bears in (None, planned) else f"under {plan.bears} "
    growth = number / free - 1 if number > free > 0 else 0.0
    allowed = "" if math.isinf(cost) else f", {100 * cost:g}% is allowed"
    told += f"; {here}the wall makes e3 {growth:.1%} larger than {free:.3g} mm{allowed}."
    return YES if number <= largest_e3(free, cost) else NO, number, "mm", told


def _stable(plan: Record) -> Judgement:
    """Whether the robot never snaps on the elastic model; the least margin at frames and between them."""
    if not plan.can_snap:
        return NOT_ASKED, None, "", f"The {plan.evaluated} model knows no snaps."
    margins, snaps = np.minimum(plan.stability, plan.stability_between), plan.meta.get("snaps", [])
    known = np.isfinite(margins)
    least = float(margins[known].min()) if known.any() else None
    bears = "" if plan.bears is None else f" under {plan.bears}"
    if snaps:
        more = f", and {len(snaps) - 1} times more" if len(snaps) > 1 else ""
        return NO, least, "", f"The robot snaps{bears} on the way to frame {snaps[0]['frame']}{more}."
    if least is not None and least <= 0:
        return NO, least, "", f"The robot is unstable in frame {np.nanargmin(margins) + 1} or on the way to it."
    if least is not None and least <= FORK:
        where = np.nanargmin(margins) + 1
        return NO, least, "", f"The robot passes a fork around frame {where}, and chance decides the way it takes."
    if plan.bears is not None and not plan.bears.conservative:
        load = "a load with a moment, or with a force that turns with the tip, has no energy"
        return NOT_KNOWN, least, "", f"The robot does not snap, but {load}, and so no margin."
    if not known.all():
        return NOT_KNOWN, least, "", f"The stability margin is not known in {(~known).sum()} frames."
    where = margins.argmin() + 1
    return YES, least, "", f"The robot does not snap{bears}; its margin is least around frame {where}."


def _within_limits(plan: Record) -> Judgement:
    """Whether positions, their order, carriages, speeds and accelerations are allowed; the largest part used."""
    if not plan.reached.any():
        return NOT_KNOWN, None, "of a limit", "No frame was reached."
    most = most_used(plan)
    if most is None:
        return YES, 0.0, "of a limit", "The robot does not move."
    if not most.exceeded:
        return YES, most.part, "of a limit", f"No limit is exceeded; the {most.what} uses most of its own."
    hint = "acceleration" in most.what and "horizon" not in plan.meta["formulation"]
    told = f"The {most.what} exceeds what is allowed" + "; only a horizon keeps accelerations" * hint
    return NO, most.part, "of a limit", f"{told}."


def _within_wall(plan: Record) -> Judgement:
    """Whether no place of the robot is further beyond the lumen's wall than allowed; the deepest contact, mm."""
    if plan.clearance is None:
        return NOT_ASKED, None, "mm", "No wall of a lumen is known."
    deep, allowed = depth(plan), float(_option(plan, "contact_allowed"))
    known = np.isfinite(deep)
    if not known.any():
        return NOT_KNOWN, None, "mm", "No frame was reached."
    deepest, frame = float(deep[known].max()), int(np.nanargmax(deep)) + 1
    told = f"The deepest contact is in frame {frame}" if deepest > 0 else "The robot does not touch the wall"
    if not _option(plan, "contact_weight"):
        return NOT_ASKED, deepest, "mm", f"{told}; the wall was not to count."
    if deepest > allowed:
        return NO, deepest, "mm", f"{told}; {allowed:g} mm is allowed."
    if not known.all():
        return NOT_KNOWN, deepest, "mm", f"{told}, of those reached; {(~known).sum()} were not."
    return YES, deepest, "mm", f"{told}; {allowed:g} mm is allowed."


def _survives(plan: Record) -> Judgement:
    """Whether hardly any of the robots drawn within the tolerances is lost; the share of those that are.

    On a model that knows no snaps no robot can be lost, which says nothing about real ones.
    """
    if plan.drawn is None:
        return NOT_ASKED, None, "", "Only tubes exactly as described were looked at."
    if not plan.can_snap:
        told = f"The {plan.evaluated} model knows no snaps, so that none of its draws can be lost"
        return NOT_KNOWN, None, "", f"{told}; `ctr-nlp robust --evaluate elastic` moves robots that can be."
    told, force = plan.drawn.told, plan.robot.tolerances.tip_force
    told += f" A force of {force:g} N acts at the tip of each, in a direction of its own." if force else ""
    if plan.drawn.share <= plan.options.get("most_lost", MOST_LOST):
        return YES, plan.drawn.share, "of draws", told
    hint = "" if "certificate" in plan.meta else " `ctr-nlp plan --robust` plans for them."
    return NO, plan.drawn.share, "of draws", told + hint


def _option(plan: Record, name: str) -> Any:
    """What was asked for, or by default is, where a plan was made before there was such an option."""
    return plan.options.get(name, Settings().options()[name])
