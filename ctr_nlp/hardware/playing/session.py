"""Sessions: check a plan, connect, go to the first frame and play; or resume where a session ended."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec

import numpy as np

from ctr_nlp.exceptions import DeviceFault, Stopped, TrajectoryError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Standing
from ctr_nlp.hardware.guiding.guide import SHARE
from ctr_nlp.hardware.guiding.loop import ClosedLoop
from ctr_nlp.hardware.motion.lookahead import FollowedPath
from ctr_nlp.hardware.motion.trajectory import Patch, Trajectory, approach_to, remaining_trajectory, trajectory_of
from ctr_nlp.hardware.playing.checks import TrajectoryCheck, check_plan, check_trajectory
from ctr_nlp.hardware.playing.playback import Seen
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState, Result
from ctr_nlp.hardware.playing.trust import DISTRUST_REMEDY
from ctr_nlp.models import Model
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

Playing = ParamSpec("Playing")

RETRACTED = "retraction"
"""Kind of the journal's record of a retraction, after which no earlier session can be resumed."""

ARM_START_TOLERANCE_RAD = 1e-4
"""rad by which the arm may be off the start of a trajectory without an approach."""


def prepare_trajectory(
    plan: Plan, hardware: Hardware, tempo: float = 1.0, standing: Array | None = None, share: float = 1.0
) -> tuple[Trajectory, TrajectoryCheck]:
    """Return the trajectory of a plan, and the result of checking all of it.

    hardware: on which it is played. tempo: part of the plan's pace, in (0, 1]. standing (m,): positions from which
    the axes come to the first frame. share: of the largest speeds and accelerations; the rest is left for
    corrections. Raises HardwareError, OptionError, TrajectoryError.
    """
    check_plan(plan, hardware.apply_limits(plan.robot))
    trajectory = trajectory_of(plan, hardware, tempo, standing, share)
    return trajectory, check_trajectory(trajectory, plan.evaluated_model)


def catch_stop(play: Callable[Playing, Result]) -> Callable[Playing, Result]:
    """Decorate a function so that an abort while the device is being connected is a result, too.

    play: the function, which may raise Stopped.
    """

    @wraps(play)
    def played(*arguments: Playing.args, **options: Playing.kwargs) -> Result:
        try:
            return play(*arguments, **options)
        except Stopped as stop:
            return stop.result

    return played


@catch_stop
def play_plan(
    player: Player,
    plan: Plan,
    hardware: Hardware,
    tempo: float = 1.0,
    *,
    home: bool = False,
    verified: bool = False,
    callback: Seen | None = None,
    loop: ClosedLoop | None = None,
) -> Result:
    """Play a plan from its first frame, to which the robot goes slowly and straight from where it stands.

    player: not connected yet. hardware: on which it is played. tempo: part of the plan's pace, in (0, 1]. home:
    let the device find its position before. verified: a person has checked that the axes are where the device
    says. callback: called with the trajectory and the progress every few ms. loop: what corrects the plan, None
    for nothing. Raises what prepare_trajectory raises before anything is sent, and DeviceFault where nothing could
    be started.
    """
    share = 1.0 if loop is None else SHARE
    trajectory, _ = prepare_trajectory(plan, hardware, tempo, share=share)
    if loop is not None:
        loop.open()
    standing = connect_player(player, home=home, verified=verified)
    # Which side of its play an axis lies against depends on where it comes from, known only now.
    if hardware.backlash.any():
        trajectory = trajectory_of(plan, hardware, tempo, standing.position, share)
        check_trajectory(trajectory, plan.evaluated_model)
    _announce(player, trajectory, tempo, standing.position, None, [])
    return _approach_and_play(player, trajectory, standing, plan.evaluated_model, callback, loop, plan.q[:0])


def connect_player(
    player: Player, *, home: bool = False, verified: bool = False, stop_first: bool = False, session: str = ""
) -> Standing:
    """Connect a player; raises DeviceFault unless the device, or a person for it, knows where it stands.

    home: let the device find its position. verified: a person has checked it. stop_first: stop a device that
    moves. session: name of the session that is to be resumed, "" for none. Raises Stopped, too.
    """
    standing = player.connect(stop_first, home, session)
    if verified:
        player.trust()
    if player.state is not PlayerState.HOMED:
        unhomed = "" if standing.homed else "the device does not know its position: home it first (--home)"
        raise DeviceFault("; ".join(filter(None, (unhomed, player.doubt))))
    return standing


