"""Forty plans whose verdicts are set beside those of the independent judge, and the table of both.

    python tests/verdict_plans.py FOLDER [--page docs/verdicts.md] [--data ../shared/data]

FOLDER keeps every finished plan and its row, so that an interrupted run goes on where it was; it should lie
outside of the repository. Rows are judged anew where their plan is newer.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from independent_judge import NO, NOT_CHECKED, YES, Judgement, judge

import ctr_nlp
from ctr_nlp.plan.sample_outcomes import sample_outcomes
from ctr_nlp.problems import named_problem

NAMES = "cos", "arc", "line", "line_arc", "synthesis", "euler", "euler_mixed", "bronchus"
AIRWAYS = "chaste_ts002_RLL", "chaste_ts002_LLL", "chaste_ts002_RML", "hra_vhm_left_main"
DESIGNED = "designed_four_airways"
OWN = "own"
VERDICTS = "solved", "arrives", "follows", "stable", "within_limits", "within_wall", "holds"
TOLERANCE = {
    "arrives": 0.05,
    "follows": 0.05,
    "stable": 0.001,
    "within_limits": 0.0,
    "within_wall": 0.05,
    "holds": 0.005 + 1e-9,
}
"""How near to its threshold the judge's number must be where words may differ: mm, of the margin, and one sample
in 200. Limits are found by the same arithmetic on both sides."""
NEAR_BIFURCATION = 0.01
"""A stability margin: below it, how far steps are apart may decide on which branch a robot goes on."""
SAMPLES, SEED = 200, 0
NOT_COVERED_AFTER_SNAPS = "arrives", "follows", "within_wall", "holds"
"""Verdicts that the judge does not give on robots that snap."""


@dataclass(frozen=True)
class Case:
    """One of the plans: a named problem or an airway, on its own robot (Table I's) or on the designed one."""

    problem: str
    robot: str
    planned: str

    @property
    def name(self) -> str:
        return f"{self.problem}-{self.robot}-{self.planned}"


def cases() -> list[Case]:
    """All forty."""
    found = [Case(name, OWN, model) for name in (*NAMES, *AIRWAYS) for model in ("dominant", "elastic")]
    found += [Case(n, DESIGNED, model) for n in ("bronchus", *AIRWAYS) for model in ("dominant", "elastic")]
    found += [Case(name, OWN, "robust") for name in ("cos", "arc", "synthesis", "euler", "bronchus")]
    return [*found, Case("hra_vhm_left_main", DESIGNED, "robust")]


def planned(case: Case, data: Path, frames: int = 100) -> ctr_nlp.Plan:
    """The plan of a case, not yet checked; data is the folder of shared data."""
    robot = None
    if case.robot == DESIGNED:
        robot = ctr_nlp.Robot.from_toml(data / "robots" / f"{DESIGNED}.toml")
    if case.problem in AIRWAYS:
        path = data / "airways" / f"{case.problem}.csv"
        own = ctr_nlp.table_i_robot() if robot is None else robot
        problem = ctr_nlp.problem_from_file(path, robot=own, frames=frames, trim="start")
    else:
        problem = named_problem(case.problem, frames=frames, robot=robot)
    if case.planned == "robust":
        return ctr_nlp.solve_robust(problem)
    return ctr_nlp.solve_horizon(problem, model=case.planned)


# --- one row ---


def row_of(case: Case, raw: ctr_nlp.Plan, checked: ctr_nlp.Plan, path: Path) -> dict[str, Any]:
    """The library's verdicts on a plan beside the judge's, which reads the checked plan from its file."""
    begun = time.perf_counter()
    found = judge(path)
    library = {name: getattr(checked.verdicts, name) for name in VERDICTS}
    row = {
        "case": [case.problem, case.robot, case.planned],
        "raw": {name: getattr(raw.verdicts, name).word for name in VERDICTS},
        "library": {name: [verdict.word, verdict.number] for name, verdict in library.items()},
        "judge": {name: list(found.findings[name]) for name in VERDICTS},
        "snaps": found.result.snaps,
        "differ_mm": _largest_difference(checked, found),
        "samples": _samples(checked, found),
    }
    return row | {"judged_s": time.perf_counter() - begun}


def _largest_difference(plan: ctr_nlp.Plan, found: Judgement) -> float | None:
    """Between shapes in the frames before the first snap or bifurcation, mm: beyond one, chance decides."""
    near = np.flatnonzero(~(found.margin > NEAR_BIFURCATION).all(axis=1))
    frames = min([len(plan.time), *near[:1], *(frame - 1 for frame in found.result.snaps)])
    away = np.linalg.norm(plan.shape[:frames] - found.shape[:frames], axis=-1)
    return float(away.max()) if away.size else None


ONE_BRANCH_MM = 0.5
"""Distance of two tips on one branch of equilibria, at most; on two branches they are further apart."""


def _samples(plan: ctr_nlp.Plan, found: Judgement) -> dict[str, float]:
    """How many samples fail for which reason, by the library and the judge, and how many outcomes differ.

    tip_differ_mm: the largest difference of a sample's distance from the target's end, of samples on their branch;
    0 where the nominal robot ends on two branches, since beyond a bifurcation chance decides which is its own.
    """
    if plan.drawn is None or not found.result.samples:
        return {}
    outcomes = sample_outcomes(plan)
    ours = {
        "lost": outcomes.lost,
        "missed": outcomes.missed_target & ~outcomes.lost,
        "pressed": outcomes.exceeded_contact_limit & ~outcomes.lost,
    }
    theirs = found.result.samples
    counts = {"count": found.result.moved}
    for name, flags in ours.items():
        counts |= {f"{name}_library": int(flags.sum()), f"{name}_judge": int(theirs[name].sum())}
        counts[f"{name}_differ"] = int((flags != theirs[name]).sum())
    held = ~np.any([theirs[name] for name in ours], axis=0)
    one_branch = np.linalg.norm(plan.shape[-1, -1] - found.shape[-1, -1]) < ONE_BRANCH_MM
    kept = ~(outcomes.lost | theirs["lost"]) & one_branch
    away = np.linalg.norm(theirs["tips"] - plan.target[-1, -1], axis=-1)
    tips = abs(outcomes.tip_error - away)[kept]
    counts["tip_differ_mm"] = float(tips.max()) if kept.any() else 0.0
    return counts | {"differ": int((outcomes.passed_all_checks != held).sum())}


def agreement(row: dict[str, Any], name: str) -> str:
    """Of one verdict: "agree", "not covered", "DISAGREE", or "borderline" if words differ near the threshold."""
    word = row["library"][name][0]
    theirs, _, distance = row["judge"][name]
    if word == theirs:
        return "agree"
    if theirs == NOT_CHECKED and row["snaps"] and name in NOT_COVERED_AFTER_SNAPS:
        return "not covered"
    near = distance is not None and name in TOLERANCE and abs(distance) <= TOLERANCE[name]
    return "borderline" if near and {word, theirs} == {YES, NO} else "DISAGREE"


def faults(row: dict[str, Any]) -> list[str]:
    """What is wrong in a row, in words; empty where nothing is."""
    name = "-".join(row["case"])
    found = [
        f"{name}: {verdict} is {row['library'][verdict]} and judged {row['judge'][verdict]}"
        for verdict in VERDICTS
        if agreement(row, verdict) == "DISAGREE"
    ]
    unchecked = ["holds"] if row["case"][2] != "robust" else []
    unchecked += ["stable"] if row["case"][2] == "dominant" else []
    found += [
        f"{name}: {v} reads {row['raw'][v]} before it is checked"
        for v in unchecked
        if row["raw"][v] != NOT_CHECKED
    ]
    if row["case"][2] == "dominant":
        shapes = ("arrives", "follows", "within_wall")
        found += [f"{name}: {v} reads yes on the dominant model" for v in shapes if row["raw"][v] == YES]
    return found


# --- all rows ---


def rows(folder: Path, data: Path, chosen: Iterable[Case]) -> Iterator[dict[str, Any]]:
    """Rows of cases; plans and rows that a folder holds already are not made again."""
    folder.mkdir(parents=True, exist_ok=True)
    for case in chosen:
        raw, checked, row = (folder / f"{case.name}{end}" for end in (".raw.npz", ".npz", ".json"))
        if not raw.exists():
            begun = time.perf_counter()
            plan = planned(case, data)
            plan.save(raw)
            print(f"{case.name}: planned in {time.perf_counter() - begun:.0f} s", flush=True)
        if not checked.exists():
            ctr_nlp.Plan.load(raw).check(SAMPLES, SEED).save(checked)
        if not row.exists() or row.stat().st_mtime < checked.stat().st_mtime:
            found = row_of(case, ctr_nlp.Plan.load(raw), ctr_nlp.Plan.load(checked), checked)
            row.write_text(json.dumps(found))
            print(f"{case.name}: judged in {found['judged_s']:.0f} s", flush=True)
        yield json.loads(row.read_text())


HEAD = """# Verdicts beside an independent judge

This page compares the library's verdicts on 40 plans of 100 frames with those of an independent judge. Each row
is a plan. Each cell gives the library's word and number and, after a `/`, those of the judge; if both words are
the same, the word stands once. The judge shares no code with the library: it reads the motion from `plan.npz`,
solves the tubes' equilibria by shooting from the base, and measures distances to the wall by brute force on
densely sampled points of body and path. `plan.check()` checked every plan on the elastic model and on 200
simulated robots within the tolerances. The judge simulates the same robots.

The columns are the [verdicts](concepts/verdicts.md): *arrives*, the tip's distance from the target's end in mm;
*follows*, the worst e2 in mm; *stable*, the least stability margin; *limits*, the largest share of a speed or
acceleration limit; *wall*, the deepest contact in mm; *holds*, the share of simulated robots that hold. The
judge cannot solve frames: it counts the frames that the plan marks as solved and whose residuals are small.
Where a robot snaps, the library reports a margin of 0, and the judge the least margin before the snap. What
follows a snap depends on how the energy is minimised, and the judge does not look for it: it calls the robot
not stable, and the rest *not covered*.

Words may differ only if the judge's number is very near the threshold: within 0.05 mm, 0.001 of a margin, or
one sample in 200. Such cells are marked *borderline*. `tests/test_verdict_table.py` allows no other difference.
"""


def page(found: list[dict[str, Any]]) -> str:
    """The text of docs/verdicts.md."""
    titles = "solved", "arrives", "follows", "stable", "limits", "wall", "holds"
    lines = ["| plan | " + " | ".join(titles) + " |", "|---|" + "---|" * len(titles)]
    for row in found:
        problem, robot, model = row["case"]
        on = ", designed tubes" if robot == DESIGNED else ""
        lines.append(f"| {problem}{on}, {model} | " + " | ".join(_cell(row, name) for name in VERDICTS) + " |")
    return f"{HEAD}\n{_summary(found)}\n\n" + "\n".join(lines) + "\n"


def _cell(row: dict[str, Any], name: str) -> str:
    (word, number), (theirs, own, _) = row["library"][name], row["judge"][name]
    if word == theirs == NOT_CHECKED:
        return NOT_CHECKED
    if word == theirs:
        return f"{word} {_number(number, name)} / {_number(own, name)}"
    mark = agreement(row, name)
    if mark == "not covered":
        return f"{word} {_number(number, name)} / {mark}"
    text = f"{word} {_number(number, name)} / {theirs} {_number(own, name)}"
    return f"*{text} {mark}*" if mark == "borderline" else f"**{text} {mark}**"


def _number(value: float | None, name: str) -> str:
    if value is None:
        return "–"
    if name == "solved":
        return f"{value:.0f}"
    if name == "within_limits":
        return f"{value:.0f} %"
    if name == "holds":
        return f"{100 * value:.1f} %"
    if name == "within_wall":
        return f"{max(value, 0.0):.2f}"
    return f"{value:.3f}" if name == "stable" else f"{value:.2f}"


def _summary(found: list[dict[str, Any]]) -> str:
    """Sentences with the numbers of agreements and differences."""
    marks = [agreement(row, name) for row in found for name in VERDICTS]
    apart = max((row["differ_mm"] for row in found if row["differ_mm"] is not None), default=0.0)
    count = sum(row["samples"].get("count", 0) for row in found)
    differ = sum(row["samples"].get("differ", 0) for row in found)
    lost = sum(row["samples"].get("lost_differ", 0) for row in found)
    return (
        f"Of {len(marks)} verdicts on {len(found)} plans {marks.count('agree')} agree, "
        f"{marks.count('borderline')} are borderline, {marks.count('not covered')} are not covered after a snap "
        f"and {marks.count('DISAGREE')} disagree. "
        f"Shapes differ by {apart:.2g} mm at most, up to the first snap or bifurcation. "
        f"Of {count} simulated robots {differ} hold in the view of one of the two only; "
        f"{lost} snap or leave the branch in the view of one of the two only."
    )


def main() -> None:
    """Read options, and write the page."""
    parser = argparse.ArgumentParser(description="Verdicts of forty plans beside those of an independent judge.")
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="keeps finished plans and rows")
    parser.add_argument(
        "--page", metavar="FILE.md", type=Path, help="where the table is written (default: nowhere)"
    )
    shared = Path(os.environ.get("CTR_NLP_SHARED_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    parser.add_argument("--data", metavar="DIR", type=Path, default=shared, help="(default: %(default)s)")
    asked = parser.parse_args()
    found = list(rows(asked.folder, asked.data, cases()))
    for fault in (fault for row in found for fault in faults(row)):
        print(fault)
    print(_summary(found))
    if asked.page is not None:
        asked.page.write_text(page(found), encoding="utf-8")


if __name__ == "__main__":
    main()
