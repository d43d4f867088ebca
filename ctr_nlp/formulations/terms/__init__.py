"""Terms of a frame's program, one matter a file: a residual, a cost or a constraint on the robot's shape."""

from ctr_nlp.formulations.terms.arrival import ArrivalTerm
from ctr_nlp.formulations.terms.bears import LoadTerm
from ctr_nlp.formulations.terms.feasible import Margin, Order
from ctr_nlp.formulations.terms.lumen import LumenClearance
from ctr_nlp.formulations.terms.motion import MotionCost
from ctr_nlp.formulations.terms.shape import ShapeDistance
from ctr_nlp.formulations.terms.term import Body, Parts, Term
from ctr_nlp.formulations.terms.tip import TipDirection, TipPosition
from ctr_nlp.formulations.terms.touch import SmoothContact

__all__ = [
    "ArrivalTerm",
    "Body",
    "LoadTerm",
    "LumenClearance",
    "Margin",
    "MotionCost",
    "Order",
    "Parts",
    "ShapeDistance",
    "SmoothContact",
    "Term",
    "TipDirection",
    "TipPosition",
]
