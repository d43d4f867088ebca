"""ROS 2 messages without ROS: their types for CycloneDDS, and the two topics to and from a controller.

Message and topic names are those of rmw_cyclonedds: "rt/" before topics, "::dds_::" and a final "_" in types.
"""

from __future__ import annotations

import math
import re
import socket
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

LOOPBACK = "127.0.0.1"

CYCLONEDDS_CONFIGURATION = """<CycloneDDS><Domain Id="any">
<General>
<Interfaces><NetworkInterface address="{own}"/></Interfaces>
<AllowMulticast>false</AllowMulticast>
</General>
<Discovery>
<ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="{peer}"/></Peers>
</Discovery>
</Domain></CycloneDDS>"""
"""Configuration of CycloneDDS in place of the environment's: one interface, no multicast, one peer."""

LATEST = 100
"""Joint states that are kept from one read to the next."""

BLOCKED = 0.1
"""s that a writer may wait for room in its queue."""

ROS_MESSAGE_DECIMALS = 9
"""Digits after the decimal point in messages, in m, rad and s."""

_domains: WeakValueDictionary[int, Any] = WeakValueDictionary()
_configurations: dict[int, str] = {}


class ControllerAddress(NamedTuple):
    """Address of a controller.

    controller: full name, without a leading slash. host: on which it runs, "" for this one. domain: ROS_DOMAIN_ID.
    """

    controller: str
    host: str
    domain: int

    @property
    def trajectories(self) -> str:
        """The topic on which a joint_trajectory_controller takes trajectories."""
        return f"{self.controller}/joint_trajectory"

    @property
    def states(self) -> str:
        """The topic of the joint_state_broadcaster in the controller's namespace (use_local_topics: false)."""
        return "/".join([*self.controller.split("/")[:-1], "joint_states"])


class Points(NamedTuple):
    """A trajectory: time (N,) s from its start; position and velocity (N, m), in rad and m, and per s."""

    time: Array
    position: Array
    velocity: Array


class JointStates(NamedTuple):
    """A sensor_msgs/JointState as it came: stamp in s; velocity may be empty."""

    stamp: float
    name: list[str]
    position: list[float]
    velocity: list[float]


def parse_controller_url(url: str) -> ControllerAddress:
    """Parse "name", "name@host" or "name@host?domain=7"; raises HardwareError.

    url: of the connection in a hardware file.
    """
    name = r"[A-Za-z_]\w*"
    match = re.fullmatch(rf"/?({name}(?:/{name})*)(?:@([A-Za-z0-9.-]+))?(?:\?domain=(\d+))?", url)
    # DDS derives ports from the domain, 7400 + 250 domain, which ends below 65536 at 232.
    if match is None or int(match[3] or 0) > 232:
        raise HardwareError(
            f"url of the connection is {url!r}; for ros2 it must be a controller's name, optionally with its host "
            "and ROS domain (0 to 232): ctr_controller, ctr_controller@192.168.1.5, ctr_controller?domain=7"
        )
    return ControllerAddress(match[1], match[2] or "", int(match[3] or 0))


@cache
def types() -> SimpleNamespace:
    """Return the message types and their parts, by name; raises OptionError where cyclonedds is missing."""
    idl = import_extra("cyclonedds.idl")
    kinds = import_extra("cyclonedds.idl.types")

    known: dict[str, Any] = {}

    def struct(package: str, kind: str, /, **fields: Any) -> Any:
        known[kind] = idl.make_idl_struct(kind, f"{package}::msg::dds_::{kind}_", fields)
        return known[kind]

    def lists(*names: str) -> dict[str, Any]:
        return dict.fromkeys(names, kinds.sequence[kinds.float64])

    words = kinds.sequence[str]
    time = struct("builtin_interfaces", "Time", sec=kinds.int32, nanosec=kinds.uint32)
    duration = struct("builtin_interfaces", "Duration", sec=kinds.int32, nanosec=kinds.uint32)
    header = struct("std_msgs", "Header", stamp=time, frame_id=str)
    moving = lists("positions", "velocities", "accelerations", "effort")
    point = struct("trajectory_msgs", "JointTrajectoryPoint", **moving, time_from_start=duration)
    points = kinds.sequence[point]
    struct("trajectory_msgs", "JointTrajectory", header=header, joint_names=words, points=points)
    struct("sensor_msgs", "JointState", header=header, name=words, **lists("position", "velocity", "effort"))
    return SimpleNamespace(**known)


def trajectory_message(names: list[str], points: Points) -> Any:
    """Return a JointTrajectory that starts when it arrives, as its stamp is 0.

    names: of the m joints. points: in rad, m and s.
    """
    known = types()
    listed = [
        known.JointTrajectoryPoint(position, velocity, [], [], known.Duration(*divmod(round(time * 1e9), 10**9)))
        for time, position, velocity in zip(*(part.tolist() for part in points), strict=True)
    ]
    return known.JointTrajectory(known.Header(known.Time(0, 0), ""), names, listed)


