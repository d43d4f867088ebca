"""Rods whose sections between ends of tubes are divided into pieces, each with a force per length of its own."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.elastic.torsion import sections
from ctr_nlp.models.loaded.equilibria import LoadedEquilibria, States
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.rod_loads import RodKind
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.models.loads import Load, LoadOverTime
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

PIECES_PER_SECTION, PIECES_OF_ONE_TUBE = 9, 12
"""Number of pieces into which every section between ends of tubes is divided, some mm each, and that of a robot of
one tube, which has one section for its whole length."""


def kind_with_pieces(load: Load | LoadOverTime, tubes: int) -> RodKind:
    """Return the kind of rods of a number of tubes that bear a load and a force per length on every piece."""
    return RodKind.of(load)._replace(pieces=PIECES_PER_SECTION if tubes > 1 else PIECES_OF_ONE_TUBE)


def piece_positions(robot: Robot, kind: RodKind, beta: Array) -> tuple[Array, Array]:
    """Return middles and lengths (T, K), mm, of the pieces of robots with extensions beta (T, d), mm."""
    # Adding 0 beta broadcasts what does not depend on beta to (T,).
    parts = kind.split_sections(sections(robot.tube_numbers, list(beta.T), np, planes=False))
    start, length = (
        np.stack([getattr(part, name) + 0 * beta[:, 0] for part in parts], axis=1) for name in ("start", "length")
    )
    return start + length / 2, length


def unloaded_state(equilibria: LoadedEquilibria, robot: Robot, q: Array) -> States:
    """Return the equilibrium of a robot at q (1, 2d + 2) without a load, reached by turning from aligned tubes."""
    x = KINEMATIC_MODELS[Loaded.name].follow(robot, q).x
    return equilibria.solve_unloaded(robot.numbers[None], q, tip_angles(x, robot.d))
