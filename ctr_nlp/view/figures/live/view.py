"""A window in a process of its own, which shows states of a program that never waits for it.

The program's thread leaves its newest state in a queue of one; a sender thread takes it from there, pickles it and
writes it to the window's standard input. A window that is slow, hangs or is closed holds up the sender only.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, Protocol

from matplotlib.figure import Figure

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.pool import DetachedProcess

WINDOW_MODULE = "ctr_nlp.view.figures.live.window"
"""The module that runs in the window's process."""
PAUSE = 0.04
"""Pause between two states that are sent, s."""
LAST_STATE_TIMEOUT_S = 2.0
"""Time for which the end of the block waits until the last state has been sent."""


class Picture(Protocol):
    """Content of a window. It is pickled before `begin` is called, and drawn in the window's process."""

    size: tuple[float, float]
    """Width and height of the window, inches."""

    def begin(self, figure: Figure) -> None:
        """Draw everything that no state changes into `figure`."""
        ...

    def show(self, state: Any) -> None:
        """Change the picture to a state."""
        ...


class LiveWindow:
    """Window with a picture, which shows the newest state; it skips those for which it has no time.

    Whatever becomes of the window, the program continues. Where the block of `with` ends well the window stays
    until it is closed, with the last state in it, though the program may end; else it closes.
    """

    def __init__(self, picture: Picture) -> None:
        """Open the window on `picture`; raises OptionError where that cannot be done."""
        self._process = DetachedProcess(
            [sys.executable, "-m", WINDOW_MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,  # nothing is left to be flushed into a window that hangs
            start_new_session=True,  # Ctrl-C and the terminal's end are not for the window
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._pipe = self._process.stdin
        # A queue of one: a new state replaces the one that was not sent. Append and pop of a deque need no lock.
        self._states = deque[Callable[[], Any]](maxlen=1)
        self._news = threading.Event()
        self._ending = False
        self._sender = threading.Thread(target=self._send, daemon=True)
        # The window answers `open:` or `not:` with a reason, and closes its side; read() returns then, or when the
        # process ends.
        with self._process.stdout as words:
            with suppress(OSError):
                self._send_object(picture)
            opened, _, why = words.read().decode(errors="replace").partition(":")
        if opened != "open":
            self._end()
            raise OptionError(
                f"live needs a window, and none opens: {why or 'its process ended'}; install tkinter or PyQt6, or "
                "use ssh -X, or set MPLBACKEND=WebAgg, which shows it in a browser where tornado is installed"
            )
        self._sender.start()

    def show(self, state: Callable[[], Any]) -> None:
        """Show what `state` returns, unless a newer one comes first; it is called in the sender thread, if
        at all.
        """
        self._states.append(state)
        self._news.set()

    def __enter__(self) -> LiveWindow:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self._ending = True
        self._news.set()
        if kind is None:
            # A window that hangs must not keep the program from ending: the sender is a daemon thread.
            self._sender.join(LAST_STATE_TIMEOUT_S)
        else:
            self._end()

    def _send(self) -> None:
        """Send the newest state to the window, in a thread of its own, until the block of `with` ends."""
        with suppress(OSError):
            # Until a state that came last has been sent, too. A closed window breaks the pipe, an OSError.
            while not self._ending or self._states:
                self._news.wait()
                self._news.clear()
                if self._states:
                    self._send_object(self._states.pop()())
                    time.sleep(PAUSE)
        with suppress(OSError):
            self._pipe.close()

    def _send_object(self, what: Any) -> None:
        """Send an object to the window's process, pickled; blocks while the pipe is full."""
        # A write to a pipe may take a part of the bytes only.
        left = memoryview(pickle.dumps(what))
        while left:
            left = left[os.write(self._pipe.fileno(), left) :]

    def _end(self) -> None:
        """Close the window at once, by ending its process."""
        self._process.kill()
        self._process.wait()
        with suppress(OSError):
            self._pipe.close()
