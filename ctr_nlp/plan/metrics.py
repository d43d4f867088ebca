"""Numbers of a plan: by frame (errors.csv), and in summary (summary.json).

Errors are those of section IV of the paper: e1 between points at equal sigma, e2 its root mean square over a
shape, eq. (8), e3 the root mean square and e4 the median of e2 over frames.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.measures import (
    arrival,
    contact_depths,
    contacts,
    e1,
    e3,
    largest_error,
    nearest_target_distances,
    rate_parts,
    rms_over_sigma,
    tip_angle,
)
from ctr_nlp.plan.measures import root_mean_square as root_mean_square
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.plan.sample_outcomes import sample_summary
from ctr_nlp.plan.verdicts import verdicts
from ctr_nlp.support.flag_runs import find_flag_runs
from ctr_nlp.typing import Array

SAMPLE_E2_COLUMNS = "e2_draws_median", "e2_draws_95"
"""Columns of plans with simulated robots: median and 95 % quantile of their e2."""
BINDS = 0.005
"""The stability constraint counts as active where the margin exceeds the one asked for by less than this."""


def by_frame(plan: PlanData) -> dict[str, Array]:
    """Return the errors of a plan by frame, the columns of errors.csv.

    Parameters
    ----------
    plan : Plan
        The plan, T frames.

    Returns
    -------
    dict of str to ndarray
        Columns (T,): ``frame`` (from 1), ``time`` (s), ``e2``, ``max`` and ``tip`` (root mean square, maximum and
        last of e1, mm), ``nearest`` and ``nearest_max`` (root mean square and maximum of the distance to the
        nearest point of the target, mm), ``tip_angle`` (rad), ``success``; where known ``stability``,
        ``stability_between``, ``clearance`` and ``clearance_between`` (the least over sigma, at the frame and on
        the way to it, mm, negative in contact), ``e2_draws_median`` and ``e2_draws_95`` (mm).

    Raises
    ------
    OptionError
        `plan` is no plan.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant")
    >>> ctr.by_frame(plan)["frame"]
    array([1, 2, 3])
    """
    if not isinstance(plan, PlanData):
        raise OptionError(f"plan is {plan!r:.80}; it must be a Plan")
    distance = e1(plan)
    near = nearest_target_distances(plan)
    has_margins = np.isfinite(plan.stability).any()
    return {
        "frame": np.arange(1, len(plan.time) + 1),
        "time": plan.time,
        "e2": rms_over_sigma(distance),
        "max": distance.max(axis=1),
        "tip": distance[:, -1],
        "nearest": rms_over_sigma(near),
        "nearest_max": near.max(axis=1),
        "tip_angle": tip_angle(plan),
        **({"stability": plan.stability, "stability_between": plan.stability_between} if has_margins else {}),
        **({} if plan.clearance is None else {"clearance": plan.clearance.min(axis=1)}),
        **({} if plan.clearance_between is None else {"clearance_between": plan.clearance_between.min(axis=1)}),
        **(
            {}
            if plan.drawn is None
            else dict(zip(SAMPLE_E2_COLUMNS, plan.drawn.e2_quantiles(0.5, 0.95), strict=True))
        ),
        "success": plan.success.astype(int),
    }


def bound_by_stability(plan: PlanData) -> list[tuple[int, int]]:
    """Find the parts of a motion in which the constraint on the stability margin is active.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    list of (int, int)
        First and last frame of each part, from 1; empty where the plan is evaluated on another model than it was
        planned on.
    """
    margin = plan.options.get("stability_margin")
    if margin is None or not plan.as_planned or not np.isfinite(plan.stability).any():
        return []
    # fmin ignores NaN: one of both margins is enough.
    bound = np.fmin(plan.stability, plan.stability_between) < margin + BINDS
    return [(first + 1, stop) for first, stop in find_flag_runs(bound)]


def missed_margin(plan: PlanData) -> tuple[int, float] | None:
    """Find the sub-steps between frames in which a plan violates the stability margin most.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    tuple of (int, float) or None
        The frame after these sub-steps, from 1, and the margin there; None where the margin is satisfied.
    """
    margin = plan.options.get("stability_margin")
    found = plan.stability_between
    if margin is None or not plan.as_planned or not np.isfinite(found).any():
        return None
    if np.nanmin(found) >= margin - 2 * BINDS:
        return None
    frame = int(np.nanargmin(found))
    return frame + 1, float(found[frame])


def summary(plan: PlanData) -> dict[str, Any]:
    """Return the numbers of a plan, the content of summary.json.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    dict
        Errors in mm over frames whose shape is known (``e3``, ``e4``, ``e_max``, ``tip_last`` and others), the
        motion (``roughness`` in mm^2/s, ``max_step``), margins, contacts, times, failures, ``verdicts``, and how
        the plan was made. Numbers that do not exist, as where no frame was solved, are None (JSON has no NaN).

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> plan = ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant")
    >>> numbers = ctr.summary(plan)
    >>> numbers["frames"], numbers["failed"]
    (3, 0)
    """
    columns = by_frame(plan)
    known = np.isfinite(columns["e2"])
    rms = columns["e2"][known]
    steps = np.diff(plan.q[known], axis=0)
    robot = plan.robot
    seconds = plan.solve_time[np.isfinite(plan.solve_time)]
    largest = np.abs(steps).max(axis=0, initial=0.0)
    alpha, beta, theta = robot.split(largest)
    end = arrival(plan)
    worst = largest_error(plan)
    return {
        "e3": e3(plan),
        "e3_free": plan.meta.get("e3_free"),
        "e4": _number(np.median(rms) if rms.size else np.nan),
        "e_max": _number(columns["max"][known].max(initial=-np.inf)),
        "tip_max": _number(columns["tip"][known].max(initial=-np.inf)),
        "tip_last": None if end is None else end.distance,
        "tip_angle_last_deg": None if end is None else end.angle_deg,
        "short": None if end is None else end.short,
        "e2_max": None if worst is None else worst.e2,
        "e2_max_frame": None if worst is None else worst.frame,
        "tip_angle_max_deg": _number(np.degrees(columns["tip_angle"][known].max(initial=-np.inf))),
        "nearest_max": _number(columns["nearest_max"][known].max(initial=-np.inf)),
        # The motion term of eq. (9) without lambda, as an integral over time: sum |W dq|^2 / dt.
        "roughness": _number(((steps * robot.mm_per_unit) ** 2).sum() / plan.dt),
        "max_step": {"alpha": float(alpha.max()), "beta": float(beta.max()), "theta": float(theta.max())},
        "acceleration_used": float(rate_parts(plan, 2).max(initial=0.0)),
        "stability_min": _least(plan.stability),
        "stability_between_min": _least(plan.stability_between),
        "stability_binds": bound_by_stability(plan),
        "stability_missed": missed_margin(plan),
        "snaps": plan.meta.get("snaps", []),
        "clearance_min": None if plan.clearance is None else _least(plan.clearance),
        "clearance_between_min": None if plan.clearance_between is None else _least(plan.clearance_between),
        "contact_depth": None if plan.clearance is None else float(np.nansum(contact_depths(plan))),
        "contacts": [contact._asdict() for contact in contacts(plan)],
        "wall_forces": _wall_forces(plan),
        "solve_ms": {
            "median": _number(1e3 * np.median(seconds) if seconds.size else np.nan),
            "p99": _number(1e3 * np.quantile(seconds, 0.99) if seconds.size else np.nan),
            "total": _number(1e3 * plan.meta.get("solve_s", seconds.sum())),
        },
        "objective": _number(plan.objective.mean()),
        "search_s": plan.meta.get("search_s"),
        "build_s": plan.meta.get("build_s"),
        "frames": len(plan.time),
        "failed": int((~plan.success).sum()),
        "interrupted": bool(plan.meta.get("interrupted", False)),
        "kkt_max": _number(plan.kkt[plan.success].max(initial=-np.inf)),
        "weights": {
            "motion_s2": plan.options.get("motion_weight"),
            "contact_mm": plan.meta.get("contact_weight"),
            "angle_mm_per_rad": float(robot.mm_per_unit[0]),
        },
        "robustness": None if plan.drawn is None else plan.drawn.summary() | sample_summary(plan),
        "verdicts": {name: verdict._asdict() for name, verdict in verdicts(plan)._asdict().items()},
        "problem": plan.meta["problem"]["name"],
        "formulation": plan.meta.get("formulation"),
        "model": plan.meta["model"],
        "evaluated": plan.evaluated_model_name,
        "load": None if plan.evaluated_load is None else str(plan.evaluated_load),
        "solver": plan.meta.get("solver"),
        "direction": plan.options.get("direction"),
        "smoothing_deviation": plan.meta["problem"].get("deviation"),
        "smoothing_share": plan.meta["problem"].get("deviation_share"),
    }


def _wall_forces(plan: PlanData) -> dict[str, Any] | None:
    """Return the numbers on a plan whose robot leans on a wall; None for others."""
    if plan.wall_force is None or plan.place_force is None or plan.place_force_between is None:
        return None
    assert plan.stability_without_wall is not None
    return dict(plan.meta["wall_contact"]) | {
        "largest_at_a_place_N": _number(np.nanmax(np.fmax(plan.place_force, plan.place_force_between))),
        "largest_total_N": _number(np.nanmax(plan.wall_force.sum(axis=1))),
        "place_N": [_number(each) for each in plan.place_force],
        "total_N": [_number(each) for each in plan.wall_force.sum(axis=1)],
        "stability_without_wall_min": _least(plan.stability_without_wall),
        "snaps_without_wall": bool(np.isnan(plan.stability_without_wall).any()),
    }


def verdict_columns(plan: PlanData) -> dict[str, str]:
    """Return the verdicts of a plan as columns of a table, ``verdict_solved`` and so on.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    dict of str to str
        ``"yes"``, ``"no"`` or ``"NOT CHECKED"`` by column.
    """
    return {f"verdict_{name}": verdict.word for name, verdict in verdicts(plan)._asdict().items()}


def _least(values: Array) -> float | None:
    """Return the least finite value; None where there is none."""
    known = values[np.isfinite(values)]
    return float(known.min()) if known.size else None


def _number(value: Any) -> float | None:
    """Return a value as a float; None where it is not finite."""
    return float(value) if np.isfinite(value) else None
