"""The hardware file (TOML): which axis moves which joint, how far and how fast, and where the device is."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import numpy as np

from ctr_nlp.exceptions import HardwareError, RobotError, suggest_names
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.axis import Axis, apply_axis_limits, check_fit
from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.plan.backlash import BacklashAndDrag
from ctr_nlp.robot import Robot
from ctr_nlp.support.mistaken_files import HARDWARE_FILE, name_other_kind
from ctr_nlp.support.value_checks import build_from_table, check_keys, number, read_toml
from ctr_nlp.typing import Array

MOTOR_DEVICES = ("simulated", "grbl", "ros2")
HOMING_METHODS = ("manual", "cycle")
FLOW = ("count", "wait")
NETWORK_SCHEMES = ("socket", "rfc2217")

HARDWARE_FILE_KEYS = ("name", "robot", "axes", "arm", "connection", "sensing", "lag", "approach", "late")
"""Top-level keys of a hardware file."""


@dataclass(frozen=True)
class Connection:
    """Where the motors' controller is.

    device: "simulated", "grbl" or "ros2". url: a serial port, "socket://host:port", "rfc2217://host:port", or for
    ros2 the controller's name. baud: of a serial port. homing: "cycle" lets the controller home itself and wants
    its soft limits, "manual" believes the position that it reports. flow: "count" sends lines as long as
    counted characters fit into the controller's buffer, "wait" sends a line when the one before was acknowledged.
    Raises HardwareError.
    """

    device: str = "simulated"
    url: str = ""
    baud: int = 115200
    homing: str = "manual"
    flow: str = "count"

    def __post_init__(self) -> None:
        for name, allowed in (("device", MOTOR_DEVICES), ("homing", HOMING_METHODS), ("flow", FLOW)):
            if getattr(self, name) not in allowed:
                raise HardwareError(
                    f"{name} of the connection is {getattr(self, name)!r}; it must be one of {', '.join(allowed)}"
                    f"{suggest_names(getattr(self, name), allowed)}"
                )
        if self.device != "simulated" and not (isinstance(self.url, str) and self.url):
            raise HardwareError(f"url of the connection is {self.url!r}; a {self.device} device needs one")
        if self.device == "grbl" and "://" in self.url:
            self._check_network_url()
        if isinstance(self.baud, bool) or not isinstance(self.baud, int) or self.baud <= 0:
            raise HardwareError(f"baud of the connection is {self.baud!r}; it must be a positive whole number")

    def _check_network_url(self) -> None:
        """Raise HardwareError unless the url names a host and a port, and so one device."""
        try:
            parts = urlsplit(self.url)
            known = parts.scheme in NETWORK_SCHEMES and parts.hostname and parts.port
        except ValueError:
            known = False
        if not known:
            raise HardwareError(
                f"url of the connection is {self.url!r}; it must be the path of a serial port, such as "
                "/dev/ttyUSB0, or a host and its port, such as socket://192.168.1.5:23; schemes are "
                f"{', '.join(NETWORK_SCHEMES)}"
            )


def commissioned_file(hardware_file: str | Path) -> Path:
    """Return the path of the commissioning record that lies beside a hardware file.

    hardware_file: path of the TOML file.
    """
    return Path(hardware_file).with_suffix(".commissioned.json")


class Commissioned(NamedTuple):
    """The record of a commissioning.

    Attributes
    ----------
    settings : dict of str to str
        The controller's settings by name, as it reported them.
    untried : tuple of str or None
        Letters of the axes that were not moved in both directions; None in records of old versions, which do not
        say.
    """

    settings: dict[str, str]
    untried: tuple[str, ...] | None


def read_commissioned(hardware_file: str | Path) -> Commissioned | None:
    """Read the record of a rig's commissioning; None where it has not been commissioned.

    hardware_file: path of the rig's TOML file. Raises HardwareError where the record cannot be read.
    """
    path = commissioned_file(hardware_file)
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        settings = {str(name): str(value) for name, value in record["settings"].items()}
        untried = tuple(map(str, record["untried"])) if "untried" in record else None
        return Commissioned(settings, untried)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as exception:
        raise HardwareError(
            f"commissioning record {path} cannot be read ({exception}); delete it and run "
            "`ctr-nlp commission` again"
        ) from exception


def commissioned_text(settings: dict[str, str], identity: str, untried: Sequence[str] = ()) -> str:
    """The text of the record of a commissioning.

    Parameters
    ----------
    settings : dict of str to str
        The controller's settings by name.
    identity : str
        The controller's description of itself, :attr:`Identity.description`.
    untried : sequence of str
        Letters of the axes that were not moved in both directions.

    Returns
    -------
    str
        JSON, which :func:`read_commissioned` reads.
    """
    return json.dumps({"controller": identity, "settings": settings, "untried": list(untried)}, indent=1) + "\n"


@dataclass(frozen=True)
class Hardware:
    """Axes, one for every alpha and beta of a robot, an arm that tilts it or None, and the connection.

    approach: part of the largest speeds at which the robot goes to the first frame. robot: whose tubes are
    mounted; plans for others are refused, None takes any. late: s that a motion may be behind its schedule.
    commissioned: the controller's settings by name when the rig was commissioned; None where it was not. sensing:
    what measures the robot, None for nothing. lag: backlash and drag between motors and tubes, compensated by the
    motors; None for none. untried: letters of axes that were not moved when the rig was commissioned, None where
    the record does not say. Raises HardwareError.
    """

    axes: tuple[Axis, ...]
    arm: Arm | None = None
    connection: Connection = field(default_factory=Connection)
    approach: float = 0.2
    robot: Robot | None = None
    late: float = 1.0
    commissioned: dict[str, str] | None = None
    # Fields out of repr stay out of the rig's digest (motion.trajectory.digests), which resume compares: sensors
    # may change between sessions, and files without a lag keep the digest that they had before there were lags.
    sensing: Sensing | None = field(default=None, repr=False)
    lag: BacklashAndDrag | None = field(default=None, repr=False)
    untried: tuple[str, ...] | None = field(default=(), repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(self.axes))
        for name in ("joint", "letter"):
            values = [getattr(axis, name) for axis in self.axes]
            double = [value for value in values if values.count(value) > 1]
            if double:
                raise HardwareError(f"{name} {double[0]} is given to {len(double)} axes; give it to one")
        number(HardwareError, "approach", self.approach, lambda part: 0 < part <= 1, "lie in (0, 1]")
        number(
            HardwareError, "late", self.late, lambda late: 0 < late < math.inf, "be a positive number of seconds"
        )

    def each(self, name: str) -> Array:
        """Return a number of every axis (m,); name: of the field of Axis."""
        return np.array([getattr(axis, name) for axis in self.axes])

    @cached_property
    def letters(self) -> tuple[str, ...]:
        """Letters of the axes, in order."""
        return tuple(axis.letter for axis in self.axes)

    @cached_property
    def backlash(self) -> Array:
        """Play of the axes' drives (m,), in their units."""
        return self.each("backlash")

    @cached_property
    def tolerance(self) -> Array:
        """Largest distance of the axes (m,) from their commands, in their units."""
        return self.each("tolerance")

    def apply_limits(self, robot: Robot) -> Robot:
        """Return the robot with limits that these axes and the arm satisfy, too; raises HardwareError."""
        check_fit(robot, self.axes, self.robot)
        if self.lag is not None:
            self.lag.check(robot)
        return apply_axis_limits(robot, self.axes, self.arm, self.connection.device == "grbl")

    def positions(self, robot: Robot, q: Array) -> Array:
        """Return the positions (.., m) of the axes, in their units, of a robot at q (.., 2d + 2).

        robot: whose joints q are, which names the columns.
        """
        columns = [robot.axes.index(axis.joint) for axis in self.axes]
        return np.asarray(self.each("zero") + self.each("scale") * q[..., columns])

    def lag_compensation(self, robot: Robot, q: Array, time: Array) -> Array:
        """Return what motors turn further, (T, m) in the axes' units, so that lagging tubes pass through q.

        robot: whose tubes lag. q: (T, 2d + 2). time: (T,) s at which the tubes pass.
        """
        if self.lag is None:
            return np.zeros((len(q), len(self.axes)))
        return self.positions(robot, self.lag.compensate_motion(robot, q, time)) - self.positions(robot, q)

    def joints(self, robot: Robot, positions: Array, theta: Array) -> Array:
        """Return q (.., 2d + 2) of a robot whose axes stand at positions (.., m), in their units.

        robot: names the columns of q. theta: tilt (.., 2) rad, which no axis measures.
        """
        q = self.in_joints(robot, positions - self.each("zero"))
        q[..., -2:] = theta
        return q

    def in_joints(self, robot: Robot, lengths: Array) -> Array:
        """Convert changes of axes to changes of q (.., 2d + 2), in which the tilt is 0.

        robot: names the columns of q. lengths: changes (.., m) of the axes, in their units.
        """
        q = np.zeros((*np.shape(lengths)[:-1], 2 * robot.d + 2))
        q[..., [robot.axes.index(axis.joint) for axis in self.axes]] = lengths / self.each("scale")
        return q

    def reach(self, robot: Robot) -> tuple[Array, Array]:
        """Return the least and the largest q (2d + 2,) in the axes' ranges; infinite for joints without axis.

        robot: names the columns of q.
        """
        least, most = np.full((2, 2 * robot.d + 2), [[-np.inf], [np.inf]])
        for axis in self.axes:
            i = robot.axes.index(axis.joint)
            least[i], most[i] = sorted((end - axis.zero) / axis.scale for end in axis.range)
        return least, most

    @classmethod
    def from_toml(cls, path: str | Path) -> Hardware:
        """Read a hardware file.

        path: of the TOML file; paths in it are relative to its folder. Raises HardwareError, also where the axes
        cannot move the robot that it names.
        """
        try:
            data = read_toml(path)
            check_keys(HardwareError, "hardware", data, HARDWARE_FILE_KEYS)
            if not isinstance(data.get("axes"), list):
                raise HardwareError("hardware needs a list of axes, [[axes]] in TOML")
            if not isinstance(data.get("robot", ""), str):
                raise HardwareError(f"robot is {data['robot']!r}; it must be the name of a robot file")
            record = read_commissioned(path)
            hardware = cls(
                tuple(build_from_table(Axis, axis) for axis in data["axes"]),
                build_from_table(Arm, data["arm"]) if "arm" in data else None,
                build_from_table(Connection, data.get("connection", {})),
                data.get("approach", cls.approach),
                Robot.from_toml(Path(path).parent / data["robot"]) if "robot" in data else None,
                data.get("late", cls.late),
                None if record is None else record.settings,
                build_from_table(Sensing, data["sensing"]) if "sensing" in data else None,
                build_from_table(BacklashAndDrag, data["lag"], "lag") if "lag" in data else None,
                () if record is None else record.untried,
            )
            if hardware.robot is not None:
                hardware.apply_limits(hardware.robot)
            return hardware
        except (RobotError, HardwareError) as exception:
            other = name_other_kind(path, HARDWARE_FILE)
            raise HardwareError(f"hardware file {path}: {other or exception}") from exception


def simulated_hardware(robot: Robot) -> Hardware:
    """Return a simulated rig for a robot of up to three tubes, used where no hardware file is given.

    50 mm/s and 200 mm/s^2, 600 deg/s and 2000 deg/s^2. Raises HardwareError.
    """
    if robot.d > 3:
        raise HardwareError(f"a robot of {robot.d} tubes needs a hardware file; there is a default for up to 3")
    numbers_of = range(1, robot.d + 1)
    # A straight outer tube may have a larger limit than the innermost one, which alone gives the reach.
    travel = float(robot.split(robot.upper)[1].max())
    slides = [Axis(f"beta_{i}", "XYZ"[i - 1], "mm", (0.0, travel), 50.0, 200.0) for i in numbers_of]
    turns = [Axis(f"alpha_{i}", "ABC"[i - 1], "deg", (-1080.0, 1080.0), 600.0, 2000.0) for i in numbers_of]
    return Hardware((*slides, *turns), Arm())
