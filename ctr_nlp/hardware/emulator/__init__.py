"""An emulator of 6-axis grblHAL firmware: what a player is tested against. Knows no plan."""

from ctr_nlp.hardware.emulator.faults import FAULTS, WireFault, fault
from ctr_nlp.hardware.emulator.firmware import Firmware
from ctr_nlp.hardware.emulator.serve import serving
from ctr_nlp.hardware.emulator.wire import VirtualClock, Wire

__all__ = ["FAULTS", "Firmware", "VirtualClock", "Wire", "WireFault", "fault", "serving"]