@catch_stop
def resume(
    player: Player,
    plan: Plan,
    hardware: Hardware,
    records: list[dict[str, Any]],
    *,
    verified: bool = False,
    callback: Seen | None = None,
    loop: ClosedLoop | None = None,
) -> Result:
    """Continue a session (the records of its journal) where it ended, if the robot still stands on its path.

    player: not connected yet. hardware: as played. A device that still moves is stopped first. verified: a person
    has checked that the axes are where the device says. callback: called with the trajectory and the progress
    every few ms. loop: what corrects the rest, if that session was one of a closed loop, and None if not. Raises
    TrajectoryError where the plan or the position is another, or nothing is left.
    """
    if any(record["kind"] == RETRACTED for record in records):
        raise TrajectoryError("the tubes were retracted after that session: play the plan from its start")
    told = find_program_record(records)
    if (loop is not None) != is_closed_loop(told):
        raise TrajectoryError(
            "the journal's session was played with --closed-loop: resume it with --closed-loop, too"
            if is_closed_loop(told)
            else "the journal's session was played without --closed-loop: resume it without, too"
        )
    trajectory = rebuild_corrected_trajectory(plan, hardware, records)
    frame = last_passed(records)
    if frame < 1:
        raise TrajectoryError("the journal's session ended before its first frame: play the plan from its start")
    if frame == trajectory.frames[-1]:
        raise TrajectoryError(f"the journal's session reached frame {frame}, the last one: nothing is left")
    check_trusted(records, verified)
    if loop is not None:
        loop.open()
    standing = connect_player(player, verified=verified, stop_first=True, session=session_of(records))
    s = locate_on_path(trajectory, standing, player.device.resolution, frame)
    _announce(player, trajectory, told["tempo"], told["standing"], s, patches_of(records))
    rest, before = split_at_parameter(trajectory, s, told["tempo"])
    return _approach_and_play(player, rest, standing, plan.evaluated_model, callback, loop, before)


def split_at_parameter(trajectory: Trajectory, s: float, tempo: float) -> tuple[Trajectory, Array]:
    """Return the rest of a trajectory from its parameter s on, and q (n, 2d + 2) from its start to s.

    tempo: part of the plan's pace.
    """
    path = trajectory.motion.path
    passed = trajectory.knots < s
    return remaining_trajectory(trajectory, s, tempo), path(np.append(trajectory.knots[passed], s))


def is_closed_loop(program: dict[str, Any]) -> bool:
    """Return whether a session was corrected while it was played.

    program: its record of that kind.
    """
    return float(program.get("share", 1.0)) < 1.0