def configuration(host: str) -> str:
    """Return CycloneDDS's configuration for a controller on a host; raises DeviceFault.

    host: "" for this machine. The interface is the one from which the host is reached. All that is sent leaves
    through it; what is bound to loopback, the system sends nowhere else.
    """
    if not host:
        return CYCLONEDDS_CONFIGURATION.format(own=LOOPBACK, peer=LOOPBACK)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            # Connecting a UDP socket sends nothing: the system only chooses the interface.
            probe.connect((host, 7400))
            return CYCLONEDDS_CONFIGURATION.format(own=probe.getsockname()[0], peer=probe.getpeername()[0])
    except OSError as exception:
        raise DeviceFault(f"host {host} of the ROS 2 controller is not to be reached: {exception}") from exception


def participant(address: ControllerAddress) -> tuple[Any, Any]:
    """Return a new DDS participant and its domain; keep both, as collecting the domain closes it.

    address: gives domain and host. Raises DeviceFault.
    """
    module = import_extra("cyclonedds.domain")
    failure = import_extra("cyclonedds.core").DDSException
    number = address.domain
    text = configuration(address.host)
    domain = _domains.get(number)
    if domain is not None and _configurations[number] != text:
        raise DeviceFault(f"ROS domain {number} is open in this program already, on another interface")
    try:
        if domain is None:
            domain = module.Domain(number, text)
            _domains[number], _configurations[number] = domain, text
        return module.DomainParticipant(number), domain
    except failure as exception:
        raise DeviceFault(f"ROS domain {number} cannot be opened: {exception}") from exception


def quality(reliable: bool, depth: int) -> Any:
    """Return the QoS of a writer or reader of XCDR1 messages, as ROS 2 sends them.

    reliable: whether lost messages are sent again. depth: messages that are kept.
    """
    core = import_extra("cyclonedds.core")
    policy = core.Policy
    most = import_extra("cyclonedds.util").duration(seconds=BLOCKED)
    return core.Qos(
        policy.Reliability.Reliable(most) if reliable else policy.Reliability.BestEffort,
        policy.Durability.Volatile,
        policy.History.KeepLast(depth),
        policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )


class Topics:
    """The two topics of one controller; every message is recorded. Raises DeviceFault and OptionError.

    Trajectories are sent reliably. States are read from reliable and from best-effort publishers: a lost one is
    followed by the next.
    """

    def __init__(self, address: ControllerAddress, journal: Journal) -> None:
        self.address = address
        self._journal = journal
        topic = import_extra("cyclonedds.topic").Topic
        known = types()
        failure = import_extra("cyclonedds.core").DDSException
        own, domain = participant(address)
        try:
            commands = topic(own, f"rt/{address.trajectories}", known.JointTrajectory)
            states = topic(own, f"rt/{address.states}", known.JointState)
            self._writer = import_extra("cyclonedds.pub").DataWriter(own, commands, quality(True, 1))
            self._reader = import_extra("cyclonedds.sub").DataReader(own, states, quality(False, LATEST))
        except failure as exception:
            raise DeviceFault(f"topics of {address.controller} cannot be opened: {exception}") from exception
        # CycloneDDS deletes an entity when its Python object is collected.
        self._held = [domain, own, commands, states]

    def listeners(self) -> int:
        """Return the number of subscribers to trajectories."""
        return len(self._call(self._writer.get_matched_subscriptions))

    def send(self, names: list[str], points: Points) -> None:
        """Record a trajectory, then publish it, to be started at once.

        names: of the m joints. points: in rad, m and s.
        """
        points = Points(*(np.round(part, ROS_MESSAGE_DECIMALS) for part in points))
        listed = {name: part.tolist() for name, part in points._asdict().items()}
        self._journal.record("sent", topic=f"/{self.address.trajectories}", joints=names, **listed)
        self._call(self._writer.write, trajectory_message(names, points))

    def states(self) -> list[JointStates]:
        """Return and record the joint states that have come since the last call, oldest first."""
        found = []
        for sample in self._call(self._reader.take, LATEST):
            if not isinstance(sample, types().JointState):
                continue
            stamp = sample.header.stamp.sec + 1e-9 * sample.header.stamp.nanosec
            state = JointStates(stamp, list(sample.name), list(sample.position), list(sample.velocity))
            told = {"name": state.name, "position": _finite(state.position), "velocity": _finite(state.velocity)}
            self._journal.record("received", topic=f"/{self.address.states}", stamp=stamp, **told)
            found.append(state)
        return found

    def _call(self, function: Any, *arguments: Any) -> Any:
        """Call a function of CycloneDDS; whatever it raises is raised as DeviceFault."""
        try:
            return function(*arguments)
        # Reading a malformed packet raises whatever its decoder runs into.
        except Exception as exception:
            raise DeviceFault(f"the connection to {self.address.controller} failed: {exception}") from exception

    def close(self) -> None:
        """Leave the domain; nothing is sent on the topics."""
        self._writer = self._reader = None
        self._held.clear()


def _finite(values: list[float]) -> list[float | None]:
    """Return rounded values, None for those that JSON does not have."""
    return [round(value, ROS_MESSAGE_DECIMALS) if math.isfinite(value) else None for value in values]
