"""Motors behind ROS 2: trajectories for a joint_trajectory_controller, followed on joint states; no ROS is needed.

Not yet tried with a real ROS 2 controller: with one that does in tests what ros2_controllers' source does.

Written for ros2_control's joint_trajectory_controller, which replaces what it plays by every trajectory that it
gets on /<controller>/joint_trajectory, from where it is then. Its joint_state_broadcaster (use_local_topics:
false, the default) tells on /joint_states, in the controller's namespace, where the joints are. The
controller's joints must be the robot's, in any order, and all of them: alpha_i in rad, of type revolute
(continuous ones would be wrapped), beta_i in m. The tilt is the arm's business.

A trajectory without points is no stop: newer controllers refuse it, older ones leave the last command standing,
a jump in speed. So a hold is a trajectory that goes on along the path and comes to rest, and the first point of
every trajectory lies ahead, for the controller to go to from its own place and speed.

Nothing is sent to other machines, nor by multicast, unless the hardware file names a host. The controller's
side must be found without multicast: ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST (ROS_LOCALHOST_ONLY=1 up to
Humble), or ROS_STATIC_PEERS with this machine's address. DDS has no passwords: who reaches these ports can tell
lies.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from ctr_nlp.errors import DeviceFault
from ctr_nlp.executor.clock import Clock
from ctr_nlp.executor.devices import Progress, Standing
from ctr_nlp.executor.devices.ros2_messages import JointStates, Points, Topics, address_of
from ctr_nlp.executor.hardware import Hardware
from ctr_nlp.executor.journal import Journal
from ctr_nlp.executor.program import Commands
from ctr_nlp.executor.way import Place, Way

Array = npt.NDArray[np.float64]

DISCOVERY = 5.0
"""s in which a controller must have been found, and have said where its joints are."""

SILENCE = 0.5
"""s without fresh joint states after which the controller counts as gone, or by which they may come late."""

DRIFT = 1e-3
"""By which part the controller's clock may run faster or slower than ours."""

REST = 0.05
"""s over which positions must agree for the joints to be at rest."""

STILL = 2.0
"""s in which a stop must have come to rest."""

BEHIND = 0.5
"""s that the joints may be behind their commands."""

SETTLE = 1.0
"""s after the end of a motion in which the joints may still creep to their goal."""

PARTS = 10.0
"""Into how many parts the axes' tolerances are divided for what positions must agree by; ROS tells no steps."""

FIRST = 0.1
"""s until the first point of a trajectory that is begun in motion: when it arrives, the controller is not quite
where it was thought to be."""

SECOND = 0.02
"""s until the first point of one that is begun at rest, on the way."""

CLOSE = 0.005
"""s by which the last point comes after the one before it."""

RAMPS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0)
"""s in which the pace may go to nothing, or come back; the first that the axes' accelerations allow is taken."""

STOP = 0.25
"""s that a stop takes at most, whatever the axes' accelerations are."""


class Ramp(NamedTuple):
    """A pace that changes steadily: begun (s of the clock) at a time of the program, from one pace to another."""

    begun: float
    start: float
    before: float
    after: float
    length: float

    def at(self, passed: Array) -> tuple[Array, Array]:
        """Times of the program, and the pace (N,), so many s (N,) after it was begun."""
        part = np.clip(passed / self.length, 0.0, 1.0)
        change = self.after - self.before
        time = self.start + self.length * part * (self.before + 0.5 * change * part)
        time += self.after * np.maximum(passed - self.length, 0.0)
        return time, self.before + change * part

    def when(self, time: Array) -> Array:
        """After how many s times (N,) of the program are reached; 0 for those before, inf for those never."""
        slope = (self.after - self.before) / self.length
        ahead = np.maximum(time - self.start, 0.0)
        root = np.sqrt(np.maximum(self.before**2 + 2.0 * slope * ahead, 0.0))
        total = np.where(self.before**2 + 2.0 * slope * ahead >= 0, self.before + root, 0.0)
        within = np.where(total > 0, 2.0 * ahead / np.where(total > 0, total, 1.0), np.inf)
        within = np.where(ahead > 0, within, 0.0)
        left = time - self.at(np.array([self.length]))[0]
        beyond = self.length + (left / self.after if self.after > 0 else np.full_like(left, np.inf))
        return np.where(within <= self.length, within, beyond)


