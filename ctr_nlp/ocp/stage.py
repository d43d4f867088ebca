"""A stage of a formulation: one program, and how its parameters are filled."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.paths.target import Frame
from ctr_nlp.typing import Array, Index


@dataclass(frozen=True)
class Stage:
    """A program that decides some entries of q, the others being given.

    decides: indices into q, in the order of the program's configuration. fill: (target frame, q) -> parameters by
    name, among them `previous` (the decided entries one frame before) and `motion_root` (sqrt(lambda) / dt), which
    FrameSolver.step overrides. schedule: values of further parameters, solved for one after the other, each from
    the last solution (continuation).
    """

    nlp: Nlp
    decides: Index
    fill: Callable[[Frame, Array], Mapping[str, Any]]
    schedule: tuple[Mapping[str, float], ...] = ({},)
