"""Processes that may outlive the one that began them."""

from __future__ import annotations

import subprocess
from typing import Any


class Lasting(subprocess.Popen[Any]):
    """A process that nobody needs to wait for; Python warns of others that are left alone."""

    def __del__(self) -> None:
        """Nothing is to be done."""
