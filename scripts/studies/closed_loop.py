"""Plans on robots that are off by 10 % and 0.05 rad, led by sensors, and open loop beside: a table.

python scripts/studies/closed_loop.py PLAN.npz [PLAN.npz ...] [--draws N] [--case CASE ...] [--how HOW]
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from closed_loop_study import (
    AS_PLANNED,
    CLOSED_LOOP_CASES,
    CLOSED_LOOP_SAMPLES,
    REPLANNING_MODES,
    run_closed_loops,
)

from ctr_nlp import Plan
from ctr_nlp.support.tables import markdown


def main() -> None:
    """Read options, and print a row for every plan and case."""
    parser = argparse.ArgumentParser(description="What feedback makes of plans, and what open loop does.")
    parser.add_argument("plans", metavar="PLAN.npz", nargs="+")
    parser.add_argument(
        "--draws", type=int, default=CLOSED_LOOP_SAMPLES, help=f"robots a plan (default {CLOSED_LOOP_SAMPLES})"
    )
    parser.add_argument(
        "--case", nargs="+", choices=list(CLOSED_LOOP_CASES), default=list(CLOSED_LOOP_CASES), help="(default all)"
    )
    parser.add_argument(
        "--how",
        choices=REPLANNING_MODES,
        default=AS_PLANNED,
        help="how a plan is led: as it is (the default); planned anew before it begins, for robots that are so "
        "far off, and while it goes on, for what is known by then; or planned anew for what was known of a robot "
        "after it was measured in free space",
    )
    asked = parser.parse_args()
    rows = [
        asdict(run_closed_loops(Path(name).stem, Plan.load(name), case, asked.draws, replanning_mode=asked.how))
        for case in asked.case
        for name in asked.plans
    ]
    print(
        markdown(
            list(rows[0]), [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
        )
    )


if __name__ == "__main__":
    main()
