"""The study as a page of Markdown, a table and a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ctr_nlp.figures import save
from ctr_nlp.studies.airways import FOLLOWED_MM
from ctr_nlp.studies.clearance.alone import CLEAR, STARTS
from ctr_nlp.studies.clearance.cases import WITH, Airway
from ctr_nlp.studies.clearance.cost import cost_of_clearance
from ctr_nlp.support.tables import markdown, write_csv

ROUNDING = 1e-6
"""% of e3 that rounding may add."""


@dataclass(frozen=True)
class Claim:
    """A sentence, the cases that it is about, and those among them that it does not hold for."""

    says: str
    about: tuple[Airway, ...]
    exceptions: tuple[Airway, ...]

    @property
    def holds(self) -> bool:
        """In every case that it is about."""
        return not self.exceptions

    def __str__(self) -> str:
        held = f"{len(self.about) - len(self.exceptions)} of {len(self.about)}"
        but = f"; not in {', '.join(case.name for case in self.exceptions)}" if self.exceptions else ""
        return f"{self.says}: in {held} cases{but}"


def claims(cases: Sequence[Airway]) -> tuple[Claim, Claim, Claim]:
    """That clearance is cheap, that it helps, and that all of it is had where it can be had.

    The last is said the other way round: cases without any contact left are not asked what clearance alone
    could have.
    """
    most = 100 * WITH.affordable()
    return (
        _claim(
            f"with clearance e3 is at most {most:g} % above that without",
            cases,
            lambda case: case.growth <= most + ROUNDING,
        ),
        _claim(
            "summed contact depth is lower with clearance than without, where there is any without",
            [case for case in cases if case.contact_without > 0],
            lambda case: case.contact_with < case.contact_without,
        ),
        _claim(
            "where contact is left with clearance, clearance alone leaves some too",
            [case for case in cases if case.contact_with > 0],
            lambda case: not case.clearable,
        ),
    )


def _claim(says: str, about: Sequence[Airway], holds: Callable[[Airway], bool]) -> Claim:
    return Claim(says, tuple(about), tuple(case for case in about if not holds(case)))


def frames_missed(cases: Sequence[Airway]) -> str:
    """The last claim frame by frame, as a sentence."""
    left = [case for case in cases if case.frames_with]
    missed, touching = (sum(getattr(case, name) for case in left) for name in ("alone_clear", "frames_with"))
    total = sum(case.frames for case in cases)
    some = sum(case.alone_clear > 0 for case in left)
    return (
        f"frame by frame: {touching} of {total} frames are in contact with clearance, in {len(left)} cases; "
        f"in {missed} of these, in {some} cases, clearance alone leaves no contact"
    )


HEADER = (
    "airway",
    "e3 without",
    "with",
    "growth",
    "first",
    "contact without",
    "with",
    "first",
    "frames without",
    "with",
    "alone",
    "clear",
    "short without",
    "with",
    "first",
)
"""Columns of the tables."""
QUARTILES = {"least": 0.0, "quarter": 0.25, "median": 0.5, "three quarters": 0.75, "most": 1.0}
INTRODUCTION = """\
# What clearance costs and brings

Every airway is planned three times over all frames at once: without clearance (`contact_weight` 0), with it (the
defaults), and with clearance first (`clearance_cost` inf). What this shows:

"""
EXPLANATION = """\

![Contact without and with clearance, and growth of e3](clearance.png)

**Robot and motion.** The paper's robot of three tubes, free at its base, on the dominant model; {frames} frames
in 10 s. Defaults: {clearance:g} mm are to be kept between tubes and wall, a mm less costs {weight:g} mm² in a
frame, and e3 may grow by {most:g} % for it; where it would grow by more, contact costs less.

**Airways.** {real} read from centreline files, followed from their first point and trimmed at the end to what
the robot reaches; {synthetic} made by `synthetic_airway(seed)`, of which the last {followed:g} mm are followed.
The lumen is the whole path in either case.

**Contact** is by how much the robot is beyond the wall at most in a frame, at 101 samples along it and with the
radius of the outermost tube there, summed over frames.

