"""Models of the robot: configuration to backbone."""

from ctr_nlp.models.symbolic import Shape, dominant_shape, elastic_shape

MODELS = {"dominant": dominant_shape, "elastic": elastic_shape}
"""What a model gives a formulation, by the name that options use."""

__all__ = ["MODELS", "Shape"]
