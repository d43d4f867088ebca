"""An emulator of 6-axis grblHAL firmware: what a player is tested against. Knows no plan."""

from emulator.faults import FAULTS, WireFault, fault
from emulator.firmware import Firmware
from emulator.serve import serving
from emulator.wire import VirtualClock, Wire

__all__ = ["FAULTS", "Firmware", "VirtualClock", "Wire", "WireFault", "fault", "serving"]
