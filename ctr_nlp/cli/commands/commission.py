"""`ctr-nlp commission`: a controller's settings, single steps of its axes, and the record that is kept."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ctr_nlp.cli.arguments import add_out_option
from ctr_nlp.cli.console import SOLVED, SOME_FAILED, Command
from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.play_report import JOURNAL, claim
from ctr_nlp.cli.telling import console, print_table, wrote
from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.clock import RealClock
from ctr_nlp.hardware.commission import STEP, Commissioning, Controller
from ctr_nlp.hardware.description import Hardware, commissioned_file, commissioned_text
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.opening import memory_of, recorded_link
from ctr_nlp.support.interrupt import deferred_interrupt

DIRECTIONS = {"+": 1, "-": -1}
OUT = "runs/commissioning"


def commission(hardware_file: Path, out: str | None) -> int:
    """Read a controller, move what a person asks for, and keep its settings if none is wrong; the exit status.

    The journal goes into the folder out, or where that is None into one of its own.
    """
    folder = Path(out or OUT)
    claim(folder)
    journal_file = folder / JOURNAL
    hardware, clock = Hardware.from_toml(hardware_file), RealClock()
    journal, memory = Journal(journal_file, clock), memory_of(hardware.connection)
    try:
        if memory is not None:
            memory.claim()
        rig = Commissioning(hardware, lambda: recorded_link(hardware.connection, journal), clock)
        try:
            controller = rig.read()
            _show(hardware, controller)
            if controller.wrong:
                console().print("Nothing was moved or kept. Set what is wrong, then commission again.")
                return SOME_FAILED
            _steps(rig, hardware)
        finally:
            rig.close()
    except DeviceFault as exception:
        sys.stderr.write(f"error: {exception}\nwhat was said is in {journal_file}\n")
        return SOME_FAILED
    finally:
        if memory is not None:
            memory.release()
        journal.close()
    kept = commissioned_file(hardware_file)
    write_text(kept, commissioned_text(controller.identity.settings, controller.identity.told))
    wrote(kept, more=": `ctr-nlp play` compares the controller with it at every start")
    return SOLVED


def _show(hardware: Hardware, controller: Controller) -> None:
    """Who it is, where its axes stand, and every setting that is wrong or has changed."""
    stands = zip(hardware.axes, controller.position, strict=True)
    rows = [(f"axis {axis.letter} ({axis.joint})", f"{there:.3f}", axis.unit) for axis, there in stands]
    rows.append(("question to answer", f"{1e3 * controller.round_trip:.0f}", "ms"))
    rows.append(("settings read", str(len(controller.identity.settings)), ""))
    print_table(f"controller at {hardware.connection.url}", ("", "value", "unit"), rows)
    for title, settings in (
        ("settings that are wrong", controller.wrong),
        ("settings that have changed since the rig was commissioned", controller.changed),
    ):
        table = [(f"${one.name}", one.value, f"${one.name}={one.wanted}", one.why) for one in settings]
        if table:
            print_table(title, ("setting", "is", "set", "why"), table)
    if not controller.wrong:
        console().print("No setting goes against safe playing.")


def _steps(rig: Commissioning, hardware: Hardware) -> None:
    """Move single axes as typed, until a line says something else or there are no more."""
    letters = " ".join(hardware.letters)
    console().print(
        f"With the tubes taken out, type an axis ({letters}) and + or - to move it by {STEP:g} mm or degree, "
        "such as X+; an empty line ends.\n"
        "Each must move as far as a ruler shows, and + must go outwards, or anticlockwise seen from the tip, "
        "where sign is 1.",
        markup=False,
    )
    with deferred_interrupt() as interrupted:
        for line in sys.stdin:
            typed = line.strip().upper()
            if not typed or interrupted():
                return
            if len(typed) != 2 or typed[0] not in hardware.letters or typed[1] not in DIRECTIONS:
                console().print(
                    f"{typed!r} is no axis and direction; type one of {letters} and + or -", markup=False
                )
                continue
            try:
                before, after = rig.step(typed[0], DIRECTIONS[typed[1]], interrupted)
            except HardwareError as exception:
                console().print(str(exception), markup=False)
            else:
                console().print(f"{typed[0]} went from {before:.3f} to {after:.3f}")


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Read a Grbl controller, tell which settings are wrong and what to set, move single axes "
        "by a small step where asked to, and keep its settings beside the hardware file, to be compared at every "
        "start.",
        epilog="Exit status: 0 where settings were kept, 1 where a setting is wrong or the controller fails, 2 "
        "where input is bad, 130 after an interruption.",
    )
    parser.add_argument("hardware", metavar="FILE.toml", help="hardware file")
    add_out_option(parser, OUT)
    return parser


main = Command(
    "ctr-nlp commission", _parser, lambda arguments: commission(Path(arguments.hardware), arguments.out)
)
