"""The [sensing] table of a hardware file: what sensors measure, how well, in which frame, and from where."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import HardwareError, OptionError
from ctr_nlp.hardware.arm.description import all_numbers, frame_of, some_numbers
from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.identify.closed_loop.sensors.points import ShapePointSensor, TipPoseSensor, TipPositionSensor
from ctr_nlp.typing import Array

SENSOR_MEASURES = ("tip", "pose", "points")

URLS = "simulated, simulated:SEED, udp://HOST:PORT, tcp://HOST:PORT, igtl://HOST:PORT/DEVICE or ros2://TOPIC"


class SensorAddress(NamedTuple):
    """Address of a source of measurements.

    kind: the url's scheme, or "simulated". host, port: for udp, tcp and igtl. rest: TOPIC and more for ros2,
    DEVICE for igtl, SEED; or "".
    """

    kind: str
    host: str = ""
    port: int = 0
    rest: str = ""


def parse_sensor_url(url: str) -> SensorAddress:
    """Parse the url of a sensor; raises HardwareError.

    url: as URLS.
    """
    told = str(url)
    plain = re.fullmatch(r"simulated(?::(\d{1,18}))?", told)
    if plain:
        return SensorAddress("simulated", rest=plain[1] or "0")
    topic = re.fullmatch(r"ros2://([A-Za-z_/][\w/]*(?:@[A-Za-z0-9.-]+)?(?:\?domain=\d+)?)", told)
    if topic:
        return SensorAddress("ros2", rest=topic[1])
    network = re.fullmatch(r"(udp|tcp|igtl)://([A-Za-z0-9.-]+):(\d{1,5})(?:/([\w .-]+))?", told)
    if network and 0 < int(network[3]) < 65536 and (network[1] == "igtl") == bool(network[4]):
        return SensorAddress(network[1], network[2], int(network[3]), network[4] or "")
    raise HardwareError(f"url of the sensor is {url!r}; it must be {URLS}")


@dataclass(frozen=True)
class Sensing:
    """Sensors of the robot's shape, and the source of their measurements.

    url: as URLS. measures: "tip" for its position, "pose" for position and direction, "points" for points of the
    shape at places, numbers from 0 at the insertion point to 1 at the tip. deviation: standard deviation of each
    coordinate, mm; turn: of the direction, rad. delay: s by which a measurement without a time is old when it is
    sent. translation, rotation_deg: of the sensor's frame in the robot's base frame, mm and (roll, pitch, yaw).
    Raises HardwareError.
    """

    url: str = "simulated"
    measures: str = "tip"
    places: tuple[float, ...] = ()
    deviation: float = 0.5
    turn: float = 0.02
    delay: float = 0.0
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        parse_sensor_url(self.url)
        if self.measures not in SENSOR_MEASURES:
            raise HardwareError(
                f"measures of the sensor is {self.measures!r}; it must be {', '.join(SENSOR_MEASURES)}"
            )
        if (self.measures == "points") != bool(len(self.places)):
            raise HardwareError(
                f'places of the sensor are {list(self.places)}; give them with measures = "points", and only then'
            )
        for name in ("translation", "rotation_deg"):
            object.__setattr__(self, name, all_numbers(f"{name} of the sensor", getattr(self, name), 3))
        if not 0 <= some_numbers("delay of the sensor", self.delay, 1)[0] < 1:
            raise HardwareError(f"delay of the sensor is {self.delay!r} s; it must lie in [0, 1)")
        object.__setattr__(self, "places", tuple(self.places))
        try:
            self.sensors  # noqa: B018
        except OptionError as exception:
            raise HardwareError(str(exception)) from exception

    @cached_property
    def address(self) -> SensorAddress:
        """Address of the source of measurements."""
        return parse_sensor_url(self.url)

    @cached_property
    def sensors(self) -> Sensors:
        """Description of the sensors for observers."""
        if self.measures == "points":
            return Sensors(ShapePointSensor(self.places, self.deviation))
        if self.measures == "pose":
            return Sensors(TipPoseSensor(self.deviation, self.turn))
        return Sensors(TipPositionSensor(self.deviation))

    def to_base_frame(self, values: Array) -> Array:
        """Convert values (m,) from the sensor's frame to the robot's base frame.

        values: points in mm, and of a pose a direction after the point.
        """
        frame = frame_of(self.translation, self.rotation_deg)
        triads = values.reshape(-1, 3)
        turned = triads @ frame[:3, :3].T
        # The direction of a pose is turned with the frame, and not moved.
        points = len(turned) - (self.measures == "pose")
        turned[:points] += frame[:3, 3]
        return np.asarray(turned.ravel())
