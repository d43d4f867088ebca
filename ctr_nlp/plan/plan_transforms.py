"""Plans made of plans: slices, reversed, joined and resampled ones.

Failures and snaps are kept under new frame numbers. Where the motion changes, it is simulated again: on the
elastic model the shape in a frame depends on the motion before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.loads import require_constant_load
from ctr_nlp.plan.motion_evaluation import describe_branch_failures, e3_of, evaluate_motion, free_errors
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.support.value_checks import number, whole_number
from ctr_nlp.support.value_objects import equal
from ctr_nlp.typing import Array, Flags

AnyPlan = TypeVar("AnyPlan", bound=PlanData)

META_ENTRIES_BY_FRAME = "failures", "fallbacks"
"""Entries of meta whose keys are numbers of frames, from 1."""
NON_FRAME_PLAN_FIELDS = "meta", "to_robot", "lumen", "walls", "drawn"
"""Fields that are not one row a frame."""
STRICTEST = {"contact_allowed": min, "contact_weight": max}
"""Options that verdicts use, and the function that chooses the stricter of two values for a joined plan."""
JOINED_SHAPE_TOLERANCE_MM = 0.01
"""mm by which a shape may differ from the one planned before the robot counts as on another branch."""
WHOLE_FRAME = 1e-9
"""Resampled positions, in frames, are rounded to a whole frame that is nearer than this part of the motion."""


def per_frame_arrays(plan: PlanData) -> dict[str, Any]:
    """Return the arrays of a plan that have one row for each frame, by name."""
    named = {f.name: getattr(plan, f.name) for f in fields(plan) if f.name not in NON_FRAME_PLAN_FIELDS}
    return {name: array for name, array in named.items() if array is not None}


def slice_plan(plan: AnyPlan, frames: slice) -> AnyPlan:
    """Return some frames of a plan, a slice first:stop counted from 0, as a plan with the same dt.

    The sub-steps to the first of them count as before, with their margin and snap. Raises OptionError where there
    are no such frames.
    """
    count = len(plan.time)
    chosen = range(count)[frames] if isinstance(frames, slice) else range(0)
    if not chosen or chosen.step != 1:
        raise OptionError(f"frames of a plan are {frames!r}; give [first:stop] within 0 and {count}")
    if len(chosen) == count:
        return plan
    require_constant_load(plan.evaluated_load, "a part of a plan")
    first = chosen.start
    stop = chosen.stop
    kept = {name: array[first:stop] for name, array in per_frame_arrays(plan).items()}
    kept["time"] = plan.dt * np.arange(1.0, len(chosen) + 1)
    meta: dict[str, Any] = dict(plan.meta) | {
        name: _shift_frame_numbers(plan.meta[name], -first, len(chosen))
        for name in META_ENTRIES_BY_FRAME
        if name in plan.meta
    }
    meta["snaps"] = [
        {**snap, "frame": snap["frame"] - first}
        for snap in plan.meta.get("snaps", [])
        if first < snap["frame"] <= stop
    ]
    # Simulated as a whole and then cut: a motion that begins in its middle might be on another branch.
    free = free_errors(Simulator(plan.robot, plan.evaluated_model), plan.free, plan.target)
    meta["e3_free"] = e3_of(None if free is None else free[first:stop], plan.reached_frames[first:stop])
    meta["stretch"] = {"first": first + 1, "last": stop, "of": count}
    meta["interpolated"] = [j - first for j in plan.meta.get("interpolated", []) if first < j <= stop]
    return replace(plan, **kept, meta=meta | _retime_problem(meta, len(chosen), plan.dt), drawn=None)


def reverse_plan(plan: AnyPlan) -> AnyPlan:
    """Return a plan in the reverse order of frames, with the same dt.

    Parameters
    ----------
    plan : Plan
        The plan to play backwards.

    Returns
    -------
    Plan
        The retraction; simulated robots are left out, since theirs is another motion.

    Raises
    ------
    LoadError
        The plan was evaluated under a load that changes over time.
    """
    require_constant_load(plan.evaluated_load, "a plan that is played backwards")
    back = {name: array[::-1] for name, array in per_frame_arrays(plan).items() if name != "time"}
    for own in ("stability", "clearance", "wall_clearance", "place_force"):
        between = f"{own}_between"
        if own in back and between in back:
            # Entry j of the forward motion is the least on the way from frame j - 1 to j, which the reverse motion
            # passes on its way from j to j - 1. Nothing leads to its first frame: only the frame itself counts
            # there.
            back[between] = np.concatenate([back[own][:1], back[between][:-1]])
    count = len(plan.time) + 1  # frame j, from 1, becomes frame count - j
    meta: dict[str, Any] = {
        name: {key if key == "all" else str(count - int(key)): why for key, why in plan.meta[name].items()}
        for name in META_ENTRIES_BY_FRAME
        if name in plan.meta
    }
    if "interpolated" in plan.meta:
        meta["interpolated"] = [count - j for j in reversed(plan.meta["interpolated"])]
    # A snap on the way to frame j is on the way to what is now the frame after; none leads to the first frame.
    snaps = [{**snap, "frame": count - snap["frame"] + 1} for snap in reversed(plan.meta.get("snaps", []))]
    meta["snaps"] = [snap for snap in snaps if snap["frame"] <= len(plan.time)]
    return replace(
        plan, meta=plan.meta | meta | {"reversed": not plan.meta.get("reversed", False)}, drawn=None, **back
    )


def join_plans(plan: AnyPlan, other: PlanData) -> AnyPlan:
    """Join a plan and another one of the same robot, dt, model and lumen.

    The whole motion is simulated: frames in which the robot does not reach the shapes of the other plan are marked
    as not solved. The step from the last frame of one to the first of the other counts as any other; its size is
    in meta, under joined. Options are those of the first, and the stricter ones for verdicts.

    Parameters
    ----------
    plan : Plan
        The first part of the motion.
    other : Plan
        The second part.

    Returns
    -------
    Plan
        Both parts, with the frames of each.

    Raises
    ------
    OptionError
        `other` is no plan, or its robot, dt, model or lumen differs.
    LoadError
        The first plan was evaluated under a load that changes over time.
    """
    if not isinstance(other, PlanData):
        raise OptionError(f"a plan is joined with {other!r:.80}; give another Plan")
    _check_joinable(plan, other)
    require_constant_load(plan.evaluated_load, "a plan that is joined with another one")
    first = per_frame_arrays(plan)
    second = per_frame_arrays(other)
    count = len(plan.time)
    both = {name: np.concatenate([first[name], second[name]]) for name in first if name in second}
    both["time"] = plan.dt * np.arange(1.0, len(both["time"]) + 1)
    absent = {name: None for name in (*first, *second) if name not in both}
    q = np.concatenate([plan.q, other.q])
    simulator = Simulator(plan.robot, plan.evaluated_model)
    found = evaluate_motion(simulator, q, target=both["target"], wall=plan.wall, free=both.get("free"))
    apart = np.linalg.norm(found.arrays["shape"] - both["shape"], axis=-1).max(axis=1)
    # Negated, so that a simulated shape that is NaN counts as another one.
    away = np.isfinite(both["shape"]).all(axis=(1, 2)) & ~(apart < JOINED_SHAPE_TOLERANCE_MM)
    alpha, beta, theta = plan.robot.split(np.abs(other.q[0] - plan.q[-1]))
    meta: dict[str, Any] = dict(plan.meta) | found.metadata
    for name in META_ENTRIES_BY_FRAME:
        meta[name] = {**plan.meta.get(name, {}), **_shift_frame_numbers(other.meta.get(name, {}), count, len(q))}
    meta["failures"] = describe_branch_failures(both["success"] & away, found.simulation.snaps) | meta["failures"]
    both["success"] = both["success"] & ~away
    meta["joined"] = {
        "frames": [count, len(other.time)],
        "problems": [each.meta["problem"]["name"] for each in (plan, other)],
        "step": {"alpha": alpha.max(), "beta": beta.max(), "theta": theta.max()},
    }
    meta["interrupted"] = any(each.meta.get("interrupted", False) for each in (plan, other))
    meta["options"] = plan.options | {
        name: judge(plan.options[name], other.options[name])
        for name, judge in STRICTEST.items()
        if name in plan.options and name in other.options
    }
    later = [j + count for j in other.meta.get("interpolated", [])]
    meta["interpolated"] = [*plan.meta.get("interpolated", []), *later]
    return replace(
        plan, **(both | absent | found.arrays), meta=meta | _retime_problem(meta, len(q), plan.dt), drawn=None
    )


def resample_plan(plan: AnyPlan, frames: int | None = None, dt: float | None = None) -> AnyPlan:
    """Interpolate a plan between its first and last frame, which stay.

    Configurations and targets are interpolated linearly, and the new motion is simulated. A frame keeps its
    success, objective, KKT residual and time only where it is a frame of the plan and all frames left out before
    it were solved; the others are listed in meta under interpolated.

    Parameters
    ----------
    plan : Plan
        The plan to interpolate.
    frames : int, optional
        Number of frames.
    dt : float, optional
        Time from frame to frame in s, in place of `frames`.

    Returns
    -------
    Plan
        The interpolated motion, simulated anew.

    Raises
    ------
    OptionError
        Neither or both of `frames` and `dt` are given, or one is not what it must be.
    """
    at = _resampled_positions(plan, frames, dt)
    low = np.minimum(np.floor(at).astype(int), len(plan.time) - 2)
    part = at - low
    own = np.isin(at, np.round(at))
    between = {
        name: _interpolate_rows(array, low, part)
        for name, array in per_frame_arrays(plan).items()
        if name != "success"
    }
    for name in ("objective", "kkt", "solve_time"):
        between[name] = np.where(own, between[name], np.nan)
    between["target_direction"] /= np.linalg.norm(between["target_direction"], axis=1, keepdims=True)
    step = plan.dt * (len(plan.time) - 1) / (len(at) - 1)
    between["time"] = step * np.arange(1.0, len(at) + 1)
    q = np.hstack([between["alpha"], between["beta"], between["theta"]])
    target = between["target"]
    free = between.get("free")
    found = evaluate_motion(
        Simulator(plan.robot, plan.evaluated_model), q, target=target, wall=plan.wall, free=free
    )
    fine = _solved_around(plan, at)
    success = own & fine & plan.success[at.astype(int)]
    failures = {
        str(j + 1): f"interpolated from frame {u + 1:.4g} of a plan, not solved"
        if fine[j]
        else f"around frame {u + 1:.4g} of the plan that this was made of, frames were not solved"
        for j, u in enumerate(at.tolist())
        if not success[j]
    }
    meta = dict(plan.meta) | found.metadata | {"failures": failures, "fallbacks": {}}
    meta["interpolated"] = (np.flatnonzero(fine & ~success) + 1).tolist()
    meta["resampled"] = {"frames": len(plan.time), "dt": plan.dt}
    arrays = between | found.arrays | {"success": success}
    return replace(plan, **arrays, meta=meta | _retime_problem(meta, len(at), step), drawn=None)


def _solved_around(plan: PlanData, at: Array) -> Flags:
    """Return for each new position (n,) whether all frames beside it and left out before it were solved.

    Frames that were interpolated already count as solved. at: (n,), positions in frames of the plan, from 0.
    """
    fine = plan.success.copy()
    fine[[j - 1 for j in plan.meta.get("interpolated", [])]] = True
    low = np.floor(at).astype(int)
    first = np.minimum(np.append(0, low[:-1] + 1), low)
    return np.array([fine[a : b + 1].all() for a, b in zip(first, np.ceil(at).astype(int), strict=True)])


def _resampled_positions(plan: PlanData, frames: int | None, dt: float | None) -> Array:
    """Return positions (n,) of new frames, in frames of a plan from 0; either `frames` or `dt`, s, is given."""
    span = len(plan.time) - 1
    if (frames is None) == (dt is None):
        raise OptionError(f"frames is {frames!r} and dt {dt!r}; give one of them")
    if span < 1:
        raise OptionError("a plan of one frame has no motion to resample")
    if dt is not None:
        seconds = span * plan.dt
        number(OptionError, "dt", dt, lambda x: 0 < x <= seconds * (1 + 1e-9), f"lie in (0, {seconds:g}]", " s")
        steps = max(1, round(seconds / dt))
        if abs(steps * dt - seconds) > 1e-6 * plan.dt:
            raise OptionError(
                f"dt is {dt:g} s; the {seconds:g} s from the first frame to the last must be a multiple of it, as "
                f"of {seconds / steps:g} s"
            )
        frames = steps + 1
    at = np.linspace(0.0, span, whole_number(OptionError, "frames", frames, 2))
    return np.where(np.abs(at - np.round(at)) < WHOLE_FRAME * span, np.round(at), at)


def _interpolate_rows(array: Array, low: Any, part: Array) -> Array:
    """Interpolate the rows of an array (T, ...) at positions low + part (n,); exact where part is 0 or 1."""
    part = part.reshape(-1, *[1] * (array.ndim - 1))
    here = array[low]
    there = array[low + 1]
    # A row that is one of the given ones must not take NaN from the row beside it.
    return np.where(part == 0, here, np.where(part == 1, there, here + part * (there - here)))


def _check_joinable(plan: PlanData, other: PlanData) -> None:
    for name, one, two in (
        ("robot", plan.robot, other.robot),
        ("model", plan.meta["model"], other.meta["model"]),
        ("model that they are evaluated on", plan.evaluated_model_name, other.evaluated_model_name),
        ("load", plan.evaluated_load, other.evaluated_load),
        ("lumen", plan.lumen, other.lumen),
        ("walls", plan.walls, other.walls),
    ):
        if not equal(one, two):
            raise OptionError(f"the {name} of two plans to be joined differs; it must be the same")
    if abs(plan.dt - other.dt) > 1e-9 * plan.dt:
        raise OptionError(
            f"dt of two plans to be joined is {plan.dt:g} and {other.dt:g} s; it must be the same (resampled())"
        )


def _shift_frame_numbers(entries: Mapping[str, Any], by: int, count: int) -> dict[str, Any]:
    """Shift the frame numbers of entries of meta by `by`; keep those from 1 to `count`, and the entry "all"."""
    moved_on = {key if key == "all" else str(int(key) + by): why for key, why in entries.items()}
    return {key: why for key, why in moved_on.items() if key == "all" or 1 <= int(key) <= count}


def _retime_problem(meta: Mapping[str, Any], frames: int, dt: float) -> dict[str, Any]:
    return {"problem": {**meta["problem"], "frames": frames, "duration": frames * dt}}
