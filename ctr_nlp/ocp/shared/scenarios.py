"""Scenarios: robots of slightly different tubes that make the same motion, planned for together.

alpha, beta and theta of every frame belong to all of S robots, and each has tips phi of its own, which its motors'
angles and their offsets determine: alpha(phi_s, beta; tubes_s) = alpha + offset_s, in rad. The weighted mean of
their shape errors and the motion (9) are minimised, in mm^2. Each robot keeps a stability margin, and tips near
the first's, so that all are on one branch at a bifurcation, which the margin does not detect. Nor does it detect a
bifurcation between two frames: the first's tips turn by little more than its motors from frame to frame.
Constraint scenarios only have to stay stable: less margin suffices for them, and tips may be further away.

Robots may have a load, and in addition each a force of its own at its tip. Then the turn w of the tip's axes is
also an unknown of each robot's own, and an equation says that its base points where theta has it
(models/loaded/shape.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.frame import fill_parameters, pack_frames, program
from ctr_nlp.ocp.horizon import EndConfigurations, interpreted_functions, motion_links
from ctr_nlp.ocp.joint import frame_terms
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.ocp.scenarios import (
    ConstraintScenarios,
    ReducedProgram,
    Scenarios,
    SharedMotion,
    with_constraint_scenarios,
)
from ctr_nlp.ocp.terms import ArrivalTerm, LoadTerm, SmoothContact, Term
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import locate_free_numbers
from ctr_nlp.typing import Array, Index

SCENARIO_TIP_LIMIT_RAD, CONSTRAINT_SCENARIO_TIP_LIMIT_RAD = 0.7, 0.9
"""Angles in rad by which a scenario's tips, relative to the innermost one, may differ from the first scenario's
(SCENARIO_TIP_LIMIT_RAD), and those of a constraint scenario (CONSTRAINT_SCENARIO_TIP_LIMIT_RAD). Simulated robots
count as failed beyond plan.sample_motions.MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD.
"""
CONSTRAINT_SCENARIO_MARGIN_FRACTION = 0.3
"""Fraction of the margin that a constraint scenario keeps."""
PERTURBED_CONTACT_LIMIT_MM = 0.8
"""Depth in mm by which a perturbed robot may press into the wall before it costs much; the nominal one may less.
Simulated robots are judged by 1 mm (plan.sample_outcomes).
"""
NOMINAL_TWIST_STEP_LIMIT_RAD = 0.7
"""Angle in rad by which the first scenario's tips, relative to the innermost one, may turn beyond its motors in a
frame.
"""


def check_scenarios(robot: Robot, model: Model, scenarios: Scenarios) -> None:
    """Raise OptionError unless scenarios fit the robot, and have forces only on a model with loads."""
    if model.applied_load is None and scenarios.has_tip_forces:
        raise OptionError(
            f"scenarios have tip forces, which the {model.name} model without a load cannot represent"
        )
    if scenarios.offsets.shape[1] != robot.d:
        raise OptionError(f"scenarios have {scenarios.offsets.shape[1]} tubes and the robot has {robot.d}")


def shared_motion(
    robot: Robot,
    frames: Sequence[Frame],
    dt: float,
    motion_weight: float,
    ends: EndConfigurations,
    model: Model,
    scenarios: Scenarios,
    functions: Callable[[Nlp], Callable[[], FrameFunctions]] = interpreted_functions,
    margins: Array | None = None,
    extra: Sequence[Term] = (),
    wall: Wall | None = None,
    free_numbers: tuple[str, ...] = (),
    constraint_scenarios: ConstraintScenarios | None = None,
) -> SharedMotion:
    """Build the motion of scenarios of a robot on a model through frames, dt s apart.

    motion_weight, ends, functions, extra: as in horizon.horizon; but tips have no limits of steps, and the wall is
    a smooth cost without slacks (terms.smooth_contact). margins (T,): the least of every scenario in each frame,
    None for any; unused on a model that cannot snap. wall: of the lumen. free_numbers: numbers of tubes that are
    unknowns (frame.program). constraint_scenarios: of these frames. Raises OptionError.
    """
    check_scenarios(robot, model, scenarios)
    margins = margins if model.can_snap else None
    # Any number: it only adds the term, whose parameter is set frame by frame below.
    margin = None if margins is None else 0.0
    terms = (*frame_terms(robot, model, margin, extra), *([] if wall is None else [SmoothContact(robot.d)]))
    frame = program("frame", robot.structure, model, terms, free_numbers)
    each = pack_frames(frame, [fill_parameters(robot, terms, at) for at in frames])
    # (T, S + K, d, 8): scenarios are the same in every frame, constraint scenarios differ.
    numbers = with_constraint_scenarios(
        scenarios.numbers, None if constraint_scenarios is None else constraint_scenarios.numbers, len(frames)
    )
    eased = np.arange(numbers.shape[1]) >= len(scenarios)
    parameters = np.repeat(each[:, None], len(eased), axis=1)
    # Swapped, as parameters are packed by columns of (d, 8).
    parameters[..., frame.parameter_slice("tubes")] = numbers.swapaxes(2, 3).reshape(*numbers.shape[:2], -1)
    if model.applied_load is not None:
        parameters[..., frame.parameter_slice(LoadTerm.name)][..., :3] += with_constraint_scenarios(
            scenarios.forces, None if constraint_scenarios is None else constraint_scenarios.forces, len(frames)
        )
    for arrival in (term for term in terms if isinstance(term, ArrivalTerm)):
        # Robots but the nominal one may end further from the target at no cost.
        parameters[:, 1:, frame.parameter_slice("arrival_radius")] += arrival.perturbed_extra_radius
    if margins is not None:
        parameters[..., frame.parameter_slice("margin")] = (
            margins[:, None] * np.where(eased, CONSTRAINT_SCENARIO_MARGIN_FRACTION, 1.0)
        )[..., None]
    lower, upper = (np.tile(bound, (len(frames), 1)) for bound in (robot.lower, robot.upper))
    if ends.end is not None:
        lower[-1] = upper[-1] = ends.end
    before, after = ([] if q is None else [q] for q in (ends.start, ends.end))
    # No limits for steps of tips: `twists` below limits those of the first scenario, and `apart` keeps the others
    # near it.
    links = motion_links(robot, len(frames), dt, motion_weight, before, after, np.zeros(0))
    flat = parameters.reshape(len(frames) * len(eased), -1)
    loads = (
        None
        if model.applied_load is None
        else parameters[:, : len(scenarios), frame.parameter_slice(LoadTerm.name)]
    )
    places = locate_free_numbers(robot.structure, free_numbers)
    near = None if wall is None else partial(_local_wall_parameters, wall, scenarios.numbers, loads, places)
    apart = np.where(eased, CONSTRAINT_SCENARIO_TIP_LIMIT_RAD, SCENARIO_TIP_LIMIT_RAD)
    # No frame before the first: no limit.
    twists = np.append(np.inf, np.full(len(frames) - 1, NOMINAL_TWIST_STEP_LIMIT_RAD))
    rest = flat, lower, upper, links, apart, twists
    lighter = partial(_reduced_program, frame, robot, model, freed=free_numbers, functions=functions)
    # SmoothContact is the last of the terms.
    without_wall = None if wall is None else lighter(terms[:-1])
    constraints = [term for term in terms if not term.objective_only]
    bare = lighter(constraints) if len(constraints) < len(terms) else None
    held = _shared_entries(frame, robot)
    return SharedMotion(
        frame,
        robot.d,
        held,
        scenarios,
        *rest,
        functions(frame),
        near,
        constraint_scenarios=constraint_scenarios,
        without_wall=without_wall,
        without_objective=bare,
    )


def _reduced_program(
    full_program: Nlp,
    robot: Robot,
    model: Model,
    terms: Sequence[Term],
    freed: tuple[str, ...],
    functions: Callable[[Nlp], Callable[[], FrameFunctions]],
) -> ReducedProgram:
    """Build the program of a frame with some of the terms of the whole one.

    Its constraints must be those of the whole program, so that rows agree. freed, functions: as for the whole.
    """
    nlp = program("frame", robot.structure, model, terms, freed)
    # Where each of its parameters stands in the whole program's, name by name.
    places = [np.arange(full_program.p.numel())[full_program.parameter_slice(name)] for name in nlp.parameters]
    return ReducedProgram(functions(nlp), np.concatenate(places))


def _shared_entries(frame: Nlp, robot: Robot) -> Index:
    """Return the positions of beta and theta among a frame's unknowns, (d + 2,)."""
    return frame.configuration[robot.d : len(robot.axes)]


