"""The receive buffer of the firmware, and the lines that are read out of it."""

from __future__ import annotations

from collections import deque

RX_BYTES = 1023
RETURN, NEWLINE = 0x0D, 0x0A


class Lines:
    """Bytes that have come, and the line that is being read. CR, LF or both end a line."""

    def __init__(self) -> None:
        self._buffer: deque[int] = deque()
        self._line = bytearray()
        self._after_return = False

    @property
    def waiting(self) -> int:
        """Bytes in the buffer."""
        return len(self._buffer)

    @property
    def begun(self) -> int:
        """Bytes read of a line whose end has not come."""
        return len(self._line)

    @property
    def free(self) -> int:
        """Bytes for which the buffer has room."""
        return RX_BYTES - len(self._buffer)

    def put(self, byte: int) -> bool:
        """Append a byte; False where it is lost because the buffer is full."""
        if not self.free:
            return False
        self._buffer.append(byte)
        return True

    def take(self) -> str | None:
        """The next line, without its end and blanks around it; None where its end has not come."""
        while self._buffer:
            byte = self._buffer.popleft()
            after_return, self._after_return = self._after_return, byte == RETURN
            if byte == NEWLINE and after_return:
                continue
            if byte not in (NEWLINE, RETURN):
                self._line.append(byte)
                continue
            text = self._line.decode("ascii", "replace").strip()
            self._line.clear()
            return text
        return None

    def clear(self) -> None:
        """Forget everything."""
        self._buffer.clear()
        self._line.clear()
