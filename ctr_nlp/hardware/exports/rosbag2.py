"""A trajectory as a ROS 2 bag: the message for a joint_trajectory_controller, and joint states over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import BPoly, CubicHermiteSpline

from ctr_nlp.exceptions import OptionError
from ctr_nlp.hardware.motion.lookahead import MAX_PIECE_DURATION_S
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

STORAGES = ("mcap", "sqlite3")
"""Storage formats of bags: ROS records mcap since Iron; Humble reads sqlite3 without a plugin."""

JOINT_TRAJECTORY_TOPIC, JOINT_STATES_TOPIC = "/ctr/joint_trajectory", "/ctr/joint_states"

BAG_FORMAT_VERSION = 8
"""Version of the bag's format, the last whose metadata Humble can read, too."""

BAG_INTERPOLATION_TOLERANCE_MM = 0.005
"""mm, with angles counted as in the motion term, by which interpolated points may differ from the trajectory."""

INTERPOLATION_CHECK_FRACTIONS = np.linspace(0.0, 1.0, 9)[1:-1]


def write_bag(trajectory: Trajectory, title: str, folder: Path, storage: str = "mcap") -> None:
    """Write a trajectory as a ROS 2 bag, a folder that must not exist yet; raises OptionError.

    trajectory: as played. title: of the plan. folder: path of the bag. storage: one of STORAGES.

    The JointTrajectory message has the points of points(); joint states come with the commands. Positions are
    joints in rad and metres, not positions of axes: sign, zero and backlash are the driver's. Tilts are included
    where the hardware has an arm. Times count from the start of the motion, in stamps as in the bag.
    """
    if storage not in STORAGES:
        raise OptionError(f"storage is {storage!r}; it must be {' or '.join(STORAGES)}")
    bags = import_extra("rosbags.rosbag2")
    typesys = import_extra("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.LATEST)
    with bags.Writer(
        folder, version=BAG_FORMAT_VERSION, storage_plugin=bags.StoragePlugin[storage.upper()]
    ) as bag:
        bag.set_custom_data("ctr_nlp.plan", title)
        bag.set_custom_data("ctr_nlp.digest", trajectory.digests.plan)
        for topic, messages in (
            (JOINT_TRAJECTORY_TOPIC, [(0.0, _trajectory_message(store.types, trajectory))]),
            (JOINT_STATES_TOPIC, _states(store.types, trajectory)),
        ):
            kind = messages[0][1].__msgtype__
            connection = bag.add_connection(topic, kind, typestore=store)
            for time, message in messages:
                bag.write(connection, round(time * 1e9), store.serialize_cdr(message, kind))


def _trajectory_message(make: Any, trajectory: Trajectory) -> Any:
    """Return the JointTrajectory message; make: message types by name."""
    joints, scale = _joints(trajectory)
    listed = []
    for time, *parts in zip(*points(trajectory), strict=True):
        moving = scale * np.stack(parts)[:, : len(joints)]
        since = _stamp(make, "Duration", time)
        listed.append(make["trajectory_msgs/msg/JointTrajectoryPoint"](*moving, np.zeros(0), since))
    header = make["std_msgs/msg/Header"](stamp=_stamp(make, "Time", 0.0), frame_id="")
    return make["trajectory_msgs/msg/JointTrajectory"](header=header, joint_names=joints, points=listed)


def _states(make: Any, trajectory: Trajectory) -> list[tuple[float, Any]]:
    """Return joint states and their times in s, at the start and at the end of every command."""
    joints, scale = _joints(trajectory)
    times = np.append(0.0, trajectory.commands().time)
    found = []
    for time, *parts in zip(times, *trajectory.at(times)[:2], strict=True):
        position, velocity = scale * np.stack(parts)[:, : len(joints)]
        header = make["std_msgs/msg/Header"](stamp=_stamp(make, "Time", time), frame_id="")
        state = make["sensor_msgs/msg/JointState"](header, joints, position, velocity, effort=np.zeros(0))
        found.append((float(time), state))
    return found


def _stamp(make: Any, kind: str, time: float) -> Any:
    seconds, rest = divmod(round(time * 1e9), 10**9)
    return make[f"builtin_interfaces/msg/{kind}"](sec=seconds, nanosec=rest)


def points(trajectory: Trajectory) -> tuple[Array, Array, Array, Array]:
    """Return times (N,), q, velocities and accelerations (N, 2d + 2), in s, rad, mm, with frames among them.

    The times are so dense that cubic and quintic interpolation both stay within BAG_INTERPOLATION_TOLERANCE_MM of
    the trajectory: a controller does the first with velocities, the second with accelerations, too.
    """
    longest = float("inf")
    while True:
        time = np.append(0.0, trajectory.commands(longest).time)
        q, velocity, acceleration = trajectory.at(time)
        curves = (
            CubicHermiteSpline(time, q, velocity),
            BPoly.from_derivatives(time, np.stack([q, velocity, acceleration], axis=1)),
        )
        places = (time[:-1, None] + np.diff(time)[:, None] * INTERPOLATION_CHECK_FRACTIONS).ravel()
        true = trajectory.at(places)[0]
        if (
            max(abs((curve(places) - true) * trajectory.robot.mm_per_unit).max() for curve in curves)
            <= BAG_INTERPOLATION_TOLERANCE_MM
        ):
            return time, q, velocity, acceleration
        longest = min(MAX_PIECE_DURATION_S, longest / 2)


def _joints(trajectory: Trajectory) -> tuple[list[str], Array]:
    """Return names (n,) of the joints that the hardware moves, and ROS units per unit of ours (n,)."""
    names = list(trajectory.robot.axes[: None if trajectory.hardware.arm is not None else -2])
    return names, np.array([1e-3 if name.startswith("beta") else 1.0 for name in names])
