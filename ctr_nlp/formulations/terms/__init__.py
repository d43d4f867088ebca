"""Terms of a frame's program, one matter a file: a residual, a cost or a constraint on the robot's shape."""

from ctr_nlp.formulations.terms.arrival import Arrival
from ctr_nlp.formulations.terms.bears import Bears
from ctr_nlp.formulations.terms.feasible import Margin, Order
from ctr_nlp.formulations.terms.lumen import Lumen
from ctr_nlp.formulations.terms.motion import Motion
from ctr_nlp.formulations.terms.shape import ShapeDistance
from ctr_nlp.formulations.terms.term import Body, Parts, Term
from ctr_nlp.formulations.terms.tip import TipDirection, TipPosition
from ctr_nlp.formulations.terms.touch import Touch

__all__ = [
    "Arrival",
    "Bears",
    "Body",
    "Lumen",
    "Margin",
    "Motion",
    "Order",
    "Parts",
    "ShapeDistance",
    "Term",
    "TipDirection",
    "TipPosition",
    "Touch",
]
