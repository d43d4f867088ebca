"""Kinematic models of the robot: from configuration q = (alpha, beta, theta), eq. (5), to the backbone C(s | q).

`protocol` says what a model is, `registry` lists them. `dominant` is the paper's model, eqs. (1)-(4); `elastic`
has tubes that twist each other; `loaded` adds forces. Models know symbols and numbers of tubes, and no program.
"""

from ctr_nlp.models.protocol import Followed, Model, Shape, Snap
from ctr_nlp.models.registry import DEFAULT_MODEL, MODELS, bearing, model_named, pushed, register, suits, under

__all__ = [
    "DEFAULT_MODEL",
    "MODELS",
    "Followed",
    "Model",
    "Shape",
    "Snap",
    "bearing",
    "model_named",
    "pushed",
    "register",
    "suits",
    "under",
]
