"""`ctr-nlp commission`: check a controller's settings, try single steps of its axes, and keep a record."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.operator_control import SIGNAL_EXIT_BASE, stop_on_signals
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.play_report import JOURNAL, claim
from ctr_nlp.cli.terminal_output import console, print_stderr, print_table, report_written_files
from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.clock import RealClock
from ctr_nlp.hardware.commission import STEP_DIRECTION_SIGNS, TRIAL_STEP_LENGTH, Commissioning, ControllerReadout
from ctr_nlp.hardware.description import Hardware, commissioned_file, commissioned_text
from ctr_nlp.hardware.device_factory import memory_of, recorded_link
from ctr_nlp.hardware.devices import Asked
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.support.interrupt import deferred_interrupt

SKIP, TIGHTEN = "SKIP", "SET"
OUT = "runs/commissioning"


def commission(hardware_file: Path, out: str | None) -> int:
    """Read a controller, move what a person asks for, and keep its settings; return the exit status.

    hardware_file: describes the rig; settings are kept beside it. out: folder for the journal, None for the usual
    one. Settings are kept where none is wrong and every axis has arrived in both directions, or is skipped by a
    person.
    """
    folder = Path(out or OUT)
    claim(folder)
    journal_file = folder / JOURNAL
    hardware = Hardware.from_toml(hardware_file)
    clock = RealClock()
    journal = Journal(journal_file, clock)
    memory = memory_of(hardware.connection)
    try:
        if memory is not None:
            memory.claim()
        rig = Commissioning(hardware, lambda: recorded_link(hardware.connection, journal), clock)
        try:
            controller = rig.read()
            _show(hardware, controller)
            if controller.wrong:
                console().print("Nothing was moved or kept. Set what is wrong, then commission again.")
                return EXIT_SOME_FAILED
            signalled = _steps(rig, hardware)
            controller = rig.controller
        finally:
            rig.close()
    except DeviceFault as exception:
        print_stderr(f"error: {exception}")
        print_stderr(f"what was said is in {journal_file}")
        return EXIT_SOME_FAILED
    finally:
        if memory is not None:
            memory.release()
        journal.close()
    if signalled:
        console().print("Nothing was kept.")
        return SIGNAL_EXIT_BASE + signalled
    if rig.remaining:
        console().print(
            f"Nothing was kept, since these steps have not been made: {' '.join(rig.remaining)}. Commission "
            f"again, and make them or type skip and the axis, such as skip {rig.remaining[0][0]}.",
        )
        return EXIT_SOME_FAILED
    kept = commissioned_file(hardware_file)
    write_text(
        kept, commissioned_text(controller.identity.settings, controller.identity.description, rig.untested_axes)
    )
    if rig.untested_axes:
        console().print(
            f"Kept without a trial of axes {', '.join(rig.untested_axes)}; `ctr-nlp play` will say so."
        )
    report_written_files(kept, more=": `ctr-nlp play` compares the controller with it at every start")
    return EXIT_SOLVED


def _show(hardware: Hardware, controller: ControllerReadout) -> None:
    """Print the controller, where its axes stand, and every setting that is wrong or has changed."""
    stands = zip(hardware.axes, controller.position, strict=True)
    rows = [(f"axis {axis.letter} ({axis.joint})", f"{there:.3f}", axis.unit) for axis, there in stands]
    rows.append(("question to answer", f"{1e3 * controller.round_trip:.0f}", "ms"))
    rows.append(("settings read", str(len(controller.identity.settings)), ""))
    print_table(f"controller at {hardware.connection.url}", ("", "value", "unit"), rows)
    for title, settings in (
        ("settings that are wrong", controller.wrong),
        ("settings that have changed since the rig was commissioned", controller.changed),
        ("settings that are looser than they need be", controller.loose),
    ):
        table = [(f"${one.name}", one.value, f"${one.name}={one.wanted}", one.why) for one in settings]
        if table:
            print_table(title, ("setting", "value", "command", "why"), table)
    if not controller.wrong:
        console().print("No setting goes against safe playing.")
    if controller.loose:
        tighter = " ".join(f"${one.name}={one.wanted}" for one in controller.loose)
        console().print(f"Type set to write the tighter values to the controller: {tighter}.")


def _steps(rig: Commissioning, hardware: Hardware) -> int:
    """Move single axes as typed, until an empty line or the end of input; return the signal that ended it, 0 for
    none.
    """
    letters = " ".join(hardware.letters)
    for sentence in (
        f"With the tubes taken out, type an axis ({letters}) and + or - to move it by {TRIAL_STEP_LENGTH:g} mm "
        f"or degree, "
        "such as X+; an empty line ends.",
        "Each must move as far as a ruler shows, and + must go outwards, or anticlockwise seen from the tip, "
        "where sign is 1.",
        "Settings are kept when every axis has moved both ways. To leave one untried, type skip and the axis, "
        "such as skip X.",
    ):
        console().print(sentence)
    with deferred_interrupt() as interrupted:
        # Ctrl-C while a line is awaited sets a flag alone, since Python repeats the read: it counts with the next
        # line, and a second Ctrl-C ends the program.
        for line in sys.stdin:
            typed = line.strip().upper()
            if not typed or interrupted():
                break
            signalled = _obey(typed, rig, hardware, interrupted)
            if signalled:
                return signalled
        return int(signal.SIGINT) if interrupted() else 0


def _obey(typed: str, rig: Commissioning, hardware: Hardware, interrupted: Asked) -> int:
    """Do what a typed line asks for, or say that it means nothing; return the signal that came meanwhile, 0 for
    none.
    """
    letter = typed.removeprefix(SKIP).strip()
    letters = " ".join(hardware.letters)
    if typed == TIGHTEN:
        done = rig.tighten()
        said = " ".join(f"${one.name}={one.wanted}" for one in done)
        console().print(f"written to the controller: {said}" if done else "No setting is looser than it need be.")
    elif typed.startswith(SKIP) and letter in hardware.letters:
        rig.skip(letter)
        console().print(f"{letter} is left untried")
    elif len(typed) != 2 or typed[0] not in hardware.letters or typed[1] not in STEP_DIRECTION_SIGNS:
        message = (
            f"{typed!r} is no command; type an axis ({letters}) and + or - to move it, skip and an axis to leave "
            "it untried, or set to write settings that are looser than they need be"
        )
        console().print(message)
    else:
        return _step_axis(typed[0], STEP_DIRECTION_SIGNS[typed[1]], rig, interrupted)
    return 0


def _step_axis(letter: str, direction: int, rig: Commissioning, interrupted: Asked) -> int:
    """Move an axis by a step, which signals stop; return the first signal that came, 0 for none."""
    with stop_on_signals(lambda: None, interrupted) as signalled:
        try:
            before, after = rig.step(letter, direction, lambda: signalled() != 0)
        except HardwareError as exception:
            console().print(str(exception))
        except DeviceFault as exception:
            # A step that a signal stops ends as a fault of the device, which is then none.
            if not signalled():
                raise
            console().print(str(exception))
        else:
            console().print(f"{letter} went from {before:.3f} to {after:.3f}")
        return signalled()


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Read a Grbl controller, report which settings are wrong and what to set, move single axes "
        "by a small step where asked to, and keep its settings beside the hardware file, to be compared at every "
        "start, once every axis has moved both ways. Where largest rates or soft limits are looser than the "
        "hardware file needs, typing set writes the tighter values to the controller.",
        epilog="Exit status: 0 where settings were kept, 1 where a setting is wrong, an axis was not tried or the "
        "controller fails, 2 where input is bad, 128 + N where signal N stopped a step: 130 after Ctrl-C, 131 "
        "after Ctrl-\\, 143 after SIGTERM.",
    )
    parser.add_argument("hardware", metavar="FILE.toml", help="hardware file")
    parser.add_argument(
        "--out", metavar="DIR", help=f"folder for {JOURNAL}, the record of what was said (default {OUT})"
    )
    return parser


main = Command(
    "ctr-nlp commission", _parser, lambda arguments: commission(Path(arguments.hardware), arguments.out)
)
