"""Motors behind ROS 2: trajectories for a joint_trajectory_controller, observed by joint states; no ROS is needed.

Not yet tried with a real ROS 2 controller, only with an emulated one that follows ros2_controllers' source.

Written for ros2_control's joint_trajectory_controller, which replaces what it plays by every trajectory that it
gets on /<controller>/joint_trajectory, from where it is then. Its joint_state_broadcaster (use_local_topics:
false, the default) publishes on /joint_states, in the controller's namespace, where the joints are. The
controller's joints must be the robot's, in any order, and all of them: alpha_i in rad, of type revolute
(continuous ones would be wrapped), beta_i in m. The arm that tilts the robot is another device.

Nothing is sent to other machines, nor by multicast, unless the hardware file names a host. The controller's side
must be found without multicast: ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST (ROS_LOCALHOST_ONLY=1 up to Humble), or
ROS_STATIC_PEERS with this machine's address. DDS has no passwords: whoever reaches these ports can send false
states.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Asked, MotionProgress, Standing
from ctr_nlp.hardware.devices.ros2.joints import MAX_JOINT_STATE_SILENCE_S, REST, Joints
from ctr_nlp.hardware.devices.ros2.messages import Points, Topics, parse_controller_url
from ctr_nlp.hardware.devices.ros2.track import FIRST_POINT_DELAY_IN_MOTION_S, ControllerTrack, stop_there
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.lookahead import Commands, FollowedPath, PathPlace
from ctr_nlp.typing import Array

DISCOVERY = 5.0
"""s in which a controller must have been found, and have published where its joints are."""

ROS_STOP_TIMEOUT_S = 2.0
"""s in which a stop must have come to rest."""

BEHIND = 0.5
"""s that the joints may be behind their commands."""

LAPSE = 0.05
"""s that may pass between reading committed_time and sending amended commands."""

ROS_GOAL_SETTLING_TIME_S = 1.0
"""s after the end of a motion in which the joints may still creep to their goal."""

RESOLUTIONS_PER_TOLERANCE = 10.0
"""The axes' tolerances divided by this are their resolution, since ROS does not report the size of steps."""