def patches_of(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the corrections of a session and of those that it continued, in order.

    records: of its journal.
    """
    return [
        *find_program_record(records).get("patches", []),
        *(r["patch"] for r in records if r["kind"] == "corrected"),
    ]


def find_program_record(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the record of the trajectory that a session played; raises TrajectoryError.

    records: of its journal.
    """
    told = next((record for record in records if record["kind"] == "program"), None)
    if told is None:
        raise TrajectoryError("the journal's session played no trajectory: play the plan from its start")
    return told


def last_passed(records: list[dict[str, Any]]) -> int:
    """Return the last frame that a session passed for certain, 0 for none.

    records: of its journal.
    """
    return max(
        [int(find_program_record(records)["first"]), *(int(r["frame"]) for r in records if r["kind"] == "frame")]
    )


def session_of(records: list[dict[str, Any]]) -> str:
    """Return the name of the session that played, "" where the journal is too old to have it.

    records: of its journal.
    """
    return str(next((record.get("id", "") for record in records if record["kind"] == "session"), ""))


def check_trusted(records: list[dict[str, Any]], verified: bool) -> None:
    """Raise TrajectoryError where a session left a position that is not to be trusted.

    records: of its journal. verified: whether a person has checked the position since, so that nothing is raised.
    """
    results = [record for record in records if record["kind"] == "result"]
    if not verified and results and not results[-1]["trusted"]:
        raise TrajectoryError(f"the position was not to be trusted when the session ended: {DISTRUST_REMEDY}")


def _approach_and_play(
    player: Player,
    trajectory: Trajectory,
    standing: Standing,
    model: Model,
    callback: Seen | None,
    loop: ClosedLoop | None,
    before: Array,
) -> Result:
    """Play a trajectory, after a slow approach to its start where the robot is not there.

    before (n, 2d + 2): configurations that the robot has passed, as far as they matter to the closed loop.
    """
    start = trajectory.positions(0.0)
    tilted = abs(player.tilt() - trajectory.tilt(0.0)).max() > ARM_START_TOLERANCE_RAD
    if tilted or (abs(start - standing.position) > player.device.resolution).any():
        approach = approach_to(trajectory, standing.position, player.tilt())
        check_trajectory(approach, model)
        result = player.play(approach, callback)
        if result.outcome is not PlaybackOutcome.SUCCESS:
            return result
    guide = None if loop is None else loop.guide(trajectory, before, player.journal)
    return player.play(trajectory, callback, guide)


def _announce(
    player: Player,
    trajectory: Trajectory,
    tempo: float,
    standing: Any,
    s: float | None,
    patches: list[dict[str, Any]],
) -> None:
    """Record what resume and retract need to know.

    standing (m,): of the axes before the session. s: parameter at which it continues, None for a new one. patches:
    corrections of the sessions that it continues.
    """
    player.journal.record(
        "program",
        plan=trajectory.digests.plan,
        hardware=trajectory.digests.hardware,
        tempo=tempo,
        share=trajectory.share,
        patches=patches,
        standing=np.asarray(standing).tolist(),
        parameter=s,
        first=0 if s is None else int(trajectory.frames[trajectory.knots <= s][-1]),
        last=int(trajectory.frames[-1]),
        duration=trajectory.duration,
    )


def rebuild_corrected_trajectory(plan: Plan, hardware: Hardware, records: list[dict[str, Any]]) -> Trajectory:
    """Return the trajectory of a session as it was last corrected.

    plan, hardware: as played. records: of its journal. Raises TrajectoryError where plan or hardware is another.
    """
    trajectory = rebuild_planned_trajectory(plan, hardware, find_program_record(records))
    for patch in patches_of(records):
        trajectory = trajectory.apply_patch(Patch.from_record(patch))
    return trajectory


def rebuild_planned_trajectory(plan: Plan, hardware: Hardware, program: dict[str, Any]) -> Trajectory:
    """Return the trajectory of a session before it was corrected.

    plan, hardware: as played. program: the session's record of that kind. Raises TrajectoryError where plan or
    hardware is another.
    """
    share = float(program.get("share", 1.0))
    trajectory, _ = prepare_trajectory(plan, hardware, program["tempo"], np.array(program["standing"]), share)
    for what, digest in zip(("plan", "hardware"), trajectory.digests, strict=True):
        if program.get(what) != digest:
            name = f"this {what} ({plan.meta['problem']['name']})" if what == "plan" else "this hardware file"
            raise TrajectoryError(
                f"the journal is of another {what}: its digest is {str(program.get(what))[:12]}, that of {name} "
                f"{digest[:12]}; give the {what} that was played, unchanged"
            )
    return trajectory


def locate_on_path(trajectory: Trajectory, standing: Standing, resolution: Array, frame: int) -> float:
    """Return where on the path after a frame the axes stand, as its parameter; raises TrajectoryError.

    trajectory: of the session. standing: of the axes. frame: the last that was passed for certain.

    Where the path comes by the same place again, the first time within the axes' resolution (m,) counts: a
    controller that was left alone plays no more than what it had in its buffer. A frame from which the axes cannot
    be distinguished has been passed.
    """
    commands = trajectory.commands()
    tolerance = trajectory.hardware.tolerance
    path = FollowedPath(trajectory.positions(0.0), commands, tolerance)
    first = int(np.searchsorted(commands.frame, frame, "right"))
    pieces = range(max(first - 1, 0), len(commands.time))
    found = [path.nearest(standing.position, k, k + 1) for k in pieces]
    away = np.array([place.away for place in found])
    if away.min() > 1.0:
        raise TrajectoryError(
            f"the axes are {away.min():.3g} tolerances off the path after frame {frame}, and 1 is allowed: move "
            "them back, or play the plan from its start"
        )
    alike = np.append(away <= away.min() + 2 * (resolution / tolerance).max(), False)
    first = int(alike.argmax())
    last = first + int((~alike[first:]).argmax())
    s = float(trajectory.motion.parameter(found[first + int(away[first:last].argmin())].time))
    ahead = np.flatnonzero(trajectory.knots > s)[:1]
    there = abs(trajectory.positions(trajectory.frame_time[ahead]) - standing.position) <= resolution
    return float(trajectory.knots[ahead[0]]) if ahead.size and there.all() else s
