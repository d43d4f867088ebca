"""Compare plans that lean on the wall with plans that keep off it, at the narrowest ends of a tree.

python scripts/studies/contact.py MASK FILE.csv --from-carina [--robot stock_1] [--ends 20] [--seconds 90]

Each end gets up to three plans for the robot as described: one that may touch the wall by so many mm ("avoids"),
one that begins with it and may lean on the wall with so much force ("leans"), and, where that one presses harder
than half as much as the first, one that may press half as much ("halves"). A plan that takes too long is stopped,
and counts as far as it was found. All are moved along the wall in ten sub-steps a frame, and the largest force at
a place is found. A row is written for each end as it is done; ends in the file are left.
"""

from __future__ import annotations

import argparse
import csv
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp import CtrError, Plan, Problem, Settings, solve_horizon, solve_on_wall
from ctr_nlp.anatomy.lumen_tree import LumenTree, read_lumen_tree
from ctr_nlp.exceptions import OptionError
from ctr_nlp.loads.contact_equilibria import ContactEquilibria
from ctr_nlp.loads.contact_plan import replay_on_wall
from ctr_nlp.loads.tissue import AIRWAY_WALL_STIFFNESS_N_PER_MM2, CONTACT_FORCE_ALLOWED_N
from ctr_nlp.loads.winkler_wall import WinklerWall
from ctr_nlp.models.loads import Load, with_modulus
from ctr_nlp.robot import Robot
from ctr_nlp.robot.shipped import read_robot
from ctr_nlp.support.tables import write_csv

HALF = 0.5 + 1e-3
"""Part of a force that counts as half of it: forces are rounded in the table."""
NITINOL_MPA = 60_000.0
"""Young's modulus of tubes whose file tells none."""
COLUMNS = (
    *(
        "robot",
        "end",
        "room_mm",
        "avoids_tip_mm",
        "avoids_contact_mm",
        "avoids_reached",
        "avoids_force_N",
        "avoids_failed",
    ),
    *("leans_tip_mm", "leans_contact_mm", "leans_reached", "leans_force_N", "leans_margin"),
    *("leans_margin_without_wall", "leans_failed"),
    *("halves_tip_mm", "halves_contact_mm", "halves_reached", "halves_force_N", "halves_margin"),
    *("halves_margin_without_wall", "halves_failed", "process_s"),
)


