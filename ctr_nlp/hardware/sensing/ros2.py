"""Measurements of a ROS 2 topic, in m: geometry_msgs/PoseStamped for a tip or pose, PoseArray for points.

As the device for ROS 2 it needs no ROS, and must be discovered in the same way (devices/ros2/device.py).
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.devices.ros2.messages import LATEST, parse_controller_url, participant, quality, types
from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.hardware.sensing.source import Message, Remote
from ctr_nlp.support.extras import import_extra

MM_PER_M = 1e3


@cache
def geometry() -> SimpleNamespace:
    """Return types of geometry_msgs, by name; raises OptionError where cyclonedds is missing."""
    idl = import_extra("cyclonedds.idl")
    kinds = import_extra("cyclonedds.idl.types")
    known: dict[str, Any] = {}

    def struct(kind: str, /, **fields: Any) -> Any:
        known[kind] = idl.make_idl_struct(kind, f"geometry_msgs::msg::dds_::{kind}_", fields)
        return known[kind]

    point = struct("Point", **dict.fromkeys("xyz", kinds.float64))
    quaternion = struct("Quaternion", **dict.fromkeys("xyzw", kinds.float64))
    pose = struct("Pose", position=point, orientation=quaternion)
    header = types().Header
    struct("PoseStamped", header=header, pose=pose)
    struct("PoseArray", header=header, poses=kinds.sequence[pose])
    return SimpleNamespace(**known)


class Topic(Remote):
    """A topic named by the url, with a host or a domain as the url of a controller may have."""

    def __init__(self, sensing: Sensing) -> None:
        super().__init__(sensing)
        self._held: list[Any] = []

    def open(self) -> None:
        """Start to listen; raises DeviceFault, OptionError and HardwareError."""
        address = parse_controller_url(self._sensing.address.rest)
        kind = self._kind
        failure = import_extra("cyclonedds.core").DDSException
        own, domain = participant(address)
        try:
            topic = import_extra("cyclonedds.topic").Topic(own, f"rt/{address.controller}", kind)
            reader = import_extra("cyclonedds.sub").DataReader(own, topic, quality(False, LATEST))
        except failure as exception:
            raise DeviceFault(f"topic {address.controller} cannot be opened: {exception}") from exception
        self._held = [domain, own, topic, reader]

    @property
    def _kind(self) -> Any:
        return geometry().PoseArray if self._sensing.measures == "points" else geometry().PoseStamped

    def _receive_messages(self) -> list[Message]:
        try:
            samples = self._held[-1].take(LATEST) if self._held else []
        except Exception as exception:
            self.strange = f"no more: {exception}"
            return []
        return [self._read(sample) for sample in samples if isinstance(sample, self._kind)]

    def _read(self, sample: Any) -> Message:
        """Return the values of a sample in mm, and its stamp, None where that is 0."""
        poses = sample.poses if self._sensing.measures == "points" else [sample.pose]
        values = [[MM_PER_M * getattr(pose.position, axis) for axis in "xyz"] for pose in poses]
        if self._sensing.measures == "pose":
            # A quaternion (x, y, z, w) of zeros is a message whose sender knows no orientation: its direction is
            # missing.
            turned = [getattr(poses[0].orientation, axis) for axis in "xyzw"]
            values.append(Rotation.from_quat(turned).as_matrix()[:, 2].tolist() if any(turned) else [np.nan] * 3)
        stamp = sample.header.stamp.sec + 1e-9 * sample.header.stamp.nanosec
        return Message(np.array(values).ravel(), stamp or None)

    def close(self) -> None:
        """Stop listening."""
        self._held = []
