"""One robot that is moved step by step, as its motors are, and stays on the equilibrium that it is in."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.typing import Array


class Walker(ABC):
    """A robot at rest at q (2d + 2,), in an equilibrium of unknowns x (n_x,). One object a thread."""

    q: Array
    x: Array

    @abstractmethod
    def go(self, q: Array) -> list[Array]:
        """Move linearly to q (2d + 2,); by what the tips jumped (d,) rad on the way, one entry a snap.

        Where no equilibrium is found there, x is NaN from then on.
        """

    @abstractmethod
    def become(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """Go on as a robot of other numbers (d, 8), at the same q; by what tips jumped (d,) rad, an entry a snap.

        x (n_x,): about where it will be, None where it is.
        """

    def bear(self, load: Array) -> list[Array]:
        """Go on under another load of the same kind, of numbers (17 + 3d,); by what tips jumped, an entry a snap.

        Raises OptionError where the model knows no loads.
        """
        raise OptionError("the model of the robot that moves step by step bears no load")

    @abstractmethod
    def margin(self) -> float:
        """The stability margin; NaN where nothing can be unstable."""

    def copy(self) -> Walker:
        """Another one in the same place, for the same thread."""
        return copy.copy(self)


class Rigid(Walker):
    """A robot on a model whose unknowns are the configuration itself, with one shape for each."""

    def __init__(self, q: Array) -> None:
        self.q = self.x = np.array(q, dtype=float)

    def go(self, q: Array) -> list[Array]:
        """As Walker."""
        self.q = self.x = np.array(q, dtype=float)
        return []

    def become(self, numbers: Array, x: Array | None = None) -> list[Array]:
        """Nothing but numbers changes."""
        return []

    def margin(self) -> float:
        """Nothing can be unstable."""
        return float("nan")
