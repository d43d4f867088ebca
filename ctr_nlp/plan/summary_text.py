"""A plan's summary in words: its title, tables, and remarks on what is wrong with it.

`found` is the plan's summary throughout, the content of summary.json (plan/metrics.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ctr_nlp.plan.measures import describe_place, points_in_file
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES
from ctr_nlp.robot.tolerances import DEVIATION_NAMES, TOLERANCE_UNITS, Tolerances

VERDICTS = ("", "verdict", "value", "why")
"""Columns of the table of verdicts."""
NOT_FOR_PATIENTS = "Not validated for use on patients."
"""Warning wherever a plan is shown or exported."""
Row = tuple[str, Any, str]
"""Row of a table: name, value and unit."""

UNMET_VERDICT_WORDS = NO, NOT_CHECKED
"""Words of the verdicts that are not met."""
MAX_LISTED_FAILURES = 10
"""Largest number of failures listed one by one; the plan has them all."""


def title(found: dict[str, Any]) -> str:
    """Return a plan's title: problem, formulation, direction, model, solver, and the model of its evaluation.

    found: the plan's summary.
    """
    return f"{found['problem']}: {describe_method(found)}"


def headline(plan: Plan) -> str:
    """Return what a plan is about: its problem, where its path ends, and which robot is to go there."""
    # In the robot's base frame where there is no file.
    known = plan.meta["problem"].get("space") is not None
    end = points_in_file(plan, plan.target[-1, -1]) if known else plan.target[-1, -1]
    widths = ", ".join(f"{tube.outer_diameter:.2f}" for tube in plan.robot.tubes)
    tubes = f"{plan.robot.d} tubes of {widths}" if plan.robot.d > 1 else f"a tube of {widths}"
    return f"{plan.meta['problem']['name']}: to {describe_place(plan, end)}, with {tubes} mm"


def describe_method(found: dict[str, Any]) -> str:
    """Return how a plan was made: formulation, direction, model, solver, and the model of its evaluation.

    found: the plan's summary.
    """
    direction = "" if found["direction"] is None else f" ({found['direction']})"
    seen = "" if found["evaluated"] == found["model"] else f", judged on the {found['evaluated']} model"
    under = "" if found["load"] is None else f", under {found['load']}"
    how = f"{found['formulation']}{direction}, {found['model']} model, solver {found['solver']}"
    return f"{how}{seen}{under}"


def verdict_rows(found: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the table of verdicts of a plan's summary `found`: for each its name, word, figures and reason."""
    return [(each["matter"], each["word"], each["value"], each["why"]) for each in found["verdicts"].values()]


def describe_unmet_verdicts(found: Mapping[str, Any]) -> str:
    """Name the verdicts of a summary `found` that are *no* or were not checked; empty where all are *yes*."""
    return "; ".join(
        f"{word}: {', '.join(matters)}" for word in UNMET_VERDICT_WORDS if (matters := _verdict_names(found, word))
    )


def _verdict_names(found: Mapping[str, Any], word: str) -> list[str]:
    """Return the names of the verdicts in a summary that have a word."""
    return [each["matter"] for each in found["verdicts"].values() if each["word"] == word]


def summarise_verdicts(found: Mapping[str, Any]) -> str:
    """Sum up all verdicts of a plan's summary `found` in one or two sentences."""
    count = len(found["verdicts"])
    passed = len(_verdict_names(found, YES))
    no = _verdict_names(found, NO)
    unchecked = _verdict_names(found, NOT_CHECKED)
    told = []
    if no:
        told.append(f"This plan fails {len(no)} of {count} checks: {', '.join(no)}.")
    elif unchecked:
        told.append(f"This plan passes {passed} of {count} checks.")
    if unchecked:
        told.append(f"Not checked: {', '.join(unchecked)}.")
    return " ".join(told) or f"This plan passes all {count} checks."


