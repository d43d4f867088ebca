"""A frame's program and its parameters, as tests want them; and robots followed on the elastic model."""

from ctr_nlp.formulations import horizon as formulations
from ctr_nlp.formulations.frame import filled, program
from ctr_nlp.formulations.horizon import interpreted
from ctr_nlp.formulations.joint import joint as formulated
from ctr_nlp.formulations.joint import terms_of
from ctr_nlp.formulations.terms import ShapeDistance
from ctr_nlp.models import MODELS
from ctr_nlp.target.target import SIGMA

MARGIN = 0.1


def terms_alone(robot, model="dominant", stable=False, stride=5, walled=False):
    """The terms of a frame without neighbours."""
    margin = MARGIN if stable else None
    return terms_of(robot, MODELS[model], margin, (ShapeDistance(stride=stride),), walled=walled)


def alone(robot, model="dominant", stable=False, stride=5, walled=False):
    """The program of a frame without neighbours."""
    return program("frame", robot.structure, MODELS[model], terms_alone(robot, model, stable, stride, walled))


def target_of(robot, frame, margin=None, **form):
    """Its parameters for a target frame; margin where it is stable."""
    values = filled(robot, terms_alone(robot, stable=False, **form), frame)
    return values | ({} if margin is None else {"margin": margin})


def follow(robot, q, *others, **named):
    """The equilibria of a robot moved through q (T, 2d + 2)."""
    return MODELS["elastic"].follow(robot, q, *others, **named)


def settled(robot, q):
    """The equilibrium at q without a history."""
    return MODELS["elastic"].rest(robot, q)


def untwisted(robot, q):
    """Unknowns of tubes that have their motors' angles all along."""
    return MODELS["elastic"].guess(robot, q)


def configuration(robot, x):
    """Configurations of equilibria."""
    return MODELS["elastic"].configuration(robot, x)


def elastic_shapes(robot, x, sigma=SIGMA):
    """Points (T, n, 3) at equilibria."""
    return MODELS["elastic"].points(robot, x, sigma)


def elastic_tangents(robot, x, sigma=SIGMA):
    """Tangents (T, n, 3) at equilibria."""
    return MODELS["elastic"].tangents(robot, x, sigma)


def horizon(robot, frames, dt, weight, ends, functions=interpreted, model="dominant", **others):
    """The chain of a motion; functions: gives how a frame is evaluated."""
    return formulations.horizon(robot, frames, dt, weight, ends, MODELS[model], functions, **others)


def joint(robot, settings, model="dominant", **others):
    """The one stage of the joint formulation, in a tuple."""
    return formulated(robot, settings, MODELS[model], **others)