def _local_wall_parameters(
    wall: Wall,
    numbers: Array,
    loads: Array | None,
    places: Sequence[tuple[int, tuple[int, ...]]],
    x: Array,
) -> dict[str, Array]:
    """Return parameters of the wall near robots x (T, S, m); robots whose cost is 0 get the first one's.

    numbers (S, d, 8): of the scenarios' tubes. places: the tube, from 0, and the columns of those among them that
    are unknowns, whose values are the last entries of x.
    """
    n = 2 * numbers.shape[1] + 2  # a tilt that is stored beside the model's unknowns comes after them
    if places:
        # The wall is linearised around the tubes of this iteration, not around those that the design began with:
        # their shapes are other ones. All frames share one set of tubes: the first frame has their numbers.
        given = x[0, : len(numbers), x.shape[2] - len(places) :]
        numbers = numbers.copy()
        for k, (i, columns) in enumerate(places):
            numbers[:, i, list(columns)] = given[:, [k]]
    found = wall.scenario_local_parameters(x[:, : len(numbers), :n], numbers, loads)
    # The nominal robot keeps its own limit; perturbed ones may press deeper.
    found["contact_allowed"][:, 1:] = np.maximum(found["contact_allowed"][:, 1:], PERTURBED_CONTACT_LIMIT_MM)
    others = np.zeros(x.shape[1] - len(numbers), dtype=int)
    return {name: np.concatenate([each, each[:, others]], axis=1) for name, each in found.items()}
