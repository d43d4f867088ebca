"""Measurements of an OpenIGTLink server, such as 3D Slicer and PLUS: TRANSFORM for a tip, POINT for points."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.clock import RealClock
from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.hardware.sensing.source import Message, Remote
from ctr_nlp.support.extras import import_extra

IGTL_CONNECT_TIMEOUT_S = 3.0
"""s within which a server must answer."""


class Igtl(Remote):
    """A device of an OpenIGTLink server, named by the url; a transform's third axis is the tip's direction."""

    def __init__(self, sensing: Sensing) -> None:
        super().__init__(sensing)
        self._client: Any = None

    def open(self) -> None:
        """Start to listen; raises DeviceFault, and OptionError where pyigtl is missing."""
        client = import_extra("pyigtl").OpenIGTLinkClient
        clock = RealClock()
        self._client = client(self._sensing.address.host, self._sensing.address.port)
        end = clock.now() + IGTL_CONNECT_TIMEOUT_S
        while not self._client.is_connected():
            if clock.now() > end:
                self.close()
                raise DeviceFault(
                    f"no OpenIGTLink server answers at {self._sensing.url} within {IGTL_CONNECT_TIMEOUT_S:g} s"
                )
            clock.sleep(0.01)

    def _receive_messages(self) -> list[Message]:
        if self._client is None:  # closed, or not opened yet
            return []
        found = []
        for message in self._client.get_latest_messages():
            if message.device_name == self._sensing.address.rest:
                found += self._read(message)
            else:
                self.strange = f"a message of {message.device_name!r}"
        return found

    def _read(self, message: Any) -> list[Message]:
        """Return the message's values, or nothing where it is of another kind."""
        points = getattr(message, "positions", None)
        matrix = getattr(message, "matrix", None)
        if self._sensing.measures == "points" and points is not None:
            return [Message(np.array(points, dtype=float).ravel(), float(message.timestamp))]
        if self._sensing.measures != "points" and matrix is not None:
            frame = np.asarray(matrix, dtype=float)
            values = frame[:3, [3]] if self._sensing.measures == "tip" else frame[:3, [3, 2]]
            return [Message(values.T.ravel(), float(message.timestamp))]
        self.strange = f"a {type(message).__name__} of {message.device_name!r}, which does not measure this"
        return []

    def close(self) -> None:
        """Stop listening."""
        if self._client is not None:
            self._client.stop()
        self._client = None
