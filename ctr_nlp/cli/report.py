"""A plan as files and as a table on the terminal."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from ctr_nlp.cli.console import INTERRUPTED, SOLVED, SOME_FAILED, console, print_table, shown
from ctr_nlp.figures import save_all, save_front
from ctr_nlp.metrics import by_frame, summary
from ctr_nlp.plan import Plan
from ctr_nlp.trade_off import Point

MOST_REASONS = 10
"""Failures that are printed one by one; the plan holds them all."""


def write(plan: Plan, folder: Path) -> None:
    """plan.npz, errors.csv, summary.json and the pictures."""
    plan.save(folder / "plan.npz")
    write_table(folder / "errors.csv", {name: column.tolist() for name, column in by_frame(plan).items()})
    text = json.dumps(summary(plan), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    save_all(plan, folder)


def write_table(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Named columns as CSV."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def print_report(plan: Plan, out: Path) -> None:
    """The numbers of a plan, what is wrong with it, and where it was written."""
    found = summary(plan)
    on = [] if found["evaluated"] == "dominant" == found["model"] else [found["model"]]
    how = [found["formulation"], *on, "by", found["solver"]] + [found["direction"]] * (
        found["direction"] is not None
    )
    seen = "" if found["evaluated"] == found["model"] else f", on the {found['evaluated']} model"
    print_table(
        f"{found['problem']}, {' '.join(how)}{seen}",
        ("", "value", "unit"),
        [
            ("e3, RMS over frames of e2", found["e3"], "mm"),
            ("e4, median over frames of e2", found["e4"], "mm"),
            ("largest error, at equal arc length", found["e_max"], "mm"),
            ("largest distance to the target", found["nearest_max"], "mm"),
            ("largest tip error", found["tip_max"], "mm"),
            (
                "largest step of alpha, beta, theta",
                " / ".join(map(shown, found["max_step"].values())),
                "rad / mm / rad",
            ),
            *_stability(found),
            *_clearance(found),
            *_effort(found),
            ("frames, and of these not solved", f"{found['frames']} / {found['failed']}", ""),
        ],
    )
    if found["acceleration_used"] > 1:
        console().print(
            f"the motion needs {found['acceleration_used']:.1f} times the acceleration that limits allow"
        )
    if found["stability_binds"]:
        parts = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in found["stability_binds"])
        console().print(f"stability (margin {plan.meta['options']['stability_margin']:g}) limits frames {parts}")
    if found["stability_missed"]:
        frame, least = found["stability_missed"]
        console().print(f"the margin is missed between frames: {least:.3f} on the way to frame {frame}")
    for snap in found["snaps"]:
        tubes = ", ".join(map(str, snap["tubes"]))
        console().print(
            f"snap on the way to frame {snap['frame']}: tips of tubes {tubes} turn by {snap['jump']:.2f} rad"
        )
    for contact in found["contacts"]:
        first, last = contact["first"], contact["last"]
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        console().print(
            f"contact in {frames}: tube {contact['tube']} by up to {contact['depth']:.2f} mm, "
            f"{contact['path']:.0f} mm along the path in frame {contact['frame']}"
        )
    weight, asked = found["weights"]["contact_mm"], plan.meta["options"].get("contact_weight")
    if found["contacts"] and weight is not None and weight < asked:
        part = plan.meta["options"]["clearance_cost"]
        console().print(
            f"less contact would raise e3 by more than {part:.0%}: a mm of it was weighed {weight:.2g} and not "
            f"{asked:g} mm² (--clearance-cost)"
        )
    reasons = list(plan.meta["failures"].items())
    for frame, why in reasons[:MOST_REASONS]:
        console().print(f"{'' if frame == 'all' else 'frame '}{frame} not solved: {why}")
    if len(reasons) > MOST_REASONS:
        console().print(f"and {len(reasons) - MOST_REASONS} more")
    if plan.meta["interrupted"]:
        console().print("interrupted: the plan holds what was solved until then")
    console().print(
        f"wrote {out}: {', '.join(sorted(path.name for path in out.iterdir() if path.name[0] != '.'))}"
    )


def _stability(found: dict[str, Any]) -> list[tuple[str, Any, str]]:
    """The least margins, where the model has any."""
    if found["stability_min"] is None:
        return []
    margins = f"{found['stability_min']:.3f} / {found['stability_between_min']:.3f}"
    return [("least stability margin, at and between frames", margins, "")]


def _clearance(found: dict[str, Any]) -> list[tuple[str, Any, str]]:
    """What is left to the lumen's wall, where that is known."""
    if found["clearance_min"] is None:
        return []
    rows: list[tuple[str, Any, str]] = [("least clearance from the lumen's wall", found["clearance_min"], "mm")]
    if found["contacts"]:
        frames = sum(contact["last"] - contact["first"] + 1 for contact in found["contacts"])
        rows.append(
            ("frames in contact, and depths summed", f"{frames} / {shown(found['contact_depth'])}", "/ mm")
        )
    return rows


def _effort(found: dict[str, Any]) -> list[tuple[str, Any, str]]:
    """What the plan took: a time a frame, or the times of a start and a horizon."""
    times = found["solve_ms"]
    if times["median"] is not None:
        return [("time a frame, median and 99 %", f"{shown(times['median'])} / {shown(times['p99'])}", "ms")]
    return [
        (
            "roughness, and its weight in the objective",
            f"{found['roughness']:.0f} / {found['weights']['motion_s2']:.2g}",
            "mm²/s / s²",
        ),
        (
            "time for the start, and for the horizon",
            f"{shown(found['search_s'])} / {shown(times['total'] / 1e3)}",
            "s",
        ),
    ]


def exit_status(plan: Plan) -> int:
    """0 every frame solved, 1 some not, 130 interrupted."""
    if plan.meta["interrupted"]:
        return INTERRUPTED
    return SOLVED if plan.complete else SOME_FAILED


def write_front(points: Sequence[Point], problem: str, folder: Path) -> None:
    """pareto.csv and its picture."""
    names = [field.name for field in fields(Point)]
    write_table(folder / "pareto.csv", {name: [getattr(point, name) for point in points] for name in names})
    save_front(points, problem, folder)


def print_front(points: Sequence[Point]) -> None:
    """A line a weight, then a line a method."""
    print_table(
        "error against roughness (a star: not solved everywhere)",
        ("", "weight s²", "e3 mm", "roughness mm²/s"),
        [
            (
                point.method + ("" if point.solved else " *"),
                f"{point.motion_weight:.2g}",
                point.e3,
                f"{point.roughness:.0f}",
            )
            for point in points
        ],
    )
