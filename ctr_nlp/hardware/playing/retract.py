"""Retraction of the tubes after a stop: along the path they came, or innermost first without a journal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Standing
from ctr_nlp.hardware.motion.trajectory import (
    Trajectory,
    digests,
    scale_robot_speeds,
    trajectory_along,
    trajectory_through,
)
from ctr_nlp.hardware.playing.checks import check_trajectory
from ctr_nlp.hardware.playing.playback import Seen
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.results import PlaybackOutcome, Result
from ctr_nlp.hardware.playing.session import (
    RETRACTED,
    catch_stop,
    check_trusted,
    connect_player,
    find_program_record,
    locate_on_path,
    rebuild_corrected_trajectory,
    session_of,
)
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array


@catch_stop
def retract(
    player: Player,
    plan: Plan,
    hardware: Hardware,
    records: list[dict[str, Any]] | None,
    *,
    verified: bool = False,
    callback: Seen | None = None,
) -> Result:
    """Pull the tubes of a plan's robot back, at the speed of an approach.

    player: not connected yet. hardware: as played. records: of the journal of the session that brought the tubes
    where they are, None where there is none. A device that still moves is stopped first. verified: a person has
    checked that the axes are where the device says. callback: called with the trajectory and the progress every
    few ms. Raises TrajectoryError where the robot does not stand on that path, or the return does not pass its
    check.
    """
    if records is not None:
        check_trusted(records, verified)
    session = "" if records is None else session_of(records)
    standing = connect_player(player, verified=verified, stop_first=True, session=session)
    if records is None:
        returns = [innermost_first(plan, hardware, standing.position, player.tilt())]
    else:
        returns = return_path(plan, hardware, records, standing, player.device.resolution)
    for part in returns:
        check_trajectory(part, plan.evaluated_model)
    player.journal.record(RETRACTED, ways=len(returns))
    for part in returns:
        result = player.play(part, callback)
        if result.outcome is not PlaybackOutcome.SUCCESS:
            return result
    # The player counts the frames of the last part, which are none of the plan's.
    where = (
        "all tubes are retracted" if records is None else "the tubes are back where they stood before the session"
    )
    return replace(result, frame=0, message=where)


def return_path(
    plan: Plan, hardware: Hardware, records: list[dict[str, Any]], standing: Standing, resolution: Array
) -> list[Trajectory]:
    """Return the path of a session backwards: to its first frame, then to where the axes stood before it.

    plan, hardware: as played. records: of the session's journal. standing: of the axes now. resolution (m,): of
    the axes, in their units.
    """
    told = find_program_record(records)
    trajectory = rebuild_corrected_trajectory(plan, hardware, records)
    home = np.array(told["standing"])
    first = trajectory.positions(0.0)
    theta = trajectory.motion.path(trajectory.knots[0])[-2:]
    if _between(home, first, standing.position, hardware.tolerance):
        return [_straight(trajectory, standing.position, home, theta)]
    s = locate_on_path(trajectory, standing, resolution, int(trajectory.frames[0]))
    return [_backwards(trajectory, s), _straight(trajectory, first, home, theta)]


def _between(start: Array, end: Array, position: Array, tolerance: Array) -> bool:
    """Return whether position (m,) lies on the straight line from start to end (m,), within tolerance (m,)."""
    line = (end - start) / tolerance
    gone = (position - start) / tolerance
    part = np.clip(line @ gone / np.maximum(line @ line, 1e-12), 0.0, 1.0)
    return bool(abs(gone - part * line).max() <= 1.0)


def _backwards(trajectory: Trajectory, s: float) -> Trajectory:
    """Return the way from parameter s of a trajectory back to its first frame, on the same path."""
    knots = np.append(trajectory.knots[trajectory.knots < s], s)

    def reversed_in_time(curve: CubicHermiteSpline) -> CubicHermiteSpline:
        return CubicHermiteSpline(s - knots[::-1], curve(knots)[::-1], -curve(knots, 1)[::-1])

    path = reversed_in_time(trajectory.motion.path)
    lash = reversed_in_time(trajectory.lash)
    robot = scale_robot_speeds(trajectory.robot, trajectory.hardware.approach)
    return trajectory_along(
        robot, trajectory.hardware, path, lash, s - knots[::-1], np.arange(len(knots)), trajectory.digests, 1.0
    )


def _straight(trajectory: Trajectory, start: Array, end: Array, theta: Array) -> Trajectory:
    """Return the straight line from positions start (m,) of the axes to end (m,), at a tilt theta (2,) rad."""
    q = trajectory.hardware.joints(trajectory.robot, np.stack([start, end]), theta)
    return trajectory_through(trajectory.robot, trajectory.hardware, q, trajectory.digests)


def innermost_first(plan: Plan, hardware: Hardware, position: Array, theta: Array) -> Trajectory:
    """Return the retraction without turning: innermost tube into the next, both into the next, and all in.

    plan: whose robot it is. hardware: which is moved. position: (m,) of the axes, in their units. theta: tilt (2,)
    rad. Raises TrajectoryError where the tubes are retracted already.
    """
    robot = hardware.apply_limits(plan.robot)
    steps = [hardware.joints(robot, position, theta)]
    least = robot.split(robot.lower)[1]
    for length in [*robot.split(steps[0])[1][-2::-1], 0.0]:
        pulled = steps[-1].copy()
        beta = robot.split(pulled)[1]
        beta[:] = np.maximum(np.minimum(beta, length), least)
        if abs(pulled - steps[-1]).max() > 1e-6:
            steps.append(pulled)
    if len(steps) == 1:
        raise TrajectoryError("all tubes are retracted already")
    return trajectory_through(robot, hardware, np.stack(steps), digests(plan, hardware))