**Clearance alone** is the least contact that can be had in a frame in which contact is all that counts: neither
the shape's error nor the frames before and after. *The robot is out to the target's full length there* (beta_d =
min(length of the frame's target, reach)): a robot that may stay short has no contact at all, trivially. It is
asked in the frames that are in contact with clearance, and solved from {starts} Sobol points, the plans' own
configurations and the answer of the frame before, until one has less than {clear:g} mm, which counts as 0. It is
a bound from above, as any search from many starts. Plans are not held to the full length: how much shorter than
its target the robot is at most stands in the last columns, and contact that clearance alone does not avoid can
be avoided by staying short.

## Columns

| column | what it is |
|---|---|
| e3 without, with | mm |
| growth, first | of e3 with clearance, and with clearance first, % |
| contact without, with, first | summed over frames, mm; 0 where nothing touches in any frame |
| frames without, with | in contact |
| alone | what clearance alone leaves of the contact with clearance, mm; empty where there is none |
| clear | in how many of the frames in contact clearance alone leaves none |
| short without, with, first | by how much the robot is shorter than its target at most, mm |
"""
REMAKING = """\
## How to remake it

    ctr-nlp study examples/clearance.toml --out DIR

with centreline files of {files} and of synthetic airways in `[problems]`. It writes `clearance.md` (this page),
`clearance.csv` with all numbers, and `clearance.png`, beside the rows of the study.
"""


def write(cases: Sequence[Airway], folder: Path) -> None:
    """Write clearance.md, clearance.csv and clearance.png into a folder that exists."""
    rows = [asdict(case) | {"growth": case.growth, "growth_first": case.growth_first} for case in cases]
    write_csv(folder / "clearance.csv", rows)
    save(cost_of_clearance(cases), folder / "clearance.png")
    (folder / "clearance.md").write_text(page(cases), encoding="utf-8")


def findings(cases: Sequence[Airway]) -> list[str]:
    """The claims and what there is to them, a sentence each."""
    cheap, helps, complete = claims(cases)
    growth = [case.growth for case in cases]
    sums = [sum(getattr(case, f"contact_{name}") for case in cases) for name in ("without", "with", "first")]
    clean = sum(case.contact_with == 0 for case in cases)
    unsolved = [case.name for case in cases if not case.solved]
    return [
        f"{cheap} (median {np.median(growth):.1f} %, at most {max(growth):.2f} %)",
        f"{helps} (all cases together {sums[0]:.0f} mm without, {sums[1]:.0f} mm with, {sums[2]:.1f} mm with "
        f"clearance first; none at all is left in {clean} of {len(cases)})",
        str(complete),
        frames_missed(cases),
        f"not solved in all frames: {', '.join(unsolved)}" if unsolved else "every frame of every plan was solved",
    ]


def page(cases: Sequence[Airway]) -> str:
    """All of it in Markdown."""
    real, synthetic = ([case for case in cases if case.synthetic is made] for made in (False, True))
    numbers = {
        "frames": cases[0].frames,
        "clearance": WITH.clearance,
        "weight": WITH.contact_weight,
        "most": 100 * WITH.affordable(),
        "real": len(real),
        "synthetic": len(synthetic),
        "followed": FOLLOWED_MM,
        "starts": STARTS,
        "clear": CLEAR,
        "files": ", ".join(f"`{case.name}`" for case in real) or "your own",
    }
    parts = [INTRODUCTION, *(f"{k}. {text[0].upper()}{text[1:]}.\n" for k, text in enumerate(findings(cases), 1))]
    parts.append(EXPLANATION.format(**numbers))
    for title, some in (("Real airways", real), ("Synthetic airways, by seed", synthetic)):
        if some:
            parts.append(f"\n## {title}\n\n{markdown(HEADER, [_cells(case) for case in some])}")
    if synthetic:
        table = np.quantile([_numbers(case) for case in synthetic], list(QUARTILES.values()), axis=0)
        spread = [[name, *_shown(line)] for name, line in zip(QUARTILES, table.tolist(), strict=True)]
        parts.append(f"\nTheir spread, column by column:\n\n{markdown(HEADER, spread)}")
    return "".join([*parts, "\n", REMAKING.format(**numbers)])


def _numbers(case: Airway) -> list[float]:
    """What stands in the columns after the first, as numbers."""
    return [
        *(case.e3_without, case.e3_with, case.growth, case.growth_first),
        *(case.contact_without, case.contact_with, case.contact_first),
        *(case.frames_without, case.frames_with, case.alone, case.alone_clear),
        *(case.short_without, case.short_with, case.short_first),
    ]


def _cells(case: Airway) -> list[str]:
    name = case.name.removeprefix("synthetic ") if case.synthetic else case.name
    alone = slice(10, 12) if case.contact_with == 0 else slice(0)
    cells = [name, *_shown(_numbers(case))]
    cells[alone] = [""] * len(cells[alone])
    return cells


def _shown(numbers: Sequence[float]) -> list[str]:
    """As text: mm of e3 to the third decimal, % to the first, mm of contact to the second, unless they are 0."""
    places = (3, 3, 1, 1, 2, 2, 2, 0, 0, 2, 0, 1, 1, 1)
    return [f"{x:.{k}f}" if x else "0" for x, k in zip(numbers, places, strict=True)]
