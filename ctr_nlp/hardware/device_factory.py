"""Devices, arms and memory that a hardware file names."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.address import canonical_address
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Connection, Hardware
from ctr_nlp.hardware.devices import Device
from ctr_nlp.hardware.devices.arms import ArmFollower, SimulatedArm
from ctr_nlp.hardware.devices.grbl.device import Grbl
from ctr_nlp.hardware.devices.ros2.device import Ros2
from ctr_nlp.hardware.devices.simulated import Simulated
from ctr_nlp.hardware.devices.ur import UrArm
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.link import ByteLink, RecordedLink, SerialLink
from ctr_nlp.hardware.playing.trust import Memory, state_folder
from ctr_nlp.typing import Array


def device_of(hardware: Hardware, journal: Journal, clock: Clock, position: Array) -> Device:
    """Return the device that a hardware file names, not connected yet.

    hardware: its connection says which. journal: records every byte or message. clock: of the player. position:
    (m,) where the axes of a simulated device stand, in their units. Raises HardwareError.
    """
    connection = hardware.connection
    if connection.device == "simulated":
        return Simulated(position, clock)
    if connection.device == "grbl":
        return Grbl(hardware, lambda: recorded_link(connection, journal), clock)
    if connection.device == "ros2":
        return Ros2(hardware, journal, clock)
    # Not a simulated device instead: it would report that a motion was played which no motor has made.
    raise HardwareError(f"device of the connection is {connection.device!r}, which device_of does not build")


def recorded_link(connection: Connection, journal: Journal) -> ByteLink:
    """Open a serial link to a Grbl controller of which every byte is recorded; raises DeviceFault.

    connection: gives url and baud. journal: where bytes are recorded.
    """
    return RecordedLink(SerialLink(connection.url, connection.baud), journal)


def memory_of(connection: Connection) -> Memory | None:
    """Return the memory of the device at a connection, None for a simulated one; raises HardwareError.

    connection: of the hardware file; its address names the memory.
    """
    if connection.device == "simulated":
        return None
    return Memory(state_folder(), canonical_address(connection), connection.url)


def arm_follower(
    arm: Arm, theta: Sequence[float] = (0.0, 0.0), clock: Callable[[], float] = time.monotonic
) -> ArmFollower:
    """Return the simulated or real arm that its description names.

    arm: description. theta: tilt (2,) rad at which a simulated arm stands. clock: returns the time, s.
    """
    return SimulatedArm(arm, theta, clock=clock) if arm.device == "simulated" else UrArm(arm, clock=clock)