class Track:
    """The path that a controller is to follow, from a position (m,) along commands, and its pace.

    It is at rest at both ends, overshoots no command, and is a cubic between commands, as the controller's is.
    """

    def __init__(self, start: Array, commands: Commands) -> None:
        self.ends = np.append(0.0, commands.time)
        points = np.vstack([start, commands.positions])
        chord = np.diff(points, axis=0) / np.diff(self.ends)[:, None]
        most = np.zeros_like(points)
        most[1:-1] = 3.0 * np.minimum(abs(chord[1:]), abs(chord[:-1])) * (chord[1:] * chord[:-1] > 0)
        slope = np.clip(CubicSpline(self.ends, points, bc_type="clamped")(self.ends, 1), -most, most)
        self._path = CubicHermiteSpline(self.ends, points, slope)
        self.end = float(self.ends[-1])
        self.ramp = Ramp(-np.inf, 0.0, 0.0, 0.0, 1.0)

    def now(self, clock: float) -> tuple[float, float]:
        """The time of the program and the pace at which the controller should be now (s of the clock)."""
        time, pace = self.ramp.at(np.array([clock - self.ramp.begun]))
        return min(float(time[0]), self.end), float(pace[0])

    def rests(self, clock: float) -> bool:
        """Whether the controller has nothing left to do."""
        time, pace = self.now(clock)
        return time >= self.end or (pace == 0.0 and self.ramp.after == 0.0)

    def position(self, time: float) -> Array:
        """Of the axes (m,), at a time of the program."""
        return np.asarray(self._path(time))

    def turn(self, clock: float, pace: float, acceleration: Array) -> None:
        """Let the pace go to another from now on, as fast as accelerations (m,) of the axes allow."""
        time, before = self.now(clock)
        for length in RAMPS:
            self.ramp = Ramp(clock, time, before, pace, length)
            at, running = self.ramp.at(np.linspace(0.0, length, 21))
            at = np.minimum(at, self.end)[:, None]
            needed = (
                self._path(at[:, 0], 2) * running[:, None] ** 2
                + self._path(at[:, 0], 1) * (pace - before) / length
            )
            if (abs(needed) <= acceleration).all() or (pace == 0.0 and length >= STOP):
                return

    def begin(self, clock: float) -> None:
        """Play from the start; the commands begin at rest."""
        self.ramp = Ramp(clock, 0.0, 1.0, 1.0, 1.0)

    def points(self) -> Points:
        """What is ahead from where the ramp begins, at rest at its end; time in s since then."""
        ramp = self.ramp
        passed = ramp.when(self.ends)
        if ramp.before < 1.0 or ramp.after < 1.0:
            passed = passed[passed > (FIRST if ramp.before > 0 else SECOND)]
        passed = passed[np.isfinite(passed) & (passed > 0)]
        if np.isinf(ramp.when(self.ends[-1:])[0]):
            passed = np.append(passed[passed < ramp.length - CLOSE], ramp.length)
        elif not len(passed):
            passed = ramp.when(self.ends[-1:])
        time, pace = self.ramp.at(passed)
        time = np.minimum(time, self.end)
        velocity = self._path(time, 1) * pace[:, None]
        velocity[-1] = 0.0
        return Points(passed, self._path(time), velocity)