def measure_rows(found: dict[str, Any]) -> list[Row]:
    """Return the rows of a table with the errors, margins and times of a plan's summary `found`; lengths in mm."""
    failed = found["failed"]
    solved = "given, not solved" if "solved" in _verdict_names(found, NOT_CHECKED) else "all solved"
    steps = " / ".join(map(format_cell, found["max_step"].values()))
    return [
        ("e3, RMS over frames of e2", found["e3"], "mm"),
        ("e4, median over frames of e2", found["e4"], "mm"),
        ("largest error, at equal arc length", found["e_max"], "mm"),
        ("largest distance to the target", found["nearest_max"], "mm"),
        ("tip error in the last frame", found["tip_last"], "mm"),
        ("tip direction in the last frame, off by", found["tip_angle_last_deg"], "°"),
        ("length of the robot less that of the path", _negative(found["short"]), "mm"),
        ("largest tip error", found["tip_max"], "mm"),
        ("largest step of alpha, beta, theta", steps, "rad / mm / rad"),
        *_stability(found),
        *_clearance(found),
        *_robustness(found),
        *_effort(found),
        ("frames", f"{found['frames']}, {f'{failed} not solved' if failed else solved}", ""),
    ]


def _negative(value: float | None) -> float | None:
    """Return the negative of a number, 0 without a sign; None for None."""
    return None if value is None else 0.0 - value


def remarks(plan: Plan, found: dict[str, Any]) -> list[str]:
    """Return sentences on active or exceeded limits, snaps, contacts and failures; none where all is well.

    plan: the plan. found: its summary.
    """
    snaps = [_snap(snap) for snap in found["snaps"]]
    told = [*_limits(plan, found), *snaps, *_contacts(plan, found), *_certificate(plan), *_failures(plan)]
    if plan.drawn is not None:
        # Who leaves the table out is judged by tolerances that were never stated.
        whose = " (the defaults; `[tolerances]` in a robot file sets others)"
        own = "" if plan.robot.tolerances != Tolerances() else whose
        within = _tolerances(plan, 1.0)
        told.append(f"simulated robots differ from the one described by up to: {within or 'nothing'}{own}")
    if "not_shared" in plan.meta:
        told.append(f"{plan.meta['not_shared']}: this is the plan for the robot as described alone")
    return told


def _snap(snap: Mapping[str, Any]) -> str:
    tubes = ", ".join(map(str, snap["tubes"]))
    if snap["jump"] is None:
        come = "where the robot comes to rest under the load is not known"
        return f"snap on the way to frame {snap['frame']}: tips of tubes {tubes} jump; {come}"
    return f"snap on the way to frame {snap['frame']}: tips of tubes {tubes} turn by {snap['jump']:.2f} rad"


def _limits(plan: Plan, found: dict[str, Any]) -> list[str]:
    told = []
    if found["acceleration_used"] > 1:
        told.append(f"the motion needs {found['acceleration_used']:.1f} times the acceleration that limits allow")
    if found["stability_binds"]:
        parts = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in found["stability_binds"])
        told.append(f"stability (margin {plan.meta['options']['stability_margin']:g}) limits frames {parts}")
    if found["stability_missed"]:
        frame, least = found["stability_missed"]
        told.append(f"the stability margin is too small between frames: {least:.3f} on the way to frame {frame}")
    return told


def _contacts(plan: Plan, found: dict[str, Any]) -> list[str]:
    told = []
    for contact in found["contacts"]:
        first = contact["first"]
        last = contact["last"]
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        told.append(
            f"contact in {frames}: tube {contact['tube']} by up to {contact['depth']:.2f} mm, "
            f"{contact['path']:.0f} mm along the path in frame {contact['frame']}"
        )
    if told and found["weights"]["contact_mm"] is None and plan.free is not None:
        told.append("this motion ignores the wall, since more frames failed with it")
    return told


def _certificate(plan: Plan) -> list[str]:
    """Return sentences on the certificate of a robust plan: how many robots pass, and where robots fail."""
    found = plan.meta.get("certificate")
    if found is None:
        return []
    told = []
    if "holds_at_least" in found:
        # Where hardly any sample holds the bound is 0 %, which says nothing.
        least = f"{100 * found['holds_at_least']:.1f}"
        bound = f" With 95 % confidence at least {least} % of all robots within the tolerances hold"
        told.append(f"certificate: {found['outcome']}{bound if float(least) else ''}".rstrip("."))
    if found["held"]:
        return told
    frames = ", ".join(f"{frame} ({count})" for frame, count in found["lost_in"].items())
    told.append(
        f"too many robots fail on this plan, the best one found: {found['lost']} of {found['draws']} new samples, "
        f"first in frames {frames}; at most {found['most_lost']:.2%} of all robots may fail"
    )
    if found["borne"]:
        told.append(f"the plan would hold with tolerances of {_tolerances(plan, found['borne'])}")
    return told


