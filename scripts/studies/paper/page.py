"""Page of Markdown of the reproduced paper, with its figures and the numbers behind them."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Sequence
from pathlib import Path

from ctr_nlp.support import tables
from ctr_nlp.view.figures import save
from paper.runs import NO_WALL_SETTINGS, PAPER_METHOD_LABELS, PaperResults
from paper.section import PaperSection

INTRODUCTION = """\
# The paper's figures and Table II, remade

*Curvature-Based Continuous Steering of Stiffness-Dominant Concentric Tube Robots* ("the paper") is known here as
text: its statements, the captions of its figures, and Table II. Each figure is remade from our own runs, the
paper's numbers stand beside ours, and where numbers can decide about one of its statements, those of this run do.

**Methods.** {methods}.

The paper's method and its baseline are our re-implementations of its descriptions, in numpy and scipy, forward
from frame to frame as published; where they do worse or better than published, that is said and not explained
away.

**This run.** {frames} frames in 10 s; lambda {weight:g} s² frame by frame; {seconds:.0f} s with {jobs} on
{machine}. {failures}.

## What agrees

"""
READING = """\
## How the paper was read

- **(11)** taken literally shrinks the robot: an integral of squares over [0, beta_3] is least for a robot that is
  not out at all. The tip belongs to the target's end, so beta_3 is the target's length.
- **Weights** of the motion term, 100 and 500, have no unit. Ours are in s², with 10 mm for a radian.
- **Table I** lists 50, 107, 150 mm as straight parts; section IV.B deploys as much, and only curved parts are
  deployed: these are the curved parts here.
- **The arc** is y = sqrt(100² - x²) - 100; printed is sqrt(1 - x²) - 100.
- **q2** of `synthesis` is printed with 7 of its 8 numbers; all its angles are taken to be pi.
- **e1** is a distance, as the paper's words say; its formula has another square root.
- **The bronchus** is not public: ours is a synthetic airway, the last 150 mm of the one of seed 0. No wall
  counts here.
- **Euler curves** of Fig. 10 are given without numbers: these are ours.

## How to remake it

    python scripts/studies/reproduce.py --frames {frames}

It writes `seed.md` (this page), a picture for each figure, and for each a `.csv` file with the numbers behind it.
"""


def write(found: PaperResults, sections: Sequence[PaperSection], folder: Path) -> Iterator[str]:
    """Write seed.md, and a PNG and a CSV file for each of `sections`, into an existing folder.

    found: results of the run. Yields the name of each section after its files, so that the caller may stop.
    """
    for section in sections:
        tables.write_csv(folder / f"{section.name}.csv", section.rows(found))
        if section.draw is not None:
            save(section.draw(found), folder / f"{section.name}.png")
        yield section.name
    (folder / "seed.md").write_text(page(found, sections), encoding="utf-8")


def page(found: PaperResults, sections: Sequence[PaperSection]) -> str:
    """Return the page in Markdown, made of `sections` and the results `found`."""
    failures = found.failures()
    introduction = INTRODUCTION.format(
        methods="; ".join(f"`{key}`: {PAPER_METHOD_LABELS[key]}" for key in methods(found)),
        frames=found.frames,
        weight=NO_WALL_SETTINGS.motion_weight,
        seconds=found.seconds,
        jobs=f"{found.jobs} process{'es side by side' if found.jobs > 1 else ''}",
        machine=machine(),
        failures=f"Of ours not solved: {'; '.join(failures)}"
        if failures
        else "Every frame of our methods was solved",
    )
    body = "".join(_section(found, section) for section in sections)
    return introduction + verdicts(found, sections) + body + READING.format(frames=found.frames)


def methods(found: PaperResults) -> list[str]:
    """Return the methods that were run for the results `found`, in the order of PAPER_METHOD_LABELS."""
    used = {task.method for task in found.task_seconds}
    return [name for name in PAPER_METHOD_LABELS if name in used]


def verdicts(found: PaperResults, sections: Sequence[PaperSection]) -> str:
    """Return the table of the statements of all `sections`, with the verdict of the results `found` on each."""
    body = [
        [f"[{section.name}](#{_anchor(section.title)})", f"{check.source}: {check.statement}", check.verdict]
        for section in sections
        for check in section.checks(found)
    ]
    return tables.markdown(["where", "statement", "here"], body).replace("---:", "---") + "\n"


def _section(found: PaperResults, section: PaperSection) -> str:
    picture = "" if section.draw is None else f"![{section.title}]({section.name}.png)\n\n"
    numbers = "".join(
        f"{table.caption}:\n\n{tables.markdown(table.header, table.body)}\n" for table in section.tables(found)
    )
    checks = "".join(
        f"- **{check.verdict[0].upper()}{check.verdict[1:]}.** {check.source}: {check.statement}. "
        f"Found: {check.finding}.\n"
        for check in section.checks(found)
    )
    return (
        f"## {section.title}\n\n{picture}{section.about} Numbers: [`{section.name}.csv`]({section.name}.csv).\n\n"
        f"{numbers}{checks}\n**Not known.** {section.unknown}\n\n"
    )


def _anchor(title: str) -> str:
    """Return the anchor that GitHub gives to a heading."""
    kept = "".join(c for c in title.lower() if c.isalnum() or c in " -_")
    return kept.replace(" ", "-")


def machine() -> str:
    """Describe the machine: number of cores and kind of the processor, as far as they are known."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    name = models[0] if models else platform.processor() or platform.machine()
    return f"{os.cpu_count()} cores of {name}"


def section_seconds(found: PaperResults, section: PaperSection) -> float:
    """Return the time of all tasks of a section in the results `found`, s; shared tasks count for each section."""
    return sum(found.task_seconds[task] for task in section.tasks)
