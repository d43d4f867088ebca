"""python -m emulator: the emulated controller in real time, for a player to connect to."""

from __future__ import annotations

import argparse
import signal
import sys
import threading

from ctr_nlp.exceptions import CtrError
from emulator.firmware import Firmware
from emulator.serve import open_port, run


def setting(text: str) -> tuple[int, float]:
    """A setting written as on the wire, $n=value."""
    number, _, value = text.removeprefix("$").partition("=")
    return int(number), float(value)


def main(arguments: list[str] | None = None) -> int:
    """Serve until interrupted; the exit status is 0, or 2 where the port cannot be had."""
    parser = argparse.ArgumentParser(prog="python -m emulator", description=__doc__)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--tcp", type=int, default=0, metavar="PORT", help="loopback TCP port; 0 picks a free one")
    where.add_argument("--pty", action="store_true", help="a pseudo-terminal instead")
    parser.add_argument("--homed", action="store_true", help="start as after homing")
    parser.add_argument("--settings", type=setting, nargs="+", default=[], metavar="$n=v", help="changed settings")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        port = open_port("pty" if options.pty else "tcp", options.tcp)
    except (OSError, CtrError) as exception:
        print(f"error: {exception}", file=sys.stderr)
        return 2
    print(port.url, flush=True)
    try:
        run(Firmware(dict(options.settings), homed=options.homed), port, stop)
    finally:
        port.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