def main() -> None:
    """Plan to the narrowest ends twice, and write the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("mask", metavar="MASK", type=Path, help="mask of the airways")
    parser.add_argument("table", metavar="FILE.csv", type=Path, help="table that rows are added to")
    parser.add_argument("--robot", metavar="FILE.toml|NAME", default="stock_1", help="robot (default stock_1)")
    parser.add_argument("--ends", metavar="N", type=int, default=20, help="ends, narrowest first (default 20)")
    parser.add_argument("--frames", metavar="T", type=int, default=25, help="frames of a plan (default 25)")
    parser.add_argument("--force", metavar="N", type=float, default=CONTACT_FORCE_ALLOWED_N, help="allowed, N")
    parser.add_argument("--from-carina", action="store_true", help="insert the robot at the main bifurcation")
    parser.add_argument(
        "--seconds", metavar="S", type=float, default=90.0, help="process time of a plan (default 90)"
    )
    asked = parser.parse_args()
    robot = with_modulus(read_robot(asked.robot), NITINOL_MPA)
    tree = read_lumen_tree(asked.mask, from_carina=asked.from_carina)
    rows: list[dict[str, Any]] = [dict.fromkeys(COLUMNS, "") | row for row in read_rows(asked.table)]
    done = {(row["robot"], row["end"]) for row in rows}
    for end, room in narrowest_ends(tree, robot)[: asked.ends]:
        if (asked.robot, str(end)) in done:
            continue
        row = {"robot": asked.robot, "end": end, "room_mm": round(room, 3)}
        row |= compare_plans(tree.problem(end, robot, asked.frames), asked.force, asked.seconds)
        rows.append(dict.fromkeys(COLUMNS, "") | row)
        write_csv(asked.table, rows)
        print(", ".join(f"{name} {value}" for name, value in row.items() if value != ""), flush=True)
    summarise(read_rows(asked.table))


def narrowest_ends(tree: LumenTree, robot: Robot) -> list[tuple[int, float]]:
    """Return the ends that a robot is long enough for, narrowest first, each with its least room, mm."""
    longest = float(robot.split(robot.upper)[1][-1])
    rooms = [(end.number, tree.find_narrowest(end, robot)) for end in tree.ends if end.path.length <= longest]
    return sorted(((k, room.margin) for k, room in rooms if room is not None), key=lambda each: each[1])


def compare_plans(problem: Problem, limit: float, seconds: float) -> dict[str, Any]:
    """Plan to an end with and without leaning on the wall; return the columns of its row.

    limit: largest force at a place, N. seconds: process time of a plan.
    """
    begin = time.process_time()
    with interrupt_after(seconds):
        avoids = solve_horizon(problem)
    found: dict[str, Any] = {f"avoids_{name}": value for name, value in describe(avoids).items()}
    force = found["avoids_force_N"] = peak_force(problem, avoids)
    found |= lean("leans", problem, avoids, limit, seconds)
    leaning = found.get("leans_force_N")
    if isinstance(force, float) and isinstance(leaning, float) and leaning > force / 2 > 0:
        found |= lean("halves", problem, avoids, force / 2, seconds)
    return found | {"process_s": round(time.process_time() - begin)}


@contextmanager
def interrupt_after(seconds: float) -> Iterator[None]:
    """Press Ctrl-C after so much process time: a planner then ends with the best that it has."""
    before = signal.signal(signal.SIGPROF, lambda number, frame: signal.raise_signal(signal.SIGINT))
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def lean(way: str, problem: Problem, avoids: Plan, limit: float, seconds: float) -> dict[str, Any]:
    """Return the columns called `way`: of a plan that leans on the wall with at most `limit` N at a place.

    seconds: process time of the plan.
    """
    try:
        with interrupt_after(seconds):
            plan = solve_on_wall(problem, limit, initial=avoids)
    except OptionError as error:
        return {f"{way}_failed": str(error)}
    assert plan.place_force_between is not None
    assert plan.stability_without_wall is not None
    # Where the robot snaps, nothing is known of the frames that follow.
    known = np.isfinite(plan.stability_between).all()
    found = describe(plan) | {
        "force_N": round(float(np.max(plan.place_force_between)), 4) if known else "snaps",
        "margin": round(float(np.min(plan.stability_between)), 4) if known else "snaps",
        "margin_without_wall": round(float(np.min(plan.stability_without_wall)), 4),
    }
    return {f"{way}_{name}": value for name, value in found.items()}


def describe(plan: Plan) -> dict[str, Any]:
    """Return where a plan's tip ends, its deepest contact, mm, whether it reaches its end, and what failed.

    Built robots are not simulated. Where the tip ends is "" where the robot snaps before.
    """
    verdicts = plan.verdicts
    assert plan.clearance_between is not None
    tip = verdicts.arrives.number
    return {
        "tip_mm": "" if tip is None else round(float(tip), 3),
        "contact_mm": round(max(0.0, -float(np.nanmin(plan.clearance_between))), 3),
        "reached": "yes" if verdicts.end_reached_as_described else "no",
        "failed": " ".join([*verdicts.failed_names, *["stopped"] * plan.meta["interrupted"]]),
    }


def peak_force(problem: Problem, plan: Plan) -> float | str:
    """Return the largest force at one place, N, of a plan's robot on the wall; "snaps" where it snaps there."""
    assert problem.wall is not None
    wall = WinklerWall(problem.wall, AIRWAY_WALL_STIFFNESS_N_PER_MM2)
    try:
        found = replay_on_wall(ContactEquilibria(problem.robot, wall, Load()), problem.wall, plan.q)
    except CtrError:
        return "snaps"
    return round(float(np.max(found.place_between)), 4) if found.in_equilibrium.all() else "snaps"


def read_rows(table: Path) -> list[dict[str, str]]:
    """Return the rows of a table, none where there is no such file."""
    if not table.exists():
        return []
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def summarise(rows: list[dict[str, str]]) -> None:
    """Print how many ends are reached either way, and at how many leaning halves the largest force."""
    for name in dict.fromkeys(row["robot"] for row in rows):
        own = [row for row in rows if row["robot"] == name]
        reached = [sum(row[f"{way}_reached"] == "yes" for row in own) for way in ("avoids", "leans")]
        print(f"{name}: {len(own)} ends, {reached[0]} reached free of the wall, {reached[1]} leaning on it")
        known = [row for row in own if row["avoids_force_N"] not in ("", "snaps", "0.0")]
        halved = sum(is_halved(row) for row in known)
        print(f"  {halved} of {len(known)} are reached as near with half of the largest force, or less")


def is_halved(row: dict[str, str]) -> bool:
    """Return whether a plan that leans on the wall has half of the force of the other, as near its end.

    The limit of arrival counts as near, too.
    """
    near = max(float(row["avoids_tip_mm"]), Settings().arrival_tolerance)
    ways = [way for way in ("leans", "halves") if row[f"{way}_force_N"] not in ("", "snaps")]
    most = HALF * float(row["avoids_force_N"])
    return any(float(row[f"{way}_force_N"]) <= most and float(row[f"{way}_tip_mm"]) <= near for way in ways)


if __name__ == "__main__":
    main()
