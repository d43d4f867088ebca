"""A frame's program and its parameters, as tests want them; and robots followed on the elastic model."""

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp import horizon as formulations
from ctr_nlp.ocp.frame import fill_parameters, program
from ctr_nlp.ocp.horizon import interpreted_functions
from ctr_nlp.ocp.joint import frame_terms
from ctr_nlp.ocp.joint import joint as formulated
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.paths.target import SIGMA_GRID

MARGIN = 0.1


def terms_alone(robot, model="dominant", stable=False, stride=5, walled=False):
    """The terms of a frame without neighbours."""
    margin = MARGIN if stable else None
    return frame_terms(robot, KINEMATIC_MODELS[model], margin, (ShapeDistance(stride=stride),), walled=walled)


def alone(robot, model="dominant", stable=False, stride=5, walled=False):
    """The program of a frame without neighbours."""
    return program(
        "frame", robot.structure, KINEMATIC_MODELS[model], terms_alone(robot, model, stable, stride, walled)
    )


def target_of(robot, frame, margin=None, **form):
    """Its parameters for a target frame; margin where it is stable."""
    values = fill_parameters(robot, terms_alone(robot, stable=False, **form), frame)
    return values | ({} if margin is None else {"margin": margin})


def follow(robot, q, *others, **named):
    """The equilibria of a robot moved through q (T, 2d + 2)."""
    return KINEMATIC_MODELS["elastic"].follow(robot, q, *others, **named)


def settled(robot, q):
    """The equilibrium at q without a history."""
    return KINEMATIC_MODELS["elastic"].rest(robot, q)


def untwisted(robot, q):
    """Unknowns of tubes that have their motors' angles all along."""
    return KINEMATIC_MODELS["elastic"].guess(robot, q)


def configuration(robot, x):
    """Configurations of equilibria."""
    return KINEMATIC_MODELS["elastic"].configuration(robot, x)


def elastic_shapes(robot, x, sigma=SIGMA_GRID):
    """Points (T, n, 3) at equilibria."""
    return KINEMATIC_MODELS["elastic"].points(robot, x, sigma)


def elastic_tangents(robot, x, sigma=SIGMA_GRID):
    """Tangents (T, n, 3) at equilibria."""
    return KINEMATIC_MODELS["elastic"].tangents(robot, x, sigma)


def horizon(robot, frames, dt, weight, ends, functions=interpreted_functions, model="dominant", **others):
    """The chain of a motion; functions: gives how a frame is evaluated."""
    return formulations.horizon(robot, frames, dt, weight, ends, KINEMATIC_MODELS[model], functions, **others)


def joint(robot, settings, model="dominant", **others):
    """The one stage of the joint formulation, in a tuple."""
    return formulated(robot, settings, KINEMATIC_MODELS[model], **others)
