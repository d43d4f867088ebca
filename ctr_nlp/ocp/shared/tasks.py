"""Motions of several tasks as one motion, with the tubes that they have in common.

Frames of all tasks follow each other in one SharedMotion. No link joins the last frame of one task with the first
of the next: only the common unknowns p (design.py) couple them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ctr_nlp.ocp.links import FrameLink
from ctr_nlp.ocp.nlp import Constraint
from ctr_nlp.ocp.scenarios import CommonUnknowns, SharedMotion
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.typing import Array, Index


def join_task_motions(motions: Sequence[SharedMotion], common: CommonUnknowns) -> SharedMotion:
    """Join motions of the same scenarios, each of a task of its own, as one with common unknowns.

    Either all tasks have a wall, or none.
    """
    sizes = [motion.lower.size for motion in motions]
    begins = np.cumsum([0, *sizes])
    frames = np.cumsum([0, *(len(motion.lower) for motion in motions)])
    # Each task's links move behind the unknowns and frames of the tasks before it.
    links = [
        _shift_link(link, int(begin), sum(sizes), int(frame))
        for motion, begin, frame in zip(motions, begins, frames, strict=False)
        for link in motion.links
    ]
    of_frames: dict[str, Any] = {
        name: np.concatenate([getattr(motion, name) for motion in motions])
        for name in ("parameters", "lower", "upper", "twist_steps")
    }
    near = None
    if motions[0].local_parameters is not None:
        near = partial(_local_parameters_by_task, [motion.local_parameters for motion in motions], frames[1:-1])
    # Everything but frames, links, walls and common unknowns is the same for all tasks: tubes, scenarios and the
    # program.
    return replace(motions[0], **of_frames, links=tuple(links), common=common, local_parameters=near)


def _local_parameters_by_task(sources: Sequence[Any], begins: Index, x: Array) -> dict[str, Array]:
    """Return local parameters (T, S, ..) by name at unknowns x (T, S, m), each task's from its own source.

    begins: number of the first frame of each task but the first.
    """
    # Each task has a path and a wall of its own, linearised near its own frames.
    found = [source(part) for source, part in zip(sources, np.split(x, begins), strict=True)]
    return {name: np.concatenate([each[name] for each in found]) for name in found[0]}


@dataclass(frozen=True)
class CurvedPartLimit(Term):
    """A constraint by which tubes are pushed out by no more than their curved parts, of any length."""

    name = "curved part"

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the constraints curved_length_i - beta_i >= 0, mm, for the tubes of body.

        parameters: not used.
        """
        # A constraint, not a bound of beta: curved lengths may be unknowns of a design.
        room = ca.vertcat(*(tube.curved_length - beta for tube, beta in zip(body.tubes, body.beta, strict=True)))
        least = np.zeros(len(body.tubes))
        most = np.full(len(body.tubes), np.inf)
        return Parts(constraints=(Constraint(self.name, room, least, most),))


def _shift_link(link: FrameLink, begin: int, size: int, frame: int) -> FrameLink:
    """Return a link over `size` unknowns, its own beginning at entry `begin`, and its frames at `frame`."""
    found = link.matrix.tocoo()
    # The same entries, with columns shifted to the task's own unknowns.
    matrix = sp.csr_array((found.data, (found.row, found.col + begin)), shape=(found.shape[0], size))
    return replace(link, matrix=matrix, frame=link.frame + frame)
