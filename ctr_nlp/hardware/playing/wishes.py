"""What is asked of a player while it works: pause, resume or abort."""

from __future__ import annotations

from queue import Empty, SimpleQueue

from ctr_nlp.hardware.journal import Journal


class Wishes:
    """Wishes from anywhere, also from other threads and signal handlers; the last counts, but an abort is final.

    latest: "" for none, "pause", "resume" or "abort", as of the last look. Each is in the journal once it is seen.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal, self._queue = journal, SimpleQueue[str]()
        self.latest = ""

    def ask(self, wish: str) -> None:
        """Ask for something."""
        self._queue.put(wish)

    def aborted(self) -> bool:
        """Look at what has been asked for; whether an abort has."""
        while True:
            try:
                wish = self._queue.get_nowait()
            except Empty:
                return self.latest == "abort"
            self._journal.record("wish", wish=wish)
            if self.latest != "abort":
                self.latest = wish

    def granted(self) -> None:
        """What was wished for has been done."""
        self.latest = ""

    def stopped(self) -> None:
        """An abort has been carried out; other wishes hold for what is played next."""
        if self.latest == "abort":
            self.granted()
