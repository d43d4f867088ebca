"""Interface to a program that wraps another laboratory's forward model: numbers as text, both ways.

It reads from its standard input: the number of tubes d and of configurations n; for each tube, outermost first,
its length and curved length (mm), curvature (1/mm), outer and inner diameter (mm), Young's modulus (MPa) and
Poisson's ratio; for each configuration alpha_1..d (rad), beta_1..d (mm) and the force at the tip (3, N, in the
base frame).
It writes a line for each configuration: the seconds that the model took; its own measure of stability, positive
where stable, or nan; the number of points m, 0 where the model was not solved; and m times arc length from the
insertion point, x, y and z, in mm.

All in the convention of this library, to which such a program converts. Most other models differ:

- Most count tubes from the innermost, in metres and pascals.
- Most use the position of a tube's base, beta - length, which is negative, instead of the extension of its tip.
- Most give pre-curvature as a Darboux vector along x, so that a tube at angle 0 bends towards -y. Here it bends
  towards +x: their angle is ours plus a quarter turn, and points and forces stay as they are.
- None knows a tilt of the base: theta is 0.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

PEER_PROGRAM_TIMEOUT_S = 600.0
"""Time limit of a program for all configurations, s."""


class PeerSolution(NamedTuple):
    """A peer's solution for one configuration.

    seconds: time of the solution. stability: the peer's own measure, positive where stable, or NaN. arc_length
    (m,), points (m, 3): mm, empty where it is not solved.
    """

    seconds: float
    stability: float
    arc_length: Array
    points: Array


def format_input(robot: Robot, q: Array, force: Sequence[float] = (0.0, 0.0, 0.0)) -> str:
    """Write a program's input for configurations q (n, 2d + 2) of a robot, with a tip force (3,), N.

    Raises OptionError where a tube's pre-curvature varies or turns, or q has a tilt, which other models do not
    know.
    """
    if not all(isinstance(tube.curvature, float) and not tube.pre_torsion for tube in robot.tubes):
        raise OptionError("a tube's curvature varies or turns along it; models of others know constant ones only")
    if q[:, 2 * robot.d :].any():
        raise OptionError("theta is not 0 in all configurations; models of others know no tilt of the base")
    tubes = [
        (
            t.length,
            t.curved_length,
            t.curvature,
            t.outer_diameter,
            t.inner_diameter,
            t.youngs_modulus,
            t.poisson_ratio,
        )
        for t in robot.tubes
    ]
    rows: list[Any] = [*tubes, *(np.append(each, force) for each in q[:, : 2 * robot.d])]
    # 17 significant digits: a double is read back exactly.
    lines = [" ".join(f"{value:.17g}" for value in row) for row in rows]
    return "\n".join([f"{robot.d} {len(q)}", *lines]) + "\n"


def run_peer_program(program: str | Path, text: str, count: int) -> list[PeerSolution]:
    """Run a program on its input `text` of `count` configurations, in one thread.

    Raises OptionError where it fails, exceeds PEER_PROGRAM_TIMEOUT_S, or its output has another form.
    """
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [str(program)],
            input=text,
            capture_output=True,
            text=True,
            timeout=PEER_PROGRAM_TIMEOUT_S,
            check=True,
            env=environment,
        )
        found = [_parse_solution(line) for line in done.stdout.splitlines()]
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        raise OptionError(f"{program} does not answer as the model of another laboratory does: {error}") from error
    if len(found) != count:
        raise OptionError(f"{program} answers {len(found)} of {count} configurations")
    return found


def _parse_solution(line: str) -> PeerSolution:
    """Parse a line of a program's output; raises ValueError where it has another form than described above."""
    seconds, stability, count, *numbers = (float(word) for word in line.split())
    rows = np.array(numbers).reshape(int(count), 4)
    return PeerSolution(seconds, stability, rows[:, 0], rows[:, 1:])
