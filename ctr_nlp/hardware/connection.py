"""Where the motors' controller is, and how it is spoken to."""

from __future__ import annotations

from dataclasses import dataclass

from ctr_nlp.exceptions import HardwareError

DEVICES = ("simulated", "grbl", "ros2")
HOMING = ("manual", "cycle")
FLOW = ("count", "wait")


@dataclass(frozen=True)
class Connection:
    """Where the motors' controller is.

    device: "simulated", "grbl" or "ros2". url: a serial port, "socket://host:port", or for ros2 the controller's
    name. baud: of a serial port. homing: "cycle" lets the controller home itself and wants its soft limits,
    "manual" takes the position that it reports for true. flow: "count" sends lines as long as counted characters
    fit into the controller's buffer, "wait" sends a line when the one before was acknowledged. Raises
    HardwareError.
    """

    device: str = "simulated"
    url: str = ""
    baud: int = 115200
    homing: str = "manual"
    flow: str = "count"

    def __post_init__(self) -> None:
        for name, allowed in (("device", DEVICES), ("homing", HOMING), ("flow", FLOW)):
            if getattr(self, name) not in allowed:
                raise HardwareError(
                    f"{name} of the connection is {getattr(self, name)!r}; it must be {', '.join(allowed)}"
                )
        if self.device != "simulated" and not (isinstance(self.url, str) and self.url):
            raise HardwareError(f"url of the connection is {self.url!r}; a {self.device} device needs one")
        if isinstance(self.baud, bool) or not isinstance(self.baud, int) or self.baud <= 0:
            raise HardwareError(f"baud of the connection is {self.baud!r}; it must be a positive whole number")
