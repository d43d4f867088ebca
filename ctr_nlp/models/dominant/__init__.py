"""The dominant-stiffness model: between two tubes' tips, the stiffest tube there alone sets the curvature."""

from ctr_nlp.models.dominant.model import Dominant

__all__ = ["Dominant"]
