"""A small rig in virtual time: a short plan, hardware whose slides home, the emulated controller, and faults."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from emulator.firmware import Firmware
from emulator.wire import VirtualClock, Wire, WireFault

from ctr_nlp import table_i_robot
from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.axis import Axis
from ctr_nlp.hardware.description import Connection, Hardware
from ctr_nlp.hardware.devices.grbl.device import Grbl
from ctr_nlp.hardware.journal import Journal, read_journal
from ctr_nlp.hardware.link import RecordedLink
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.playback import Seen
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.results import Result
from ctr_nlp.hardware.playing.retract import retract
from ctr_nlp.hardware.playing.session import play_plan, prepare_trajectory, resume
from ctr_nlp.hardware.playing.trust import Memory, Remembered
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.simulation import shapes, tangents
from ctr_nlp.typing import Array


def plan_of(q: Array, dt: float, robot: Any = None) -> Plan:
    """A plan that moves a robot (the seed's) through q (T, 8) with dt s from frame to frame."""
    robot = table_i_robot() if robot is None else robot
    alpha, beta, theta = robot.split(q)
    frames = len(q)
    known, shape = np.zeros(frames), shapes(robot, q)
    ends = tangents(robot, q, np.ones(1))[:, 0]
    return Plan(
        time=dt * np.arange(1.0, frames + 1),
        alpha=alpha,
        beta=beta,
        theta=theta,
        target=shape,
        shape=shape,
        target_direction=ends,
        tip_direction=ends,
        solve_time=known,
        success=np.ones(frames, dtype=bool),
        objective=known,
        kkt=known,
        stability=np.full(frames, np.nan),
        stability_between=np.full(frames, np.nan),
        to_robot=np.eye(4),
        meta={
            "model": "dominant",
            "formulation": "joint",
            "solver": "none",
            "problem": {"name": "bench", "frames": frames, "duration": dt * frames, "deviation": 0.0},
            "robot": robot.to_dict(),
            "failures": {},
            "interrupted": False,
            "format": 1,
        },
    )


def sweep(frames: int = 20, dt: float = 0.1) -> Plan:
    """Tubes come out and turn, no two frames alike, one reversal among them."""
    t = np.linspace(0.0, 1.0, frames)[:, None]
    alpha = np.hstack([0.8 * t, -0.6 * np.sin(2.5 * t), 0.4 * t**2])
    beta = np.hstack([2 + 10 * t, 4 + 16 * t, 8 + 22 * t])
    return plan_of(np.hstack([alpha, beta, np.zeros((frames, 2))]), dt)


REACH = (50.0, 107.0, 150.0)
"""mm, of the seed's tubes."""


def homed_firmware() -> Firmware:
    """A controller that has homed its slides, with soft limits where their ranges end."""
    return Firmware({20: 1} | {130 + i: reach for i, reach in enumerate(REACH)}, homed=True)


def homing_hardware(**changes: Any) -> Hardware:
    """Slides that count down from their homing switches, as Grbl's do; turns that count up; a Grbl controller."""
    slides = [Axis(f"beta_{i + 1}", "XYZ"[i], "mm", (-REACH[i], 0.0), 50.0, 200.0, sign=-1) for i in range(3)]
    turns = [Axis(f"alpha_{i + 1}", "ABC"[i], "deg", (-360.0, 360.0), 600.0, 2000.0) for i in range(3)]
    connection = Connection("grbl", "wire:", homing="cycle")
    return replace(Hardware((*slides, *turns), None, connection, approach=1.0), **changes)


class WireLink:
    """A wire as a link; once dead, nothing that the player does gets through, as if its process were gone."""

    def __init__(self, wire: Wire) -> None:
        self.wire, self.dead = wire, False

    def write(self, data: bytes) -> None:
        """Send."""
        self._through(lambda: self.wire.write(data))

    def read(self) -> bytes:
        """Take what has come."""
        return bytes(self._through(lambda: self.wire.read(0.0)))

    def close(self) -> None:
        """Hang up."""
        self.wire.close()

    def _through(self, action: Any) -> Any:
        if self.dead:
            raise Killed
        try:
            return action()
        except ConnectionError as error:
            raise DeviceFault(str(error)) from error


class Killed(BaseException):
    """The process that plays is gone."""


@dataclass
class World:
    """One rig and whoever plays on it, one session after the other."""

    folder: Path
    plan: Plan = field(default_factory=sweep)
    hardware: Hardware = field(default_factory=homing_hardware)
    firmware: Firmware = field(default_factory=homed_firmware)
    clock: VirtualClock = field(default_factory=VirtualClock)
    state: Path | None = None
    """Where devices are remembered; None: they are not."""

    def __post_init__(self) -> None:
        self.path = self.folder / "journal.jsonl"
        self.links: list[WireLink] = []
        self.firmware.motion.lowest = self.firmware.position.tolist()
        self.firmware.motion.highest = self.firmware.position.tolist()

    def trajectory(self) -> Trajectory:
        """What is played."""
        return prepare_trajectory(self.plan, self.hardware)[0]

    def player(self, faults: tuple[WireFault, ...] = ()) -> Player:
        """A new session's."""
        journal = Journal(self.path, self.clock)

        def opened() -> RecordedLink:
            self.links.append(WireLink(Wire(self.firmware, self.clock, faults)))
            return RecordedLink(self.links[-1], journal)

        memory = None if self.state is None else self.memory(self.state)
        return Player(Grbl(self.hardware, opened, self.clock), None, journal, self.clock, memory)

    def memory(self, state: Path) -> Memory:
        """What is remembered of the device in a state folder."""
        return Memory(state, str(self.folder), self.hardware.connection.url, shared_folder=self.folder)

    def meet(self) -> None:
        """Let it be remembered that the device stands where it says, as after a session that ended well."""
        assert self.state is not None
        player = self.player()
        player.connect()
        self.memory(self.state).write(player.device.identity, Remembered(True))
        player.close()

    def begin(self, faults: tuple[WireFault, ...] = (), **options: Any) -> Result:
        """Play from the first frame."""
        self.latest = self.player(faults)
        return play_plan(self.latest, self.plan, self.hardware, **options)

    def retract(self, known: bool = True, **options: Any) -> Result:
        """Pull the tubes back, by the journal where that is known."""
        records = read_journal(self.path) if known else None
        self.latest = self.player()
        return retract(self.latest, self.plan, self.hardware, records, **options)

    def resume(
        self, faults: tuple[WireFault, ...] = (), verified: bool = False, callback: Seen | None = None
    ) -> Result:
        """Go on."""
        records = read_journal(self.path)
        self.latest = self.player(faults)
        return resume(self.latest, self.plan, self.hardware, records, verified=verified, callback=callback)

    def frames_played(self, within: float = 2e-4) -> list[int]:
        """Which frames' positions the controller finished lines at, to so many mm and deg, in order."""
        at_frames = np.round(self.trajectory().positions(self.trajectory().frame_time), 4)
        ends = np.array([target for _, target in self.firmware.executed_blocks]).reshape(-1, 6)
        order = [self.hardware.letters.index(letter) for letter in "XYZABC"]
        away = abs(ends[:, None, :] - at_frames[None, :, order]).max(axis=2)
        return [int(j) + 1 for row in away for j in np.flatnonzero(row < within)]

    def sent_bytes(self) -> int:
        """How many bytes players have sent so far, whether or not they arrived."""
        return sum(link.wire.line.sent_bytes for link in self.links)

    def within_limits(self) -> bool:
        """Whether no axis was ever beyond its range."""
        lowest, highest = self.firmware.extremes
        return all(
            lowest[i] >= axis.range[0] - 1e-3 and highest[i] <= axis.range[1] + 1e-3
            for i, axis in enumerate(self.hardware.axes)
        )
