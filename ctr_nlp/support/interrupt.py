"""Deferred Ctrl-C: CasADi may lose an interrupt that reaches it in the middle of a call.

A handler remembers the first Ctrl-C; loops ask between steps whether it was pressed, and end with what they have.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol


class _InterruptFlag(Protocol):
    """A flag that remembers a Ctrl-C: an event of this process, or one that several share."""

    def is_set(self) -> bool: ...

    def set(self) -> None: ...


class _InterruptHandler:
    """A signal handler that remembers the first Ctrl-C; a second one interrupts at once."""

    def __init__(self, pressed: _InterruptFlag) -> None:
        self.pressed = pressed

    def __call__(self, number: int, frame: Any) -> None:
        if self.pressed.is_set():
            raise KeyboardInterrupt
        self.pressed.set()


class _WorkerInterruptHandler(_InterruptHandler):
    """A signal handler in a process that works for another, which alone decides when to end at once."""

    def __call__(self, number: int, frame: Any) -> None:
        self.pressed.set()


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defer Ctrl-C within the block; yield a function that returns whether it was pressed.

    Nested blocks share one flag. A Ctrl-C that the program blocked while it was loading (cli/main.py) counts as
    well. Only the main thread can install signal handlers; in other threads nothing is deferred, and the function
    returns False.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)
    if isinstance(before, _InterruptHandler):
        # An outer block is active: its flag is shared, so that one Ctrl-C ends all blocks.
        yield before.pressed.is_set
        return
    handler = _InterruptHandler(threading.Event())
    signal.signal(signal.SIGINT, handler)
    if hasattr(signal, "pthread_sigmask"):
        # The kernel delivers an interrupt that is pending since the program was loaded as soon as it is unblocked.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        yield handler.pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def share_interrupt(pressed: _InterruptFlag) -> None:
    """Make Ctrl-C in this worker process set `pressed`, an event that it shares with the process it works for."""
    signal.signal(signal.SIGINT, _WorkerInterruptHandler(pressed))


def end_if_interrupted() -> None:
    """Raise KeyboardInterrupt where a deferred Ctrl-C was pressed: for work of which no part is worth keeping."""
    with deferred_interrupt() as interrupted:
        if interrupted():
            raise KeyboardInterrupt


@contextmanager
def ignored_interrupt() -> Iterator[None]:
    """Ignore Ctrl-C within the block: for work that takes milliseconds and must not stop halfway."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
