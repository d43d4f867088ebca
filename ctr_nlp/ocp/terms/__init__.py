"""Terms of a frame's program, one subject a file: a residual, a cost or a constraint on the robot's shape."""

from ctr_nlp.ocp.terms.arrival import ArrivalTerm
from ctr_nlp.ocp.terms.feasible import Margin, Order
from ctr_nlp.ocp.terms.load import LoadTerm
from ctr_nlp.ocp.terms.lumen import LumenClearance
from ctr_nlp.ocp.terms.motion import MotionCost
from ctr_nlp.ocp.terms.shape import ShapeDistance
from ctr_nlp.ocp.terms.smooth_contact import SmoothContact
from ctr_nlp.ocp.terms.term import Body, Parts, Term
from ctr_nlp.ocp.terms.tip import TipDirection, TipPosition

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
