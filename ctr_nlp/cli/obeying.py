"""What is typed while a plan is played, and signals, as wishes of the player's."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ctr_nlp.hardware.playing.player import Player

WISHES = {"p": "pause", "r": "resume", "a": "abort"}


@contextmanager
def obeying(player: Player, interrupted: Callable[[], bool]) -> Iterator[None]:
    """Within the block what is typed, and signals that end programs, are wishes of the player's.

    Ctrl-C is one as often as it is pressed: a stop is never itself interrupted, and always ends.
    """
    threading.Thread(target=_listen, args=(player,), daemon=True).start()
    signals = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, lambda *_: player.abort()) for number in signals}
    remember = signal.getsignal(signal.SIGINT)

    def interrupt(number: int, frame: Any) -> None:
        player.abort()
        if callable(remember) and not interrupted():
            remember(number, frame)

    before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    if hasattr(signal, "SIGTTIN"):  # in the background, reading a terminal must fail and not stop the program
        before[signal.SIGTTIN] = signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _listen(player: Player) -> None:
    """Obey lines of standard input, past its buffer, whose lock would be in the way when the program ends."""
    try:
        while typed := os.read(sys.stdin.fileno(), 1024).decode(errors="replace"):
            for line in typed.splitlines():
                wish = WISHES.get(line.strip().lower()[:1])
                if wish is not None:
                    getattr(player, wish)()
    except (OSError, ValueError, AttributeError):
        return
