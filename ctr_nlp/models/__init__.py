"""Models of the robot: configuration to backbone. They know symbols and numbers of tubes, and no program."""

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
