"""Ctrl-C when a program is ready for it: CasADi may lose an interrupt that reaches it in the middle of a call."""

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
    """Hold Ctrl-C back within the block; what is yielded tells whether it was pressed.

    Blocks within blocks share one answer; a Ctrl-C that a program blocked while it was loading counts too. Only
    the main thread can do this; in others nothing is held back.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)
    if isinstance(before, _InterruptHandler):
        yield before.pressed.is_set
        return
    handler = _InterruptHandler(threading.Event())
    signal.signal(signal.SIGINT, handler)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        yield handler.pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def share_interrupt(pressed: _InterruptFlag) -> None:
    """Prepare a process that works for another one: a Ctrl-C sets `pressed`, the event that both share."""
    signal.signal(signal.SIGINT, _WorkerInterruptHandler(pressed))


def end_if_interrupted() -> None:
    """Raise KeyboardInterrupt where Ctrl-C was pressed and is held back: for when nothing is worth keeping."""
    with deferred_interrupt() as interrupted:
        if interrupted():
            raise KeyboardInterrupt


@contextmanager
def ignored_interrupt() -> Iterator[None]:
    """Within the block Ctrl-C does nothing: for what takes milliseconds and must not stop halfway."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
