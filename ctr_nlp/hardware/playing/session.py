"""From a plan to its last frame: check, connect, go to the first frame, play; or go on where a session ended."""

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
"""Kind of the journal's record of a retraction, after which no session before it can be resumed."""

ARM_START_TOLERANCE_RAD = 1e-4
"""rad by which the arm may be off where a trajectory starts."""


def prepare_trajectory(
    plan: Plan, hardware: Hardware, tempo: float = 1.0, standing: Array | None = None, share: float = 1.0
) -> tuple[Trajectory, TrajectoryCheck]:
    """The trajectory of a plan, and what was found when all of it was checked.

    standing (m,): positions from which the axes come to the first frame. share: of the largest speeds and
    accelerations; the rest is left for corrections. Raises HardwareError, OptionError, TrajectoryError.
    """
    check_plan(plan, hardware.apply_limits(plan.robot))
    trajectory = trajectory_of(plan, hardware, tempo, standing, share)
    return trajectory, check_trajectory(trajectory, plan.evaluated_model)


def catch_stop(play: Callable[Playing, Result]) -> Callable[Playing, Result]:
    """The same, but that an abort while the device is being connected is a result too."""

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

    home: let the device find its position before. verified: a person has made sure that the axes are where the
    device says. loop: what corrects the plan, None for nothing. Raises what prepared raises before anything is
    sent, and DeviceFault where nothing could be begun.
    """
    share = 1.0 if loop is None else SHARE
    trajectory, _ = prepare_trajectory(plan, hardware, tempo, share=share)
    if loop is not None:
        loop.open()
    standing = connect_player(player, home=home, verified=verified)
    if hardware.backlash.any():
        trajectory = trajectory_of(plan, hardware, tempo, standing.position, share)
        check_trajectory(trajectory, plan.evaluated_model)
    _announce(player, trajectory, tempo, standing.position, None, [])
    return _approach_and_play(player, trajectory, standing, plan.evaluated_model, callback, loop, plan.q[:0])


def connect_player(
    player: Player, *, home: bool = False, verified: bool = False, stop_first: bool = False, session: str = ""
) -> Standing:
    """Connect a player whose device must know where it stands, or a person for it; raises DeviceFault, Stopped."""
    standing = player.connect(stop_first, home, session)
    if verified:
        player.trust()
    if player.state is not PlayerState.HOMED:
        unhomed = "" if standing.homed else "the device does not know where it stands: let it home first"
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
    """Go on where a session (the records of its journal) ended, if the robot still stands on its path.

    A device that still moves is stopped first. verified: a person has made sure that the axes are where the device
    says. loop: what corrects the rest, if that session was one of a closed loop, and None if not. Raises
    TrajectoryError where the plan or the position is another, or nothing is left.
    """
    if any(record["kind"] == RETRACTED for record in records):
        raise TrajectoryError("the tubes have been retracted since that session: begin anew")
    told = find_program_record(records)
    if (loop is not None) != is_closed_loop(told):
        raise TrajectoryError(
            f"the journal's session was {'of' if is_closed_loop(told) else 'not of'} a closed loop: go on as "
            f"it was begun"
        )
    trajectory = rebuild_corrected_trajectory(plan, hardware, records)
    frame = last_passed(records)
    if frame < 1:
        raise TrajectoryError("the journal's session did not reach its first frame: begin anew")
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
    """The rest of a trajectory for a robot that stands at its parameter s; q (n, 2d + 2) from its start to s."""
    path = trajectory.motion.path
    passed = trajectory.knots < s
    return remaining_trajectory(trajectory, s, tempo), path(np.append(trajectory.knots[passed], s))


def is_closed_loop(program: dict[str, Any]) -> bool:
    """Whether what a journal announced was corrected while it was played."""
    return float(program.get("share", 1.0)) < 1.0


def patches_of(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By how much trajectories were corrected in a session and in those that it went on with, in order."""
    return [
        *find_program_record(records).get("patches", []),
        *(r["patch"] for r in records if r["kind"] == "corrected"),
    ]


def find_program_record(records: list[dict[str, Any]]) -> dict[str, Any]:
    """What a journal tells of the trajectory that its session played; raises TrajectoryError."""
    told = next((record for record in records if record["kind"] == "program"), None)
    if told is None:
        raise TrajectoryError("the journal's session played no trajectory: begin anew")
    return told


def last_passed(records: list[dict[str, Any]]) -> int:
    """The last frame that a session passed for certain, 0 for none."""
    return max(
        [int(find_program_record(records)["first"]), *(int(r["frame"]) for r in records if r["kind"] == "frame")]
    )


def session_of(records: list[dict[str, Any]]) -> str:
    """The name of the session that played, "" where the journal is too old to tell."""
    return str(next((record.get("id", "") for record in records if record["kind"] == "session"), ""))


def check_trusted(records: list[dict[str, Any]], verified: bool) -> None:
    """Raise TrajectoryError where a session left a position that is not to be trusted, and nobody verified it."""
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

    before (n, 2d + 2): where the robot has come through, as far as that matters.
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
    """What resume and retract need to know."""
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
    """The trajectory of a session, made again as it was corrected at last.

    Raises TrajectoryError where plan or hardware is another.
    """
    trajectory = rebuild_planned_trajectory(plan, hardware, find_program_record(records))
    for patch in patches_of(records):
        trajectory = trajectory.apply_patch(Patch.from_record(patch))
    return trajectory


def rebuild_planned_trajectory(plan: Plan, hardware: Hardware, program: dict[str, Any]) -> Trajectory:
    """The trajectory that was announced, before it was corrected; raises TrajectoryError as
    rebuild_corrected_trajectory.
    """
    share = float(program.get("share", 1.0))
    trajectory, _ = prepare_trajectory(plan, hardware, program["tempo"], np.array(program["standing"]), share)
    for what, digest in zip(("plan", "hardware"), trajectory.digests, strict=True):
        if program.get(what) != digest:
            name = f"this {what} ({plan.meta['problem']['name']})" if what == "plan" else "this hardware file"
            raise TrajectoryError(
                f"the journal is of another {what}: its digest is {str(program.get(what))[:12]}, that of {name} "
                f"{digest[:12]}; the robot cannot go on with what was changed since"
            )
    return trajectory


def locate_on_path(trajectory: Trajectory, standing: Standing, resolution: Array, frame: int) -> float:
    """Where on the path after a frame the axes stand, as its parameter; raises TrajectoryError.

    Where the path comes by the same place again, what the axes can tell apart (resolution, (m,)) decides for the
    first time: a controller that was left alone plays no more than what it had in its buffer. A frame that they
    cannot be told apart from has been passed.
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
            f"the axes stand {away.min():.3g} tolerances from the path after frame {frame}: nothing jumps; bring "
            "them back, or begin anew"
        )
    alike = np.append(away <= away.min() + 2 * (resolution / tolerance).max(), False)
    first = int(alike.argmax())
    last = first + int((~alike[first:]).argmax())
    s = float(trajectory.motion.parameter(found[first + int(away[first:last].argmin())].time))
    ahead = np.flatnonzero(trajectory.knots > s)[:1]
    there = abs(trajectory.positions(trajectory.frame_time[ahead]) - standing.position) <= resolution
    return float(trajectory.knots[ahead[0]]) if ahead.size and there.all() else s
