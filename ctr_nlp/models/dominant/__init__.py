"""The dominant-stiffness model, eqs. (1)-(4): between two tubes' tips, the stiffest tube sets the curvature."""

from ctr_nlp.models.dominant.model import Dominant

__all__ = ["Dominant"]
