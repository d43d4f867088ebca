"""The tip's position and direction as terms of the objective.

Residuals are sqrt(weight) times a distance in mm, or times an angle in rad with a weight in mm^2/rad^2. Targets
and weights are parameters, one for all frames or one a frame.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.nlp import Residual
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array

TIP_ANGLE_SMOOTHING = 1e-12
"""Added to the squared distance of two unit vectors, so that their angle has a slope where it is 0."""
MAX_HALF_ANGLE_SINE = 0.999
"""Largest sin(angle / 2) that is used: at opposite directions the slope of the angle is infinite."""


class TipOnlyTerm(Term):
    """A term of the objective that depends on the robot's tip alone, and all of whose numbers are parameters."""

    objective_only = True

    @property
    def key(self) -> Hashable:
        """The type: all numbers are parameters."""
        return type(self)

    def sample_arc_lengths(self, beta: Sequence[ca.SX]) -> ca.SX:
        """Return the arc length of the tip, mm, at extensions beta in mm."""
        return beta[-1]


@dataclass(frozen=True, eq=False)
class _WeightedTipTerm(TipOnlyTerm):
    """A term on the tip's position or direction against a wanted one.

    weight: a number >= 0, or one a frame (T,). wanted: (3,), or (T, 3), or None for the target's own.
    """

    weight: float | Array = 1.0
    wanted: Array | None = None

    def __post_init__(self) -> None:
        weight = floats(OptionError, f"weight of {self.name}", np.atleast_1d(self.weight), (None,))
        if weight.min() < 0:
            raise OptionError(f"weight of {self.name} is {weight.min():g}; it must be at least 0")
        object.__setattr__(self, "weight", weight)
        if self.wanted is not None:
            object.__setattr__(self, "wanted", self._check_wanted(np.atleast_2d(self.wanted)))

    def _check_wanted(self, wanted: npt.ArrayLike) -> Array:
        """Return the wanted vectors as an array (1 or T, 3); raises OptionError."""
        return floats(OptionError, f"wanted {self.name}", wanted, (None, 3))

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return shapes of the parameters: the wanted vector, and the square root of the weight."""
        return {f"{self.name}_wanted": (1, 3), f"{self.name}_root": (1, 1)}

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the wanted vector and the root of the weight in this frame."""
        wanted = self._target_value(frame) if self.wanted is None else self._row_for_frame(self.wanted, frame)
        # Residuals are squared: the weight enters as its square root.
        root = float(np.sqrt(self._row_for_frame(np.asarray(self.weight), frame)))
        return {f"{self.name}_wanted": wanted[None], f"{self.name}_root": root}

    def _row_for_frame(self, values: Array, frame: Frame) -> Any:
        """Return the row of values for a frame.

        A single row is for all. Raises OptionError where there is none.
        """
        if len(values) == 1:
            return values[0]
        if frame.number >= len(values):
            raise OptionError(f"{self.name} has {len(values)} rows and frame {frame.number + 1} is asked for")
        return values[frame.number]

    def _target_value(self, frame: Frame) -> Array:
        """Return the target's own vector in a frame."""
        raise NotImplementedError

    def _difference(self, at: Any, parameters: Symbols) -> ca.SX:
        """Return the tip's vector less the wanted one, (3, 1)."""
        wanted = parameters[f"{self.name}_wanted"]
        return ca.vertcat(*(at[i] - wanted[i] for i in range(3)))


@dataclass(frozen=True, eq=False)
class TipPosition(_WeightedTipTerm):
    """The cost weight |p - wanted|^2, mm^2, where p is the tip and wanted (mm) by default the target's end."""

    name = "tip_position"

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the distance from the tip of body to the wanted position; parameters: symbols by name."""
        value = parameters[f"{self.name}_root"] * self._difference(body.points, parameters)
        return Parts(residuals=(Residual(self.name, value),))

    def _target_value(self, frame: Frame) -> Array:
        return frame.points[-1]


@dataclass(frozen=True, eq=False)
class TipDirection(_WeightedTipTerm):
    """The cost weight angle^2, mm^2, with the angle (rad) from the tip's tangent to a wanted direction.

    The weight is in mm^2/rad^2; the direction is by default that of the target's end.
    """

    name = "tip_direction"
    tangents = True

    def _check_wanted(self, wanted: npt.ArrayLike) -> Array:
        wanted = super()._check_wanted(wanted)
        lengths = np.linalg.norm(wanted, axis=1)
        if lengths.min() == 0:
            raise OptionError(f"wanted {self.name} has the row (0, 0, 0), which has no direction")
        # Unit vectors: the angle is found from their difference.
        return wanted / lengths[:, None]

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the angle at the tip of body, as a vector along the difference of directions.

        parameters: symbols by name.
        """
        difference = self._difference(body.tangents, parameters)
        # |t - w| = 2 sin(angle / 2) for unit vectors, which is accurate at small angles, where acos(t . w)
        # is not. With half = sin(angle / 2), the residual's length is 2 half asin(half) / half = angle.
        half = ca.fmin(ca.sqrt(ca.sumsqr(difference) + TIP_ANGLE_SMOOTHING) / 2, MAX_HALF_ANGLE_SINE)
        value = parameters[f"{self.name}_root"] * (ca.asin(half) / half) * difference
        return Parts(residuals=(Residual(self.name, value),))

    def _target_value(self, frame: Frame) -> Array:
        return frame.tangents[-1]
