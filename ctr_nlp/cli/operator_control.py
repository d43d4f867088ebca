"""Operator's control of a plan that is played: keys, lines and signals become requests to the player.

Handlers of signals and the thread that reads lines only ask; the player itself decides between two commands of the
motion, so that a stop is never cut short.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ctr_nlp.cli.terminal_output import print_stderr
from ctr_nlp.hardware.playing.player import Player

OPERATOR_COMMANDS = {"p": "pause", "r": "resume", "a": "abort"}
OPERATOR_KEYS = "keys: p pauses, r resumes, a aborts; so does Ctrl-C"
"""What an operator at a terminal is told before anything moves."""

STOP_SIGNAL_NAMES = ("SIGTERM", "SIGHUP", "SIGQUIT")
"""Names of the signals that stop the motors, beside that of Ctrl-C; SIGQUIT is Ctrl-\\."""

SIGNAL_EXIT_BASE = 128
"""Exit status less the number of the signal that stopped a program, as shells have it."""


@contextmanager
def obey_operator(player: Player, interrupted: Callable[[], bool]) -> Iterator[Callable[[], int]]:
    """Turn keys, typed lines, and signals that end programs, into requests to the player within the block.

    At a terminal a key is obeyed as it is pressed, and the keys are named first. Elsewhere, as in a pipe,
    lines are obeyed.

    Parameters
    ----------
    player : Player
        Player that pauses, resumes or stops.
    interrupted : callable
        Whether Ctrl-C was pressed, also before the block began.

    Yields
    ------
    callable
        The number of the first signal that has come, 0 for none.
    """
    if hasattr(signal, "SIGTTIN"):  # in the background, reading a terminal must fail and not stop the program
        before = signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    try:
        with _pass_keys_at_once() as at_once, stop_on_signals(player.abort, interrupted) as signalled:
            threading.Thread(target=_listen, args=(player, at_once), daemon=True).start()
            yield signalled
    finally:
        if hasattr(signal, "SIGTTIN"):
            signal.signal(signal.SIGTTIN, before)


@contextmanager
def stop_on_signals(stop: Callable[[], None], interrupted: Callable[[], bool]) -> Iterator[Callable[[], int]]:
    """Ask for a stop at every signal that would end the program within the block.

    A stop is never itself interrupted, and always ends.

    Parameters
    ----------
    stop : callable
        Called for every signal, in its handler.
    interrupted : callable
        Whether Ctrl-C was pressed, also before the block began.

    Yields
    ------
    callable
        The number of the first signal that has come, 0 for none.
    """
    came: list[int] = []
    remember = signal.getsignal(signal.SIGINT)

    def handler(number: int, frame: Any) -> None:
        # First of all, so that nothing that fails later keeps the motors running.
        stop()
        came.append(number)
        # deferred_interrupt learns of the first Ctrl-C. A second one would make it raise KeyboardInterrupt in the
        # middle of the stop.
        if number == signal.SIGINT and callable(remember) and not interrupted():
            remember(number, frame)

    signals = [getattr(signal, name) for name in STOP_SIGNAL_NAMES if hasattr(signal, name)]
    before = {number: signal.signal(number, handler) for number in (*signals, signal.SIGINT)}
    try:
        yield lambda: next(iter(came), int(signal.SIGINT) if interrupted() else 0)
    finally:
        for number, known in before.items():
            signal.signal(number, known)


@contextmanager
def _pass_keys_at_once() -> Iterator[bool]:
    """Let the terminal pass on every key without Enter within the block; yields False where there is none."""
    try:
        import termios
        import tty
    except ImportError:  # a system without POSIX terminals
        yield False
        return
    # What asking a terminal raises where standard input is none, or is closed.
    no_terminal = OSError, ValueError, AttributeError, termios.error
    try:
        descriptor = sys.stdin.fileno()
        # A program in the background must leave the terminal to the one in front.
        if os.tcgetpgrp(descriptor) != os.getpgrp():
            raise OSError
        before = termios.tcgetattr(descriptor)
        # Unlike a raw terminal, this one still turns Ctrl-C into a signal.
        tty.setcbreak(descriptor)
    except no_terminal:
        yield False
        return
    try:
        print_stderr(OPERATOR_KEYS)
        yield True
    finally:
        with suppress(*no_terminal):  # a terminal that was closed has nothing to restore
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _listen(player: Player, at_once: bool) -> None:
    """Obey standard input until it ends, in a thread of its own: every key, or every line by its first letter."""
    try:
        # Past Python's buffer: this thread would hold its lock when the program ends.
        while typed := os.read(sys.stdin.fileno(), 1024).decode(errors="replace"):
            for given in typed if at_once else typed.splitlines():
                wish = OPERATOR_COMMANDS.get(given.strip().lower()[:1])
                if wish is not None:
                    getattr(player, wish)()
    except (OSError, ValueError, AttributeError):
        return
