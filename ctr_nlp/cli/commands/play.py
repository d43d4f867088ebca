"""`ctr-nlp play`: play a plan on hardware, or on a simulated rig."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.check.checker import NOT_COVERED, YES
from ctr_nlp.check.comparison import Opinion
from ctr_nlp.cli import closed_loop, live_views
from ctr_nlp.cli.arguments import add_live_option
from ctr_nlp.cli.commands.commission import commission
from ctr_nlp.cli.console import EXIT_BAD_INPUT, EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.operator_control import SIGNAL_EXIT_BASE, obey_operator
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.play_report import JOURNAL, claim, print_trajectory, report
from ctr_nlp.cli.second_opinion import require_agreement
from ctr_nlp.cli.terminal_output import busy, print_stderr, progress_bar
from ctr_nlp.exceptions import DeviceFault, HardwareError, OptionError
from ctr_nlp.hardware.axis import LETTERS
from ctr_nlp.hardware.clock import RealClock
from ctr_nlp.hardware.description import Hardware, simulated_hardware
from ctr_nlp.hardware.device_factory import arm_follower, device_of, memory_of
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.devices.grbl.identity import find_loose_settings
from ctr_nlp.hardware.guiding.guide import SHARE
from ctr_nlp.hardware.guiding.loop import ClosedLoop
from ctr_nlp.hardware.journal import Journal, read_journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.checks import check_plan
from ctr_nlp.hardware.playing.permission import check_permission
from ctr_nlp.hardware.playing.playback import Seen
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.record import Recorder
from ctr_nlp.hardware.playing.results import PlaybackOutcome
from ctr_nlp.hardware.playing.retract import retract
from ctr_nlp.hardware.playing.session import play_plan, prepare_trajectory, resume
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS
from ctr_nlp.robot import Robot
from ctr_nlp.support.interrupt import deferred_interrupt


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Check a plan for some hardware, and again by an independent checker, go slowly to its "
        "first frame, and play it. While it plays, keys are obeyed: p pauses, r resumes, a aborts; where standard "
        "input is no terminal, lines that begin with these letters. Ctrl-C, Ctrl-\\ and the signals SIGTERM and "
        "SIGHUP abort too.",
        epilog="Exit status: 0 where the plan was played to the end, 1 where it was not, as after a, or where "
        "something could not be written, 2 where input is bad and nothing was sent, 128 + N where signal N "
        "stopped it: 130 after Ctrl-C, 131 after Ctrl-\\, 143 after SIGTERM, 129 after SIGHUP.",
    )
    parser.add_argument("plan", metavar="PLAN.npz", nargs="?", help="not with --commission")
    parser.add_argument("--hardware", metavar="FILE.toml", help="(default: a simulated bench rig)")
    parser.add_argument("--dry-run", action="store_true", help="check everything; open no device")
    parser.add_argument(
        "--tempo", metavar="X", type=float, help="part of the plan's own pace, in (0, 1] (default 1)"
    )
    parser.add_argument("--home", action="store_true", help="run the controller's homing cycle before")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on where the last session in the journal ended, if the robot is there, at that session's tempo",
    )
    parser.add_argument(
        "--position-verified",
        action="store_true",
        help="confirm that the axes stand where the controller says; needed where its position may be wrong, and "
        "the first time that this controller is used",
    )
    parser.add_argument(
        "--retract",
        action="store_true",
        help="pull the tubes back slowly along the path of the last session in the journal, or, where there is no "
        "journal, innermost first; the motion is checked like a plan",
    )
    parser.add_argument(
        "--commission",
        action="store_true",
        help="read a Grbl controller, report which settings are wrong and what to set, move single axes by a "
        "small step where asked to, and keep its settings beside the hardware file, to be compared at every start",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help=f"where {JOURNAL}, tracking.csv and tracking.png go (default runs/PROBLEM-play)",
    )
    parser.add_argument(
        "--free-space",
        action="store_true",
        help="confirm that nothing surrounds the robot, as on a bench; needed for a plan without a lumen, whose "
        "clearance cannot be checked",
    )
    parser.add_argument(
        "--uncertified",
        action="store_true",
        help="play a plan with verdicts that are no or NOT CHECKED (ctr-nlp robust checks stability and samples); "
        "unsolved frames, exceeded limits and snaps are still refused",
    )
    closed_loop.add_options(parser)
    add_live_option(parser, "the robot where its axes are, over where they should be (the tilt as commanded),")
    return parser


PLAY_EXCLUSIVE_OPTIONS = {
    "resume": ("home", "tempo", "dry_run"),
    "retract": ("home", "tempo", "dry_run", "resume", "live", "closed_loop", "replay"),
    "commission": (
        *("home", "tempo", "dry_run", "resume", "retract", "live", "position_verified", "plan"),
        *("uncertified", "free_space", "closed_loop", "sensor", "replay"),
    ),
    "replay": ("home", "tempo", "dry_run", "resume", "live", "position_verified"),
    "dry_run": ("live", "position_verified"),
}
"""Options that do not go with each option."""


def _check_exclusive_options(arguments: argparse.Namespace) -> None:
    """Raise OptionError for options that do not go together, and for a plan or a hardware file that is missing."""
    for option, others in PLAY_EXCLUSIVE_OPTIONS.items():
        for other in others:
            if getattr(arguments, option) and getattr(arguments, other) not in (None, False):
                name = "PLAN.npz" if other == "plan" else f"--{other.replace('_', '-')}"
                raise OptionError(f"{name} does not go with --{option.replace('_', '-')}")
    if arguments.commission and arguments.hardware is None:
        raise OptionError("--commission needs --hardware FILE.toml, beside which the settings are kept")
    if arguments.plan is None and not arguments.commission:
        raise OptionError("a plan is needed: PLAN.npz")
    if arguments.sensor is not None and not (arguments.closed_loop or arguments.replay):
        raise OptionError("--sensor goes with --closed-loop")
    if not 0 < _tempo(arguments) <= 1:
        raise OptionError(f"tempo is {arguments.tempo:g}; it must lie in (0, 1]")


def _run(arguments: argparse.Namespace) -> int:
    _check_exclusive_options(arguments)
    if arguments.commission:
        return commission(Path(arguments.hardware), arguments.out)
    plan = Plan.load(arguments.plan)
    hardware = (
        simulated_hardware(plan.robot) if arguments.hardware is None else Hardware.from_toml(arguments.hardware)
    )
    if arguments.closed_loop or arguments.replay:
        hardware = closed_loop.with_sensor(hardware, arguments.sensor)
    asked = not (arguments.retract or arguments.resume or arguments.replay)
    if asked:  # no option waives what check_plan refuses: it comes first
        check_plan(plan, _apply_limits(hardware, plan.robot, arguments.hardware))
    print_stderr(NOT_FOR_PATIENTS)
    if asked:
        _ask_permission(arguments, plan)
        with busy(f"an independent check of {arguments.plan}"):
            opinions = require_agreement(arguments.plan)
        _note_opinions(opinions)
    _note_untried(hardware)
    _note_loose(hardware)
    if arguments.dry_run:
        title = f"{plan.meta['problem']['name']}: checked; nothing was sent"
        share = SHARE if arguments.closed_loop else 1.0
        with busy("speeds and accelerations of the axes are checked"):
            prepared = prepare_trajectory(plan, hardware, _tempo(arguments), share=share)
        print_trajectory(title, *prepared)
        return EXIT_SOLVED
    out = Path(arguments.out or f"runs/{path_component(str(plan.meta['problem']['name']))}-play")
    if arguments.replay:
        return closed_loop.replay(plan, hardware, read_journal(out / JOURNAL))
    known = arguments.resume or (arguments.retract and (out / JOURNAL).exists())
    records = read_journal(out / JOURNAL) if known else None
    looped = closed_loop.start_closed_loop(plan, hardware, records) if arguments.closed_loop else nullcontext()
    with looped as loop, live_views.open_playback_view(plan) if arguments.live else nullcontext() as told:
        return _play_plan(arguments, plan, hardware, out, records, told, loop)


def _apply_limits(hardware: Hardware, robot: Robot, file: str | None) -> Robot:
    """Return the robot with the limits of the hardware, too; errors name the hardware's file, None for none."""
    try:
        return hardware.apply_limits(robot)
    except HardwareError as error:
        if file is None:
            raise
        raise HardwareError(f"hardware file {file}: {error}") from error


