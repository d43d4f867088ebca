"""Scenarios: robots of slightly different tubes that make the same motion, planned for together.

alpha, beta and theta of every frame belong to all of S robots, and each has tips phi of its own, which its motors'
angles and their offsets determine: alpha(phi_s, beta; tubes_s) = alpha + offset_s, in rad. The weighted mean of
their shape errors and the motion (9) are minimised, in mm^2. Each robot keeps a stability margin, and tips near
the first's, so that all are on one branch at a bifurcation, which the margin does not see. Nor does it see a
bifurcation between two frames: the first's tips turn by little more than its motors from frame to frame. Guards
are scenarios that only have to stay stable: less margin does for them, and tips that are further away.

Robots may have a load, each a force of its own at its tip beside it. Then the turn w of the tip's axes is also an
unknown of each robot's own, and an equation says that its base points where theta has it (models/loaded/shape.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.frame import filled, packed, program
from ctr_nlp.formulations.horizon import Ends, interpreted, motion_links
from ctr_nlp.formulations.joint import terms_of
from ctr_nlp.formulations.terms import Arrival, Bears, Term, Touch
from ctr_nlp.formulations.wall import Wall
from ctr_nlp.models import Model
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.nlp.scenarios import Guards, Lighter, Scenarios, SharedMotion, with_guards
from ctr_nlp.nlp.written import FrameFunctions
from ctr_nlp.robot import Robot
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array, Index

APART, FURTHEST = 0.7, 0.9
"""Angles in rad by which a scenario's tips, relative to the innermost one, may differ from the first scenario's
(APART), and those of a guard (FURTHEST), which counts as lost from simulation.drawn.APART on.
"""
EASED = 0.3
"""Part of the margin that a guard keeps."""
PRESSED_MM = 0.8
"""Depth in mm by which a robot other than the nominal one may press into the wall before it costs much; the
nominal one may less. Simulated robots are judged by 1 mm (plan.sample_outcomes).
"""
TWIST_STEP = 0.7
"""Angle in rad by which the first scenario's tips, relative to the innermost one, may turn beyond its motors in a
frame.
"""


def check_shared(robot: Robot, model: Model, scenarios: Scenarios) -> None:
    """Raise OptionError unless scenarios fit the robot, and have forces only on a model with loads."""
    if model.bears is None and scenarios.pushed:
        raise OptionError(f"scenarios bear forces, which the {model.name} model without a load does not know")
    if scenarios.offsets.shape[1] != robot.d:
        raise OptionError(f"scenarios have {scenarios.offsets.shape[1]} tubes and the robot has {robot.d}")


def shared_motion(
    robot: Robot,
    frames: Sequence[Frame],
    dt: float,
    motion_weight: float,
    ends: Ends,
    model: Model,
    scenarios: Scenarios,
    functions: Callable[[Nlp], Callable[[], FrameFunctions]] = interpreted,
    margins: Array | None = None,
    extra: Sequence[Term] = (),
    wall: Wall | None = None,
    freed: tuple[str, ...] = (),
    guards: Guards | None = None,
) -> SharedMotion:
    """The motion through frames, dt s apart, of scenarios of a robot.

    motion_weight, ends, model, functions, extra: as in horizon.horizon; but tips may turn as they do, and the wall
    is not a matter of slacks but a smooth cost (terms.touch). margins (T,): the least of every scenario in each
    frame, None for any; unused on a model that cannot snap. wall: of the lumen. freed: numbers of tubes that are
    unknowns (frame.program). guards: of these frames. Raises OptionError.
    """
    check_shared(robot, model, scenarios)
    margins = margins if model.can_snap else None
    # Any number: it only adds the term, whose parameter is set frame by frame below.
    margin = None if margins is None else 0.0
    terms = (*terms_of(robot, model, margin, extra), *([] if wall is None else [Touch(robot.d)]))
    frame = program("frame", robot.structure, model, terms, freed)
    each = packed(frame, [filled(robot, terms, at) for at in frames])
    # (T, S + K, d, 8): scenarios are the same in every frame, guards differ.
    numbers = with_guards(scenarios.numbers, None if guards is None else guards.numbers, len(frames))
    eased = np.arange(numbers.shape[1]) >= len(scenarios)
    parameters = np.repeat(each[:, None], len(eased), axis=1)
    # Swapped, as parameters are packed by columns of (d, 8).
    parameters[..., frame.place("tubes")] = numbers.swapaxes(2, 3).reshape(*numbers.shape[:2], -1)
    if model.bears is not None:
        parameters[..., frame.place(Bears.name)][..., :3] += with_guards(
            scenarios.forces, None if guards is None else guards.forces, len(frames)
        )
    for arrival in (term for term in terms if isinstance(term, Arrival)):
        # Robots but the nominal one may end further from the target at no cost.
        parameters[:, 1:, frame.place("arrival_radius")] += arrival.wider
    if margins is not None:
        parameters[..., frame.place("margin")] = (margins[:, None] * np.where(eased, EASED, 1.0))[..., None]
    lower, upper = (np.tile(bound, (len(frames), 1)) for bound in (robot.lower, robot.upper))
    if ends.end is not None:
        lower[-1] = upper[-1] = ends.end
    before, after = ([] if q is None else [q] for q in (ends.start, ends.end))
    links = motion_links(robot, len(frames), dt, motion_weight, before, after, np.zeros(0))
    flat = parameters.reshape(len(frames) * len(eased), -1)
    loads = None if model.bears is None else parameters[:, : len(scenarios), frame.place(Bears.name)]
    near = None if wall is None else partial(_surroundings, wall, scenarios.numbers, loads)
    apart = np.where(eased, FURTHEST, APART)
    # No frame before the first: no limit.
    twists = np.append(np.inf, np.full(len(frames) - 1, TWIST_STEP))
    rest = flat, lower, upper, links, apart, twists
    lighter = partial(_lighter, frame, robot, model, freed=freed, functions=functions)
    # Touch is the last of the terms.
    without_wall = None if wall is None else lighter(terms[:-1])
    constraints = [term for term in terms if not term.objective_only]
    bare = lighter(constraints) if len(constraints) < len(terms) else None
    held = _held(frame, robot)
    return SharedMotion(
        frame,
        robot.d,
        held,
        scenarios,
        *rest,
        functions(frame),
        near,
        guards=guards,
        free=without_wall,
        bare=bare,
    )


def _lighter(
    whole: Nlp,
    robot: Robot,
    model: Model,
    terms: Sequence[Term],
    freed: tuple[str, ...],
    functions: Callable[[Nlp], Callable[[], FrameFunctions]],
) -> Lighter:
    """Build the program of a frame with some of the terms of the whole one.

    Its constraints must be those of the whole program, so that rows agree. freed, functions: as for the whole.
    """
    nlp = program("frame", robot.structure, model, terms, freed)
    # Where each of its parameters stands in the whole program's, name by name.
    places = [np.arange(whole.p.numel())[whole.place(name)] for name in nlp.parameters]
    return Lighter(functions(nlp), np.concatenate(places))


def _held(frame: Nlp, robot: Robot) -> Index:
    """Positions of beta and theta among a frame's unknowns, (d + 2,)."""
    return frame.configuration[robot.d : len(robot.axes)]


def _surroundings(wall: Wall, numbers: Array, loads: Array | None, x: Array) -> dict[str, Array]:
    """Parameters that describe the wall near robots x (T, S, m); robots whose cost is 0 get the first one's."""
    n = 2 * numbers.shape[1] + 2  # a tilt that is stored beside the model's unknowns comes after them
    found = wall.of_scenarios(x[:, : len(numbers), :n], numbers, loads)
    # The nominal robot keeps its own limit; perturbed ones may press deeper.
    found["contact_allowed"][:, 1:] = np.maximum(found["contact_allowed"][:, 1:], PRESSED_MM)
    others = np.zeros(x.shape[1] - len(numbers), dtype=int)
    return {name: np.concatenate([each, each[:, others]], axis=1) for name, each in found.items()}