class Ros2:
    """A joint_trajectory_controller, at hardware.connection.url: "name", "name@host", "name?domain=7".

    Axes stand where joint states say, and count as homed: homing is the controller's own. Raises HardwareError.
    """

    def __init__(self, hardware: Hardware, journal: Journal, clock: Clock) -> None:
        self._hardware = hardware
        self._journal = journal
        self._clock = clock
        self._address = parse_controller_url(hardware.connection.url)
        self._acceleration = hardware.each("acceleration")
        self._topics: Topics | None = None
        self._track: ControllerTrack | None = None

    def connect(self, stop: Asked = lambda: False) -> None:
        """Open the topics; wait for a controller that listens, and for the first joint states.

        stop: called meanwhile; where it returns True, DeviceFault is raised.
        """
        self.close()
        self._topics = topics = Topics(self._address, self._journal)
        self._track = None
        self._holding = False
        self._joints = Joints(self._hardware, self.resolution)
        self._stopped = -np.inf
        end = self._clock.now() + DISCOVERY
        while not (self._joints.has_state and topics.listeners()):
            self._take()
            if stop():
                raise DeviceFault("a stop was asked for before the controller was found: nothing was sent")
            if self._clock.now() > end:
                raise DeviceFault(self._missing(topics.listeners()))
            self._clock.sleep(0.01)

    def _missing(self, listeners: int) -> str:
        if not listeners:
            return f"nothing listens on /{self._address.trajectories}: no controller was found in {DISCOVERY:g} s"
        heard = self._joints.strangers
        told = f"only {heard} can be heard there" if heard else "nothing can be heard there"
        return f"no joint states of {', '.join(self._joints.names)} on /{self._address.states}: {told}"

    @property
    def identity(self) -> str:
        """Names of the joints that the controller moves."""
        return ", ".join(axis.joint for axis in self._hardware.axes)

    @property
    def resolution(self) -> Array:
        """A tenth of the axes' tolerances (m,), in their units, since ROS does not report their resolution."""
        return np.asarray(self._hardware.tolerance / RESOLUTIONS_PER_TOLERANCE)

    def standing(self) -> Standing:
        """Return where the axes stand; raises DeviceFault where they move."""
        if not self._wait_for_rest(self._clock.now() + MAX_JOINT_STATE_SILENCE_S):
            raise DeviceFault("the joints move; they must stand still before anything is played")
        return Standing(self._joints.position, self._hardware.connection.homing == "manual")

    def home(self, stop: Asked) -> None:
        """Raise HardwareError, since a controller in ROS 2 homes by itself; stop is not called."""
        raise HardwareError("a ROS 2 controller homes by its own means: connection.homing must be manual")

    def _take(self) -> None:
        """Read the joint states that have come."""
        self._joints.take(self._open().states(), self._clock.now())

    def _watch(self, now: float) -> None:
        """Raise DeviceFault unless a controller listens and joint states are fresh; now: s of the clock."""
        self._joints.check_fresh(now)
        if not self._open().listeners():
            raise DeviceFault(f"nothing listens on /{self._address.trajectories} any more: the controller is gone")

    def _wait_for_rest(self, end: float) -> bool:
        """Wait until the joints are at rest, at most until the clock shows end; return whether they are."""
        while True:
            self._take()
            now = self._clock.now()
            self._watch(now)
            if now >= self._stopped and self._joints.still():
                return True
            if now > end:
                return False
            self._clock.sleep(0.005)

    def start(self, commands: Commands) -> Ros2:
        """Begin to play commands from where the axes stand."""
        self._take()
        position = self._joints.position
        self._path = FollowedPath(position, commands, self._hardware.tolerance)
        self._place = PathPlace(0.0, 0.0, 0, 0.0)
        self._holding = False
        self._track = ControllerTrack(position, commands)
        self._track.begin(self._clock.now())
        self._send(self._track.points())
        # The controller starts when the trajectory arrives, after the time that sending took.
        self._track.begin_ramp(self._clock.now())
        return self

    def _send(self, points: Points) -> None:
        self._open().send(self._joints.names, self._joints.in_ros(points))

    def update(self) -> MotionProgress:
        """Read the joint states that have come and return the progress."""
        track = self._playing()
        before = self._joints.stamp
        self._take()
        now = self._clock.now()
        self._watch(now)
        position = self._joints.position
        if self._joints.stamp > before:
            self._follow(track, position)
        state = self._state(track, position, now)
        time = track.end if state == "done" else self._place.time
        return MotionProgress(state, time, position, self._joints.stamp, self._place.away)

    def feed(self) -> None:
        """Do nothing, since the controller has the whole trajectory."""

    @property
    def committed_time(self) -> float:
        """Time of the motion, s, of the first point of a trajectory that would replace the present one."""
        return self._playing().now(self._clock.now())[0] + FIRST_POINT_DELAY_IN_MOTION_S + LAPSE

    def amend(self, commands: Commands) -> None:
        """Replace the trajectory; in a hold, the new one is sent when it is resumed.

        commands: the same as before up to committed_time.
        """
        self._track = track = ControllerTrack(self._path.points[0], commands, self._playing().ramp)
        self._path = FollowedPath(self._path.points[0], commands, self._hardware.tolerance)
        if not self._holding:
            self._play_at(1.0, track, self._clock.now())

    def _follow(self, track: ControllerTrack, position: Array) -> None:
        """Find where on the path the newest state (m,) is, and raise DeviceFault where it has fallen behind."""
        due, _ = track.now(self._joints.stamp)
        ahead = int(np.searchsorted(track.ends[1:], due + FIRST_POINT_DELAY_IN_MOTION_S, "right")) + 1
        last = min(ahead, len(track.ends) - 1)
        place = self._path.nearest(position, max(self._place.line - 1, 0), last)
        self._place = max(self._place, place, key=lambda known: known.time)._replace(away=place.away)
        off = abs(position - track.position(due)) / self._hardware.tolerance
        if due - self._place.time > BEHIND and off.max() > 1.0:
            axis = self._hardware.axes[int(off.argmax())]
            raise DeviceFault(
                f"the controller does not follow: it is {due - self._place.time:.2g} s behind, axis {axis.letter} "
                f"({axis.joint}) {off.max():.3g} tolerances from its command"
            )

    def _state(self, track: ControllerTrack, position: Array, now: float) -> str:
        time, _ = track.now(now)
        if time >= track.end:
            near = (abs(position - track.position(track.end)) <= self.resolution).all()
            over = now - track.ramp.begun - float(track.ramp.when(np.array([track.end]))[0])
            return "done" if self._joints.still() and (near or over > ROS_GOAL_SETTLING_TIME_S) else "running"
        if self._holding:
            return "held" if track.rests(now) and self._joints.still() else "holding"
        return "running"

    def hold(self) -> None:
        """Come to rest on the path, as fast as the axes' accelerations allow."""
        self._change_pace(0.0)

    def resume(self) -> None:
        """Continue from a hold, from rest to the commands' pace."""
        self._change_pace(1.0)

    def _change_pace(self, pace: float) -> None:
        """Play the rest at another pace, 0 for a hold or 1."""
        track = self._playing()
        now = self._clock.now()
        self._holding = pace == 0.0
        if track.now(now)[0] < track.end and track.ramp.after != pace:
            self._play_at(pace, track, now)
            if track.ramp.before == 0.0:
                track.begin_ramp(self._clock.now())

    def _play_at(self, pace: float, track: ControllerTrack, now: float) -> None:
        track.turn(now, pace, self._acceleration)
        self._stopped = now + track.ramp.length
        self._send(track.points())

    def abort(self) -> Standing:
        """Stop and wait for rest, on the path if the joints are on it; raises DeviceFault without rest."""
        track = self._track
        self._track = None
        if track is None:
            self._wait_for_rest(self._clock.now() + 2 * REST)
        now = self._clock.now()
        # A stop on the path would make joints that are off it jump back: they come to rest straight ahead.
        if track is None or not self._is_on_path(track, now):
            points = stop_there(self._joints.position, self._joints.speed, self._acceleration)
            self._stopped = now + float(points.time[-1])
            self._send(points)
        elif not track.rests(now) and track.ramp.after != 0.0:
            self._play_at(0.0, track, now)
        if not self._wait_for_rest(self._clock.now() + ROS_STOP_TIMEOUT_S):
            raise DeviceFault(
                f"the joints have not come to rest in {ROS_STOP_TIMEOUT_S:g} s: their position is not to be "
                f"trusted"
            )
        return self.standing()

    def _is_on_path(self, track: ControllerTrack, now: float) -> bool:
        """Return whether the joints were last seen on their path, and not too far behind."""
        due, _ = track.now(min(now, self._joints.stamp))
        return self._place.away <= 1.0 and due - self._place.time <= BEHIND

    def close(self) -> None:
        """Leave the topics; nothing is sent."""
        if self._topics is not None:
            self._topics.close()
        self._topics = None

    def _open(self) -> Topics:
        if self._topics is None:
            raise DeviceFault("the ROS 2 device is not connected")
        return self._topics

    def _playing(self) -> ControllerTrack:
        if self._track is None:
            raise DeviceFault("the ROS 2 device plays nothing")
        return self._track
