"""What a formulation is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array


@dataclass(frozen=True)
class Stage:
    """An Nlp that decides some entries of q, the others being given.

    decides: indices into q, in the order of the Nlp's x. parameters: (frame, q) -> values by name, except
    `previous` (the decided entries one frame before) and `motion_root` (sqrt(lambda) / dt), which every stage
    has. schedule: values of further parameters, solved for one after the other, each from the last solution.
    rest: the Nlp's x of a robot that stands where the decided entries say; guess: roughly that, where rest takes
    time.
    """

    nlp: Nlp
    decides: npt.NDArray[np.int_]
    parameters: Callable[[Frame, Array], Mapping[str, Any]]
    schedule: tuple[Mapping[str, float], ...] = ({},)
    rest: Callable[[Array], Array] = np.copy
    guess: Callable[[Array], Array] | None = None