class Ros2:
    """A joint_trajectory_controller, at hardware.connection.url: "name", "name@host", "name?domain=7".

    Axes stand where joint states say, and know it: homing is the controller's own. Raises HardwareError.
    """

    def __init__(self, hardware: Hardware, journal: Journal, clock: Clock) -> None:
        self._hardware, self._journal, self._clock = hardware, journal, clock
        self._address = address_of(hardware.connection.url)
        self._names = [axis.joint for axis in hardware.axes]
        self._zero = np.array([axis.zero for axis in hardware.axes])
        metres = [1e-3 if axis.joint.startswith("beta") else 1.0 for axis in hardware.axes]
        self._per_unit = np.array(metres) / [axis.scale for axis in hardware.axes]
        self._acceleration = np.array([axis.acceleration for axis in hardware.axes])
        self._topics: Topics | None = None
        self._track: Track | None = None

    # connecting

    def connect(self) -> None:
        """Open the topics; wait for a controller that listens, and for the first joint states."""
        self.close()
        self._topics = topics = Topics(self._address, self._journal)
        self._track, self._holding, self._strangers = None, False, ""
        self._seen: deque[tuple[float, Array]] = deque()
        self._speed = np.zeros(len(self._names))
        self._lag = np.inf
        self._stamp = self._stopped = -np.inf
        end = self._clock.now() + DISCOVERY
        while not (self._seen and topics.listeners()):
            self._take()
            if self._clock.now() > end:
                raise DeviceFault(self._missing(topics.listeners()))
            self._clock.sleep(0.01)

    def _missing(self, listeners: int) -> str:
        if not listeners:
            return f"nothing listens on /{self._address.trajectories}: no controller was found in {DISCOVERY:g} s"
        told = f"only {self._strangers} can be heard there" if self._strangers else "nothing can be heard there"
        return f"no joint states of {', '.join(self._names)} on /{self._address.states}: {told}"

    @property
    def resolution(self) -> Array:
        """A tenth of the axes' tolerances (m,): ROS does not tell what they can tell apart."""
        return np.asarray(self._hardware.tolerance / PARTS)

    def standing(self) -> Standing:
        """Where it stands."""
        if not self._rested(self._clock.now() + SILENCE):
            raise DeviceFault("the joints move; they must stand still before anything is played")
        return Standing(self._seen[-1][1], self._hardware.connection.homing == "manual")

    def home(self, stop: Callable[[], bool]) -> None:
        """A controller in ROS 2 homes by itself."""
        raise DeviceFault("a ROS 2 controller homes by its own means: connection.homing must be manual")

    # hearing

    def _take(self) -> None:
        """Take the joint states that have come, and make sure of them."""
        known = self._open().states()
        ours = [state for state in known if set(state.name) & set(self._names)]
        if known and not ours:
            self._strangers = ", ".join(known[-1].name[:6])
        fresh = [self._add(state) for state in ours]
        if any(fresh):
            now = self._clock.now()
            late = now - self._seen[-1][0]
            self._lag = min(late, self._lag + DRIFT * max(now - self._stamp, 0.0))
            if late - self._lag > SILENCE:
                raise DeviceFault(f"joint states come {late - self._lag:.2g} s later than they did at first")
            self._stamp = now

    def _add(self, state: JointStates) -> bool:
        """Keep a state, unless it is not newer than the last and tells nothing."""
        if len(state.position) != len(state.name) or len(state.velocity) not in (0, len(state.name)):
            raise DeviceFault(
                f"a joint state has {len(state.name)} names, {len(state.position)} positions and "
                f"{len(state.velocity)} velocities"
            )
        for name in self._names:
            if state.name.count(name) != 1:
                raise DeviceFault(
                    f"a joint state of {', '.join(state.name)} has {name} {state.name.count(name)} times"
                )
        columns = [state.name.index(name) for name in self._names]
        position = np.array(state.position)[columns]
        if not np.isfinite(position).all():
            raise DeviceFault(
                f"{self._names[int(np.isfinite(position).argmin())]} is not a number in a joint state"
            )
        position = self._zero + position / self._per_unit
        if self._seen and state.stamp <= self._seen[-1][0]:
            return False
        if state.velocity and np.isfinite(state.velocity).all():
            self._speed = np.array(state.velocity)[columns] / self._per_unit
        elif self._seen:
            self._speed = (position - self._seen[-1][1]) / (state.stamp - self._seen[-1][0])
        self._seen.append((state.stamp, position))
        while len(self._seen) > 2 and self._seen[1][0] <= state.stamp - REST:
            self._seen.popleft()
        return True

    def _watch(self, now: float) -> None:
        """Whether a controller is there and tells where its joints are."""
        if now - self._stamp > SILENCE:
            raise DeviceFault(
                f"no fresh joint states have come for {SILENCE:g} s: nobody knows where the joints are"
            )
        if not self._open().listeners():
            raise DeviceFault(f"nothing listens on /{self._address.trajectories} any more: the controller is gone")

    def _still(self) -> bool:
        """Whether all positions of the last REST s agree."""
        if len(self._seen) < 3 or self._seen[-1][0] - self._seen[0][0] < REST:
            return False
        return bool((np.ptp([position for _, position in self._seen], axis=0) <= self.resolution).all())

    def _rested(self, end: float) -> bool:
        """Wait until the joints are at rest, at most until the clock shows end; whether they are."""
        while True:
            self._take()
            now = self._clock.now()
            self._watch(now)
            if now >= self._stopped and self._still():
                return True
            if now > end:
                return False
            self._clock.sleep(0.005)

    # playing

    def start(self, commands: Commands) -> None:
        """Begin to play commands from where it stands."""
        self._take()
        position = self._seen[-1][1]
        self._way = Way(position, commands, self._hardware.tolerance)
        self._place, self._holding = Place(0.0, 0.0, 0, 0.0), False
        self._track = Track(position, commands)
        self._track.begin(self._clock.now())
        self._send(self._track.points())
        self._track.begin(self._clock.now())

    def _send(self, points: Points) -> None:
        ros = (points.position - self._zero) * self._per_unit
        self._open().send(self._names, Points(points.time, ros, points.velocity * self._per_unit))

    def update(self) -> Progress:
        """Take what has come and find out how far it is."""
        track = self._playing()
        before = self._stamp
        self._take()
        now = self._clock.now()
        self._watch(now)
        position = self._seen[-1][1]
        if self._stamp > before:
            self._follow(track, position)
        state = self._state(track, position, now)
        time, _, line, away = self._place
        if state == "done":
            time, line = track.end, len(track.ends) - 1
        return Progress(state, time, line, position, self._stamp, away)

    def _follow(self, track: Track, position: Array) -> None:
        """Find where on its way the newest state shows it, and see that it is not left behind."""
        due, _ = track.now(self._stamp)
        ahead = int(np.searchsorted(track.ends[1:], due + FIRST, "right")) + 1
        last = min(ahead, len(track.ends) - 1)
        place = self._way.nearest(position, max(self._place.line - 1, 0), last)
        self._place = max(self._place, place, key=lambda known: known.time)._replace(away=place.away)
        off = abs(position - track.position(due)) / self._hardware.tolerance
        if due - self._place.time > BEHIND and off.max() > 1.0:
            axis = self._hardware.axes[int(off.argmax())]
            raise DeviceFault(
                f"the controller does not follow: it is {due - self._place.time:.2g} s behind, axis {axis.letter} "
                f"({axis.joint}) {off.max():.3g} tolerances from its command"
            )

    def _state(self, track: Track, position: Array, now: float) -> str:
        time, _ = track.now(now)
        if time >= track.end:
            near = (abs(position - track.position(track.end)) <= self.resolution).all()
            over = now - track.ramp.begun - float(track.ramp.when(np.array([track.end]))[0])
            return "done" if self._still() and (near or over > SETTLE) else "running"
        if self._holding:
            return "held" if track.rests(now) and self._still() else "holding"
        return "running"

    # stopping

    def hold(self) -> None:
        """Come to rest on the path, as fast as the axes' accelerations allow."""
        self._turn(0.0)

    def resume(self) -> None:
        """Go on from there, from rest to the commands' pace."""
        self._turn(1.0)

    def _turn(self, pace: float) -> None:
        """Let the rest be played at another pace."""
        track, now = self._playing(), self._clock.now()
        self._holding = pace == 0.0
        if track.now(now)[0] < track.end and track.ramp.after != pace:
            track.turn(now, pace, self._acceleration)
            self._stopped = now + track.ramp.length
            self._send(track.points())
            if track.ramp.before == 0.0:
                track.ramp = track.ramp._replace(begun=self._clock.now())

    def abort(self) -> Standing:
        """Stop, on the path where it is on it, and wait for rest; raises DeviceFault where that is not sure."""
        track, self._track = self._track, None
        if track is None:
            self._rested(self._clock.now() + 2 * REST)
        now = self._clock.now()
        if track is None or not self._on(track, now):
            self._stop_there(now)
        elif not track.rests(now) and track.ramp.after != 0.0:
            track.turn(now, 0.0, self._acceleration)
            self._stopped = now + track.ramp.length
            self._send(track.points())
        if not self._rested(self._clock.now() + STILL):
            raise DeviceFault(
                f"the joints have not come to rest in {STILL:g} s: their position is not to be trusted"
            )
        return self.standing()

    def _on(self, track: Track, now: float) -> bool:
        """Whether the joints were last seen on their way, and not too far behind."""
        due, _ = track.now(min(now, self._stamp))
        return self._place.away <= 1.0 and due - self._place.time <= BEHIND

    def _stop_there(self, now: float) -> None:
        """Come to rest from the measured position and speed, whatever the controller plays."""
        length = max(RAMPS[0], min(STOP, float((abs(self._speed) / self._acceleration).max())))
        self._stopped = now + length
        goal = self._seen[-1][1] + 0.5 * length * self._speed
        self._send(Points(np.array([length]), goal[None], np.zeros((1, len(goal)))))

    def close(self) -> None:
        """Leave; nothing is sent."""
        if self._topics is not None:
            self._topics.close()
        self._topics = None

    def _open(self) -> Topics:
        if self._topics is None:
            raise DeviceFault("the ROS 2 device is not connected")
        return self._topics

    def _playing(self) -> Track:
        if self._track is None:
            raise DeviceFault("the ROS 2 device plays nothing")
        return self._track
