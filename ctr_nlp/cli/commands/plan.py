"""`ctr-nlp plan`, and its two halves: `ctr-nlp steer`, frame by frame, and over a horizon, all frames at once.

By default a plan is found over a horizon, for all robots within the tolerances. It starts from the plan of the
nominal robot, which is written after a few seconds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctr_nlp.cli import arguments as options
from ctr_nlp.cli import plan_options, problems
from ctr_nlp.cli.arguments import (
    CHOICE_JOBS,
    DEFAULT_SETTINGS,
    FRAME_SETTINGS,
    film_file,
    read_start,
    settings_from,
)
from ctr_nlp.cli.console import EXIT_INTERRUPTED, Command
from ctr_nlp.cli.loads.options import (
    add_load_options,
    add_modulus_option,
    has_load,
    model_from_options,
    problem_with_modulus,
)
from ctr_nlp.cli.output.file import path_component
from ctr_nlp.cli.output.folder import NOMINAL_FOLDER_NAME, check_folder, output_folder, results_folder
from ctr_nlp.cli.plan_options import DEFAULT_SWEEP_WEIGHTS_S2, HORIZON_FORMULATION
from ctr_nlp.cli.plan_report import (
    draw,
    draw_film,
    draw_shapes_only,
    exit_status,
    print_compromises,
    print_front,
    print_report,
    write,
    write_compromises,
    write_film,
    write_front,
)
from ctr_nlp.cli.terminal_output import announce, busy, progress_bar, report_written_files, suggest_next
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.loads.tissue import AIRWAY_WALL_STIFFNESS_N_PER_MM2
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp import FORMULATIONS
from ctr_nlp.ocp.settings import THRESHOLDS, Settings, check_motion_weight
from ctr_nlp.paths.lumen_fit import check_radii
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan import summary_text
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import PHYSICAL_MODEL, Plan
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS
from ctr_nlp.plan.verdicts import NO
from ctr_nlp.planning.validation import DIRECTIONS, Direction, check_search, checked_motions
from ctr_nlp.solvers import CHAIN_SOLVERS, SOLVERS
from ctr_nlp.support.interrupt import deferred_interrupt, end_if_interrupted
from ctr_nlp.support.value_checks import check_choice

if TYPE_CHECKING:
    from ctr_nlp.cli.live_views import SolverView
    from ctr_nlp.planning.compromise import Compromise
    from ctr_nlp.studies.pareto_front import ParetoPoint


OPTIONS_EXCLUDED_BY_ROBUST = (
    *("initial", "starts", "exhaustive", "jobs", "sweep_motion_weight", "live", "solver"),
    "contact_force",
)
"""Options that do not go with --robust."""
ROBUST_ONLY_OPTIONS = {
    "most_lost": "the share of robots that may fail",
    "guards": "that robots at the corners of the tolerances must not snap",
    "tip_force": "the tip force that robots must withstand",
}
"""Options that only robust plans have, and what each says."""


def _parser(formulations: tuple[str, ...], prog: str) -> argparse.ArgumentParser:
    """Make the parser for some formulations, the first of which is the default."""
    frames = set(formulations) != {HORIZON_FORMULATION}
    horizon = HORIZON_FORMULATION in formulations
    how = " or ".join(["all frames in one program"] * horizon + ["frame by frame"] * frames)
    parser = argparse.ArgumentParser(
        prog=prog,
        description=f"Follow a target with the whole shape of the robot, {how}; write plan.npz, errors.csv, "
        "summary.json and pictures.",
        epilog="Every plan is simulated on the elastic model, whatever model it was made on, and on robots "
        "sampled within the tolerances (--no-evaluate skips this). Exit status: 0 where no verdict is `no`, "
        "1 where one is, 2 where input is bad, 130 after an interruption (the best motion so far goes into "
        f"DIR/interrupted, and DIR's own files stay). {NOT_FOR_PATIENTS}",
    )
    parser.add_argument("problem", metavar="PROBLEM", help=problems.PROBLEM_ARGUMENT_HELP)
    plan_options.add_piece_arguments(parser)
    options.add_problem_options(parser)
    parser.set_defaults(formulation=formulations[0])
    if len(formulations) > 1:
        help = "horizon: all frames at once; the others frame by frame " * (horizon and frames)
        parser.add_argument("--formulation", choices=formulations, help=f"{help}(default {formulations[0]})")
    plan_options.add_model_options(parser)
    solvers = [*SOLVERS] * frames + [*CHAIN_SOLVERS] * horizon
    compiled = " or ".join(["sqp"] * frames + ["banded"] * horizon)
    parser.add_argument(
        "--solver",
        choices=list(dict.fromkeys(solvers)),
        help=f"(default {compiled} where there is a C compiler, else ipopt)",
    )
    options.add_compile_option(parser)
    options.add_out_option(parser, "runs/PROBLEM-FORMULATION-MODEL, and what else was asked for")
    options.add_figures_option(parser)
    options.add_film_option(parser)
    plan_options.add_motion_options(parser)
    plan_options.add_robust_options(parser)
    if frames:
        group = parser.add_argument_group("frame by frame")
        order = "order in which frames are solved (default best)"
        group.add_argument("--direction", choices=DIRECTIONS, help=order)
    if horizon:
        plan_options.add_horizon_options(parser)
    weights = ["motion costs a tenth of the start's shape errors"] * horizon
    weights += [f"{DEFAULT_SETTINGS.motion_weight:g}{' frame by frame' * horizon}"] * frames
    options.add_settings(parser, "; ".join(weights), jumps=frames)
    plan_options.add_file_options(parser)
    plan_options.add_term_options(parser)
    plan_options.add_wall_options(parser)
    plan_options.add_check_options(parser)
    plan_options.add_threshold_options(parser)
    add_load_options(parser, required=False)
    add_modulus_option(parser)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    whole = arguments.formulation == HORIZON_FORMULATION
    swept = getattr(arguments, "sweep_motion_weight", None)
    _check_formulation_options(arguments)
    for weight in swept or ():
        check_motion_weight(weight)
    model = plan_options.model_from(arguments)
    problem = _with_fitting_robot(problems.load(arguments.problem, arguments), arguments, model)
    problem = plan_options.with_motion_options(problem, arguments)
    problem = plan_options.with_tip_force_option(problem_with_modulus(problem, arguments), arguments)
    model_from_options(model, arguments).check_planning(problem.robot)
    robust, alone = _decide_robust(arguments, problem)
    _check_contact_options(arguments, problem)
    out = Path(arguments.out or f"runs/{_folder(problem, model, arguments, robust)}")
    film = film_file(arguments)
    check_folder(out, "plan", film)
    if alone:
        announce(f"planned for the robot as described alone: {alone}")
    if robust:
        plan = _plan_robust(arguments, problem, out)
        points: list[ParetoPoint] = []
    else:
        plan, points = _plan_horizon(arguments, problem) if whole else (_plan_per_frame(arguments, problem), [])
        if getattr(arguments, "contact_force", None) is not None and not plan.meta["interrupted"]:
            plan = _plan_on_wall(arguments, problem, plan)
    with deferred_interrupt() as pressed:
        # Ctrl-C waits while the plan is evaluated, which takes seconds: it must not discard what was solved.
        with busy("the plan is evaluated"):
            plan = plan_options.evaluate_plan(plan_options.with_thresholds(plan, arguments), arguments)
        found = _compromises(arguments, problem, plan)
        interrupted = plan.meta["interrupted"] or pressed()
    place = results_folder(out, interrupted)
    with output_folder(place, "plan") as staging:
        write(plan, staging)
        if found:
            write_compromises(plan, found, staging)
        if points:
            write_front(points, staging)
        if not arguments.no_figures:
            draw(plan, points, staging, found)
        files = sorted(path.name for path in staging.iterdir())
        if film is not None:
            film = write_film([plan], film, out, place, staging)
    print_report(plan)
    if found:
        print_compromises(plan, found)
    if points:
        print_front(points)
    report_written_files(place, files)
    if film is not None:
        report_written_files(film)
    if not interrupted:
        suggest_next(*_next_commands(plan, place / "plan.npz", arguments))
    return EXIT_INTERRUPTED if interrupted else exit_status(plan)


def _next_commands(plan: Plan, file: Path, arguments: argparse.Namespace) -> list[tuple[str, list[object]]]:
    """Return what a person may want to do with a plan in a file, and the commands; only a good plan is played.

    After one that fails within an anatomy, the robots of the package are compared on its path.
    """
    commands: list[tuple[str, list[object]]] = [
        ("a page on which the robot moves", ["report", file]),
        ("an independent check", ["check", file]),
    ]
    if not (plan.verdicts.failed_names or plan.verdicts.unchecked_names):
        words = ["play", file, "--hardware", "FILE.toml", "--dry-run"]
        commands.append(("a trial with your rig's limits, without motion", words))
    elif plan.verdicts.failed_names and plan.wall is not None and problems.is_anatomy(arguments.problem):
        words = ["choose", arguments.problem, *problems.file_option_words(arguments)]
        commands.append(("which robots of the package reach this end", words))
    return commands


def _with_fitting_robot(problem: Problem, arguments: argparse.Namespace, model: str) -> Problem:
    """Return a problem within walls with the shipped robot that fits its path best, where no robot was given.

    Named problems and problem files have robots of their own. The robots are compared on the elastic model: on the
    dominant one `model` the problem stays as it is.
    """
    own = arguments.robot is not None or not problems.is_anatomy(arguments.problem)
    if own or problem.wall is None or not KINEMATIC_MODELS[model].can_snap:
        return problem
    from ctr_nlp.robot.shipped import read_robot_files
    from ctr_nlp.tube_design.choice import choose_robot  # brings the whole of tube design

    # The limits of the tilt are the problem's: an option narrows them.
    tilt = list(zip(problem.robot.lower[-2:].tolist(), problem.robot.upper[-2:].tolist(), strict=True))
    robots = {name: robot.with_limits(theta=tilt) for name, robot in read_robot_files().items()}
    with progress_bar() as labelled:
        told = labelled("robots of the package are compared")
        best = choose_robot(problem, robots, jobs=CHOICE_JOBS, progress=told)
    if best is None:
        return problem
    announce(
        f"robot: {best.name}, which fits this path best of the {len(robots)} that come with the package; "
        "`ctr-nlp choose` compares them, and --robot NAME or FILE.toml takes another"
    )
    return replace(problem, robot=best.robot)


def _compromises(arguments: argparse.Namespace, problem: Problem, plan: Plan) -> list[Compromise]:
    """Compute compromises between arriving and keeping off the wall for a horizon plan that fails one of them;
    else none.
    """
    found = plan.verdicts
    failed = plan.clearance is not None and NO in (found.arrives.word, found.within_wall.word)
    looked = not (arguments.no_evaluate or plan.meta["interrupted"] or plan.evaluated_load is not None)
    if plan.leans_on_wall:
        return []
    if not (
        failed and looked and arguments.formulation == HORIZON_FORMULATION and plan.meta["model"] == PHYSICAL_MODEL
    ):
        return []
    if arguments.contact_weight == 0.0:
        return []
    from ctr_nlp.planning.compromise import compromises

    with progress_bar() as labelled:
        settings = _settings(arguments, problem, "seed")
        terms = plan_options.terms_from(arguments)
        shown = labelled(f"{problem.name}, arrival against contact")
        return compromises(problem, plan, settings=settings, terms=terms, progress=shown)


def _wants_robust(arguments: argparse.Namespace) -> bool:
    """Tell whether a robust plan is asked for, by --robust or by an option that only robust plans have."""
    told = any(getattr(arguments, option) is not None for option in ROBUST_ONLY_OPTIONS)
    return arguments.robust or (told and arguments.formulation == HORIZON_FORMULATION and not arguments.nominal)


def _decide_robust(arguments: argparse.Namespace, problem: Problem) -> tuple[bool, str]:
    """Decide whether to plan for all robots within the tolerances; where no option says so, also return why not.

    Over all frames that is the default, where the model can predict which robots snap and no option was given that
    only nominal plans have.
    """
    robust = _wants_robust(arguments)
    if robust or arguments.nominal or arguments.formulation != HORIZON_FORMULATION:
        return robust, ""
    if has_load(arguments):
        return False, "a robust plan under a load takes a minute or more; add --robust to make one"
    if not KINEMATIC_MODELS[plan_options.model_from(arguments)].can_snap:
        return False, ""
    if given := _given_options(arguments, OPTIONS_EXCLUDED_BY_ROBUST):
        return False, f"{given[0]} does not go with --robust"
    from ctr_nlp.robust.tolerance_scenarios import resolve_scenarios

    try:
        resolve_scenarios(problem.robot, plan_options.model_from(arguments), None)
    except CtrError as error:
        return False, str(error)
    return True, ""


def _folder(problem: Problem, model: str, arguments: argparse.Namespace, robust: bool) -> str:
    """Name the output folder by what was asked for, so that plans of other requests do not replace each other."""
    whole = arguments.formulation == HORIZON_FORMULATION
    loaded = has_load(arguments)
    asked = {
        "nominal": whole and not (robust or loaded) and KINEMATIC_MODELS[model].can_snap,
        "robust": robust and not whole,
        "loaded": loaded,
        "on-wall": getattr(arguments, "contact_force", None) is not None,
        "locked-tilt": arguments.lock_tilt,
        f"on-{path_component(Path(arguments.robot or '').stem)}": arguments.robot is not None,
    }
    parts = [path_component(problem.name), arguments.formulation, model]
    return "-".join([*parts, *(name for name, given in asked.items() if given)])


def _check_formulation_options(arguments: argparse.Namespace) -> None:
    """Raise OptionError for an option that the chosen formulation does not have."""
    whole = arguments.formulation == HORIZON_FORMULATION
    if arguments.solver is not None and not whole:
        check_choice("solver", arguments.solver, SOLVERS)
    for option in _given_options(
        arguments, plan_options.PER_FRAME_ONLY_OPTIONS if whole else plan_options.HORIZON_ONLY_OPTIONS
    ):
        fitting = f"one of {', '.join(FORMULATIONS)}" if whole else HORIZON_FORMULATION
        raise OptionError(
            f"{option} does not go with --formulation {arguments.formulation}; it goes with {fitting}"
        )
    robust = _wants_robust(arguments)
    for option, what in ROBUST_ONLY_OPTIONS.items():
        if getattr(arguments, option) is not None and not robust:
            raise OptionError(f"--{option.replace('_', '-')} needs --robust; it sets {what}")
    if robust:
        if arguments.formulation not in (HORIZON_FORMULATION, "joint"):
            raise OptionError(
                f"--robust does not go with --formulation {arguments.formulation}; it goes with horizon and joint"
            )
        for option in _given_options(
            arguments,
            OPTIONS_EXCLUDED_BY_ROBUST
            if whole
            else (*OPTIONS_EXCLUDED_BY_ROBUST, *plan_options.WALL_SETTING_NAMES),
        ):
            raise OptionError(f"{option} does not go with --robust; leave one of them out")


def _wall_stiffness(arguments: argparse.Namespace) -> float:
    """Return the stiffness of the wall that was asked for, or that of an airway, N/mm^2."""
    given: float | None = arguments.wall_stiffness
    return AIRWAY_WALL_STIFFNESS_N_PER_MM2 if given is None else given


def _check_contact_options(arguments: argparse.Namespace, problem: Problem) -> None:
    """Raise OptionError or LoadError where --contact-force was given and does not go with the rest."""
    force = getattr(arguments, "contact_force", None)
    if force is None:
        if getattr(arguments, "wall_stiffness", None) is not None:
            raise OptionError("--wall-stiffness needs --contact-force; other plans know no forces of a wall")
        return
    if has_load(arguments):
        raise OptionError("--contact-force does not go with a load; leave one of them out")
    if not KINEMATIC_MODELS[plan_options.model_from(arguments)].can_snap:
        raise OptionError("--contact-force needs --model elastic; other models know no forces")
    if arguments.sweep_motion_weight is not None:
        raise OptionError("--contact-force does not go with --sweep-motion-weight; leave one of them out")
    from ctr_nlp.loads.contact_plan import check_contact_request

    check_contact_request(problem, force, _wall_stiffness(arguments))


def _given_options(arguments: argparse.Namespace, names: Sequence[str]) -> list[str]:
    """Return the options that were given, as written on the command line; names: their attributes in
    `arguments`.
    """
    # Compared by identity: 0 equals False, but is a value that was given.
    unset = None, False
    given = [name for name in names if not any(getattr(arguments, name, None) is each for each in unset)]
    return [f"--{name.replace('_', '-')}" for name in given]


def _settings(arguments: argparse.Namespace, problem: Problem, *names: str) -> Settings:
    """Make the Settings from the options in `names` and those of the wall, arrival and thresholds.

    Raises OptionError, and ProblemError where the wall is asked for and the problem has no radii.
    """
    if any(getattr(arguments, name) for name in plan_options.WALL_SETTING_NAMES):
        check_radii(problem)
    return settings_from(arguments, *names, *plan_options.WALL_SETTING_NAMES, "arrival_weight", *THRESHOLDS)


def _plan_per_frame(arguments: argparse.Namespace, problem: Problem) -> Plan:
    """Plan frame by frame with the formulation that was chosen."""
    from ctr_nlp.planning.per_frame import solve_per_frame

    direction: Direction = arguments.direction or "best"
    asked: dict[str, Any] = {
        "settings": _settings(arguments, problem, *FRAME_SETTINGS),
        "start": None if arguments.start is None else read_start(arguments.start, problem.robot),
        "model": model_from_options(plan_options.model_from(arguments), arguments),
        "solver": arguments.solver,
        "terms": plan_options.terms_from(arguments),
    }
    problems.print_problem_notes(problem)
    end_if_interrupted()
    with progress_bar() as labelled:
        show = labelled(problem.name)
        plan = solve_per_frame(problem, arguments.formulation, direction=direction, progress=show, **asked)
    if not plan.reached_frames.any():
        end_if_interrupted()
    return plan


def _plan_horizon(arguments: argparse.Namespace, problem: Problem) -> tuple[Plan, list[ParetoPoint]]:
    """Plan all frames at once; return the plan, and the points of a sweep of motion weights where one is asked
    for.
    """
    from ctr_nlp.planning.horizon import horizon_planner

    settings = _settings(arguments, problem, "seed")
    jobs = 1 if arguments.jobs is None else arguments.jobs
    start, end = (
        None if path is None else read_start(path, problem.robot) for path in (arguments.start, arguments.end)
    )
    check_search(arguments.motion_weight, arguments.starts, jobs)
    initial = checked_motions(problem, [Plan.load(path).q for path in arguments.initial or ()])
    points: list[ParetoPoint] = []
    with _open_live_view(problem, arguments) as seen:
        terms = plan_options.terms_from(arguments)
        model = model_from_options(plan_options.model_from(arguments), arguments)
        horizon = horizon_planner(problem, model, arguments.solver, start, end, settings, terms)
        problems.print_problem_notes(problem)
        end_if_interrupted()
        with progress_bar() as labelled:
            show = labelled(problem.name)
            asked = arguments.motion_weight, arguments.starts, jobs
            plan = horizon.solve(initial, *asked, show, seen, arguments.exhaustive)
            if seen is not None:
                seen.show_plan(plan)
            if arguments.sweep_motion_weight is not None:
                from ctr_nlp.studies.pareto_front import compute_pareto_front

                weights = arguments.sweep_motion_weight or DEFAULT_SWEEP_WEIGHTS_S2
                points = compute_pareto_front(horizon, plan, weights, settings, labelled)
    return plan, points


def _plan_on_wall(arguments: argparse.Namespace, problem: Problem, plan: Plan) -> Plan:
    """Plan again with the robot leaning on the wall up to a force; plan: the one to begin with."""
    from ctr_nlp.loads.contact_plan import solve_on_wall

    with progress_bar() as labelled:
        return solve_on_wall(
            problem,
            arguments.contact_force,
            stiffness=_wall_stiffness(arguments),
            settings=_settings(arguments, problem, "seed"),
            initial=plan,
            progress=labelled(f"{problem.name}, leaning on the wall"),
        )


def _plan_robust(arguments: argparse.Namespace, problem: Problem, out: Path) -> Plan:
    """Plan for all robots within the tolerances, over all frames at once or frame by frame.

    out: the output folder; a folder within it takes the nominal robot's plan as soon as that is found.
    """
    from ctr_nlp.robust import solve_robust, solve_robust_per_frame

    whole = arguments.formulation == HORIZON_FORMULATION
    asked: dict[str, Any] = {
        "model": model_from_options(plan_options.model_from(arguments), arguments),
        "terms": plan_options.terms_from(arguments),
    }
    for name in ("start", "end"):
        if (path := getattr(arguments, name, None)) is not None:
            asked[name] = read_start(path, problem.robot)
    if arguments.most_lost is not None:
        asked["most_lost"] = arguments.most_lost
    if whole:
        asked |= {"settings": _settings(arguments, problem, "seed"), "motion_weight": arguments.motion_weight}
        asked["guards"] = bool(arguments.guards)
    else:
        asked |= {"settings": _settings(arguments, problem, *FRAME_SETTINGS)}
        asked |= {"direction": arguments.direction or "best"}
    problems.print_problem_notes(problem)
    end_if_interrupted()
    with progress_bar() as labelled:
        if not whole:
            return solve_robust_per_frame(problem, progress=labelled(problem.name), **asked)

        def write_nominal_plan(plan: Plan) -> None:
            labelled(f"{problem.name}: the plan for the robot as described is written")
            _write_nominal_plan(plan, out, figures=not arguments.no_figures, film=film_file(arguments))
            labelled(problem.name)

        return solve_robust(problem, progress=labelled(problem.name), nominal=write_nominal_plan, **asked)


def _write_nominal_plan(plan: Plan, out: Path, figures: bool, film: Path | None) -> None:
    """Write the plan of the nominal robot into a folder within `out`.

    figures: whether to draw its shapes. film: of the plan to come, None where none was asked for; one of this plan
    gets the same name.
    """
    if plan.meta["interrupted"]:
        return
    # A folder of its own: the robust plan may be interrupted, and must not be taken for this one.
    place = out / NOMINAL_FOLDER_NAME
    with output_folder(place, "plan") as staging:
        write(plan, staging)
        if figures:
            draw_shapes_only(plan, staging)
        if film is not None:
            draw_film(plan, staging / film.name)
        files = sorted(path.name for path in staging.iterdir())
    found = summary(plan)
    tip = found["tip_last"]
    announce(
        f"the robot as described ends with its tip {tip:.2f} mm from the target. "
        f"{summary_text.summarise_verdicts(found)}"
    )
    report_written_files(place, files)
    announce("now planning for all robots within the tolerances, which takes longer")


def _open_live_view(problem: Problem, arguments: argparse.Namespace) -> AbstractContextManager[SolverView | None]:
    """Open a window on the search where --live asks for one, and only then load what it needs."""
    if not arguments.live:
        return nullcontext()
    from ctr_nlp.cli import live_views

    return live_views.open_solver_view(problem, plan_options.model_from(arguments))


plan = Command("ctr-nlp plan", partial(_parser, (HORIZON_FORMULATION, *FORMULATIONS)), _run)
steer = Command("ctr-nlp steer", partial(_parser, tuple(FORMULATIONS)), _run)
