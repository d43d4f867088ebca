"""Kinematic models of the robot: from configuration q = (alpha, beta, theta), eq. (5), to the backbone C(s | q).

`protocol` says what a model is, `registry` lists them. `dominant` is the paper's model, eqs. (1)-(4); `elastic`
has tubes that twist each other; `loaded` adds forces. Models know symbols and numbers of tubes, and no program.
"""

from ctr_nlp.models.protocol import EquilibriumPath, Model, Snap, SymbolicShape
from ctr_nlp.models.registry import (
    DEFAULT_MODEL,
    KINEMATIC_MODELS,
    model_for_tip_forces,
    model_named,
    model_with_load,
    model_with_tip_forces,
    register,
    suits,
)

__all__ = [
    "DEFAULT_MODEL",
    "KINEMATIC_MODELS",
    "EquilibriumPath",
    "Model",
    "Snap",
    "SymbolicShape",
    "model_for_tip_forces",
    "model_named",
    "model_with_load",
    "model_with_tip_forces",
    "register",
    "suits",
]
