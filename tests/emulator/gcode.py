"""What the firmware reads: its receive buffer, and G-code as words and modal state."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, replace

RX_BYTES = 1023
RETURN, NEWLINE = 0x0D, 0x0A

EMULATED_AXIS_LETTERS = "XYZABC"
LINEAR = 3
"""The first axes are in mm (or inches); the others are in degrees, whatever the units."""

BAD_LETTER, BAD_NUMBER, NEGATIVE = 1, 2, 4
UNSUPPORTED, SAME_GROUP, NO_FEED, AXIS_CONFLICT, REPEATED, LINE_NUMBER = 20, 21, 22, 24, 25, 27
NO_MOTION_MODE, NO_PLANE_WORDS, UNUSED = 31, 35, 36
HIGHEST_LINE = 9_999_999

GCODE_MODAL_GROUPS: dict[float, str] = {
    code: group
    for group, codes in {
        "motion": (0, 1, 80),
        "feed mode": (93, 94),
        "distance": (90, 91),
        "units": (20, 21),
        "once": (4, 53),
        "plane": (17, 18, 19),
        "system": (54,),
        "radius": (40,),
        "length": (49,),
        "path": (61,),
        "arc distance": (91.1,),
    }.items()
    for code in codes
}
IGNORED_M = (3, 4, 5, 7, 8, 9)
ENDING_M = (2, 30)
WORD = re.compile(r"([A-Z])([^A-Z]*)")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)$")


class ReceiveBuffer:
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
    def unfinished_bytes(self) -> int:
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


class Refused(Exception):
    """A line that the firmware answers with an error number."""

    def __init__(self, number: int) -> None:
        super().__init__(f"error:{number}")
        self.number = number


@dataclass(frozen=True)
class Modal:
    """What lasts from line to line. feed: mm/min in G94, 1/min in G93; 0 where none was given."""

    motion: int = 0
    inverse_time: bool = False
    absolute: bool = True
    inches: bool = False
    feed: float = 0.0


@dataclass(frozen=True)
class GcodeLine:
    """A line read: its modal state after it, and what it asks for once.

    axes: value by axis index, mm or deg. dwell: s. ends: whether it is the program's end.
    """

    modal: Modal
    axes: dict[int, float]
    number: int | None = None
    dwell: float = 0.0
    ends: bool = False


def words(text: str) -> list[tuple[str, float]]:
    """Letters and numbers of a line, without comments and blanks. Raises Refused."""
    text = re.sub(r"\(.*?\)|;.*|[\s/%]|[^\x00-\x7f]", "", text).upper()
    found, at = [], 0
    for match in WORD.finditer(text):
        letter, digits = match.groups()
        if match.start() != at:
            break
        at = match.end()
        if not NUMBER.match(digits):
            head = re.match(r"[+-]?\d*\.?\d*", digits)
            raise Refused(BAD_LETTER if head and re.search(r"\d", head.group()) else BAD_NUMBER)
        found.append((letter, float(digits)))
    if at != len(text):
        raise Refused(BAD_LETTER)
    return found


def read(text: str, modal: Modal, jog: bool = False) -> GcodeLine:
    """A line in the light of what came before. Raises Refused with the firmware's error number."""
    values: dict[str, float] = {}
    groups: set[str] = set()
    codes: dict[str, float] = {}
    ends = False
    for letter, value in words(text):
        if letter == "G":
            group = GCODE_MODAL_GROUPS.get(value)
            if value in (2, 3):
                raise Refused(NO_PLANE_WORDS)
            if group is None:
                raise Refused(UNSUPPORTED)
            if group in groups:
                raise Refused(AXIS_CONFLICT if group == "motion" else SAME_GROUP)
            groups.add(group)
            codes[group] = value
        elif letter == "M":
            if value not in (*IGNORED_M, *ENDING_M):
                raise Refused(UNSUPPORTED)
            ends = ends or value in ENDING_M
        else:
            if letter in values:
                raise Refused(REPEATED)
            if letter in "FNPST" and value < 0:
                raise Refused(NEGATIVE)
            values[letter] = value
    if values.get("N", 0) > HIGHEST_LINE:
        raise Refused(LINE_NUMBER)
    if jog:
        modal = replace(modal, motion=1, inverse_time=False, feed=0.0)
    return _build_line(modal, codes, values, ends, jog)


def _build_line(
    modal: Modal, codes: dict[str, float], values: dict[str, float], ends: bool, jog: bool
) -> GcodeLine:
    axes = {i: values.pop(letter) for i, letter in enumerate(EMULATED_AXIS_LETTERS) if letter in values}
    number = values.pop("N", None)
    feed = values.pop("F", None)
    dwell = values.pop("P", 0.0) if codes.get("once") == 4 else 0.0
    if values.keys() - {"S", "T"}:
        raise Refused(UNUSED)
    motion = int(codes.get("motion", modal.motion))
    inverse_time = codes.get("feed mode", 93 if modal.inverse_time else 94) == 93
    absolute = codes.get("distance", 90 if modal.absolute else 91) == 90
    inches = codes.get("units", 20 if modal.inches else 21) == 20
    if axes and motion == 80:
        raise Refused(NO_MOTION_MODE)
    kept = 0.0 if inverse_time != modal.inverse_time else modal.feed
    scale = 25.4 if inches else 1.0
    if feed is not None:
        kept = feed if inverse_time else feed * scale
    feeds = motion == 1 and (bool(axes) or jog or (inverse_time and "motion" in codes))
    if feeds and (kept <= 0 or (inverse_time and feed is None)):
        raise Refused(NO_FEED)
    axes = {i: value * (scale if i < LINEAR else 1.0) for i, value in axes.items()}
    after = Modal(motion, inverse_time, absolute, inches, kept)
    return GcodeLine(after, axes, None if number is None else int(number), dwell, ends)