def _ask_permission(arguments: argparse.Namespace, plan: Plan) -> None:
    """Raise an error unless the plan may be played, and name on stderr the verdicts that options waive.

    Resuming needs no new permission, since it takes the very same plan. Nor does retracting: whatever is wrong
    with a plan, the robot must come out.
    """
    waived = check_permission(
        plan, free_space=arguments.free_space, uncertified=arguments.uncertified, name=arguments.plan
    )
    if arguments.closed_loop:
        closed_loop.warn(plan)
    for verdict in waived:
        print_stderr(f"note: {verdict.matter}: {verdict.word}. {verdict.why}")


def _note_opinions(opinions: Sequence[Opinion]) -> None:
    """Name on stderr the verdicts of the plan with which the independent check agrees, and those not covered."""
    agreed = [each for each in opinions if each.word == each.own_word]
    uncovered = [each for each in opinions if each.word == NOT_COVERED and each.own_word == YES]
    told = ("agrees with the verdicts", agreed), ("does not cover", uncovered)
    for what, listed in told:
        if listed:
            names = ", ".join(each.name.replace("_", " ") for each in listed)
            print_stderr(f"note: an independent check {what}: {names}; see `ctr-nlp check`")


def _note_untried(hardware: Hardware) -> None:
    """Name on stderr the axes that were not moved when the rig was commissioned, all where it never was."""
    if hardware.commissioned is None:
        # Only Grbl's controllers are commissioned: the others have no settings to keep.
        if hardware.connection.device != "grbl":
            return
        told = "this rig was never commissioned: scale and direction of no axis were tried"
    elif hardware.untried == ():
        return
    elif hardware.untried is None:
        told = "the record of the rig's commissioning does not say which axes were tried"
    else:
        told = f"when the rig was commissioned, axes were not tried: {', '.join(hardware.untried)}"
    print_stderr(f"note: {told}; `ctr-nlp commission` tries them")