def _tolerances(plan: Plan, part: float) -> str:
    """Write the tolerances of a plan's robot, multiplied by `part`, in words; of each the largest of any tube."""
    robot = plan.robot
    told = list[str]()
    bands = part * robot.tolerances.bands(robot.tubes).max(axis=0)
    for name, band in zip(DEVIATION_NAMES, bands.tolist(), strict=True):
        value = f"{band:.2g}{TOLERANCE_UNITS[name]}" if name in TOLERANCE_UNITS else f"{100 * band:.3g} %"
        told += [f"{name.replace('_', ' ')} {value}"] if band else []
    lag = part * robot.tolerances.max_backlash(robot.d).max()
    force = part * robot.tolerances.tip_force
    told += [f"rotation lag {lag:.2g} rad"] if lag else []
    return ", ".join([*told, *([f"tip force {force:.2g} N"] if force else [])])


def _failures(plan: Plan) -> list[str]:
    reasons = list(plan.meta.get("failures", {}).items())
    told = [f"{'' if frame == 'all' else 'frame '}{frame} not solved: {why}" for frame, why in reasons]
    told[MAX_LISTED_FAILURES:] = [f"and {len(reasons) - MAX_LISTED_FAILURES} more"] * (
        len(reasons) > MAX_LISTED_FAILURES
    )
    if plan.meta.get("interrupted", False):
        told.append("interrupted: the plan holds what was solved until then")
    return told


def _stability(found: dict[str, Any]) -> list[Row]:
    """Return the row of the least stability margins; none where the model has no margins."""
    if found["stability_min"] is None:
        return []
    margins = f"{found['stability_min']:.3f} / {found['stability_between_min']:.3f}"
    return [("least stability margin, at and between frames", margins, "")]


def _clearance(found: dict[str, Any]) -> list[Row]:
    """Return the rows on clearance from the wall and contact; none where no wall is known."""
    if found["clearance_min"] is None:
        return []
    between = found["clearance_between_min"]
    both = f"{format_cell(found['clearance_min'])} / {NOT_CHECKED if between is None else format_cell(between)}"
    rows: list[Row] = [("least clearance from the wall, at and between frames", both, "mm")]
    if found["contacts"]:
        frames = sum(contact["last"] - contact["first"] + 1 for contact in found["contacts"])
        rows.append(
            ("frames in contact, and depths summed", f"{frames} / {format_cell(found['contact_depth'])}", "/ mm")
        )
    return rows


def _robustness(found: dict[str, Any]) -> list[Row]:
    """Return the rows on arrival, contact and error of the simulated robots; none where none were simulated."""
    drawn = found.get("robustness")
    if drawn is None:
        return []
    told = {
        "tip error in the last frame": drawn["tip_last"],
        "deepest contact": drawn["contact_deepest"],
        "e3": drawn["e3"],
    }
    return [
        (
            f"{name} of {drawn['draws']} samples, mean / median / 95 %",
            " / ".join(map(format_cell, each.values())),
            "mm",
        )
        for name, each in told.items()
        if each is not None
    ]


def _effort(found: dict[str, Any]) -> list[Row]:
    """Return the rows on solving time and, for a horizon, on the roughness of the motion."""
    times = found["solve_ms"]
    if times["median"] is not None:
        return [
            (
                "time a frame, median and 99 %",
                f"{format_cell(times['median'])} / {format_cell(times['p99'])}",
                "ms",
            )
        ]
    weight = found["weights"]["motion_s2"]
    if weight is None:
        return [("roughness", f"{found['roughness']:.0f}", "mm²/s")]
    rough = f"{found['roughness']:.0f} / {weight:.2g}"
    seconds = f"{format_cell(found['search_s'])} / {format_cell(times['total'] / 1e3)}"
    return [
        ("roughness, and its weight in the objective", rough, "mm²/s / s²"),
        ("time for the start, and for the horizon", seconds, "s"),
    ]


def format_cell(cell: Any) -> str:
    """Write a cell as text: numbers with three decimals, two above 1, one above 10; nothing for None."""
    if cell is None:
        return ""
    if isinstance(cell, float):
        return f"{cell:.{3 - (abs(cell) >= 1) - (abs(cell) >= 10)}f}"
    return str(cell)