def _note_loose(hardware: Hardware) -> None:
    """Name on stderr the settings of the commissioned controller that could bound a corrupted line more
    tightly.
    """
    if hardware.commissioned is None:
        return
    columns = [LETTERS.index(axis.letter) for axis in hardware.axes]
    for one in find_loose_settings(hardware.commissioned, columns, hardware):
        print_stderr(f"note: {one}, or type set in `ctr-nlp commission`")


def _tempo(arguments: argparse.Namespace) -> float:
    return 1.0 if arguments.tempo is None else float(arguments.tempo)


def _play_plan(
    arguments: argparse.Namespace,
    plan: Plan,
    hardware: Hardware,
    out: Path,
    records: list[dict[str, Any]] | None,
    live_view: live_views.PlaybackView | None,
    loop: ClosedLoop | None,
) -> int:
    """Play a plan, from the beginning or from where `records` end, or retract; return the exit status.

    out: folder of the journal. records: of the journal's last session, None for a new one. live_view: shows the
    motion, if any. loop: corrects the plan, if any.
    """
    claim(out)
    clock = RealClock()
    journal = Journal(out / JOURNAL, clock)
    arm = None if hardware.arm is None else arm_follower(hardware.arm, _last_tilt(plan, records), clock.now)
    device = device_of(hardware, journal, clock, _last_axis_positions(hardware, records))
    player = Player(device, arm, journal, clock, memory_of(hardware.connection))
    recorder = Recorder()
    with (
        # Within this block signals only ask for a stop: none of them ends the program with motors running.
        deferred_interrupt() as interrupted,
        progress_bar() as labelled,
        obey_operator(player, interrupted) as signalled,
    ):
        # Ctrl-C may have come before there was a player to stop: nothing must move then.
        if interrupted():
            player.abort()
        seen = _make_progress_callback(player, recorder, labelled(plan.meta["problem"]["name"]), live_view)
        how: dict[str, Any] = {"verified": arguments.position_verified, "callback": seen}
        try:
            if arguments.retract:
                result = retract(player, plan, hardware, records, **how)
            elif records is not None:
                result = resume(player, plan, hardware, records, loop=loop, **how)
            else:
                tempo = _tempo(arguments)
                result = play_plan(player, plan, hardware, tempo, home=arguments.home, loop=loop, **how)
        except DeviceFault as exception:
            print_stderr(f"error: {exception}")
            print_stderr(f"nothing was played; what was said is in {out / JOURNAL}")
            return EXIT_SOME_FAILED
        finally:
            player.close()
            journal.close()
    if live_view is not None:
        live_view.show_outcome(result.outcome.value)
    whole = report(plan, hardware, result, recorder.tracking(), journal, loop)
    if result.outcome is PlaybackOutcome.SUCCESS:
        return EXIT_SOLVED if whole else EXIT_SOME_FAILED
    if result.outcome is PlaybackOutcome.INVALID_PLAN:
        return EXIT_BAD_INPUT
    by_signal = result.outcome is PlaybackOutcome.CANCELLED and signalled()
    return SIGNAL_EXIT_BASE + signalled() if by_signal else EXIT_SOME_FAILED


def _last_axis_positions(hardware: Hardware, records: list[dict[str, Any]] | None) -> Any:
    """Return where the axes of a simulated device stand: at their zeros, or where the journal saw them last."""
    seen = [record["position"] for record in records or () if record.get("position") is not None]
    return seen[-1] if seen else [axis.zero for axis in hardware.axes]


def _last_tilt(plan: Plan, records: list[dict[str, Any]] | None) -> Any:
    """Return the tilt (2,), rad, of a simulated arm: 0, or that of the last frame in the journal."""
    frames = [record["frame"] for record in records or () if record["kind"] == "frame"]
    return plan.theta[frames[-1] - 1] if frames else np.zeros(2)


def _make_progress_callback(
    player: Player,
    recorder: Recorder,
    show: Callable[[int, int, str], None],
    live_view: live_views.PlaybackView | None,
) -> Seen:
    """Return a callback that records progress, and shows it on the terminal and in the window."""

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        recorder(trajectory, progress)
        show(trajectory.last_frame_passed(progress.time), int(trajectory.frames[-1]), player.state.value)
        if live_view is not None:
            live_view(trajectory, progress, player.state.value)

    return seen


main = Command("ctr-nlp play", _parser, _run)
