"""Write a cohort of synthetic trees of airways, and plan to all of their ends for robots that never saw them.

python scripts/studies/cohort.py DIR [--count 30] [--ends 20]
python scripts/studies/cohort.py DIR --reach [--robots stock_1 stock_4] [--robust] [--workers 2]

The first command writes a mask with uneven sections, and its centrelines, for each seed. The second plans to every
end of these masks, from the carina, and prints how many are reached; it goes on where it was.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.synthetic_tree import draw_mask, synthetic_tree, write_mask
from ctr_nlp.robot.shipped import read_robot_files
from ctr_nlp.studies.reach.outcomes import REACHED
from ctr_nlp.studies.reach.reach import reach_tree
from ctr_nlp.studies.workers.clients import local_client

COHORT_TREES = 30
"""Number of trees; their seeds are 0, 1, 2 and so on."""
COHORT_ENDS = 20
"""Ends of each tree."""
COUNTED = "wide_enough", "as_described", REACHED
"""What is counted in each tree, for the best robot at each end."""


def main() -> None:
    """Write the trees and masks of the seeds from 0 on, or plan to the ends of those that were written."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folder", metavar="DIR", type=Path, help="folder for the files, which are replaced")
    parser.add_argument("--count", metavar="N", type=int, default=COHORT_TREES, help="trees (default 30)")
    parser.add_argument("--ends", metavar="N", type=int, default=COHORT_ENDS, help="ends of each (default 20)")
    parser.add_argument("--reach", action="store_true", help="plan to the ends of the masks in DIR")
    parser.add_argument("--robots", metavar="NAME", nargs="+", help="robots of the package (default: all)")
    parser.add_argument("--robust", action="store_true", help="plan for all robots within the tolerances")
    parser.add_argument("--workers", metavar="N", type=int, default=2, help="processes (default 2)")
    asked = parser.parse_args()
    if asked.reach:
        reach_ends(asked.folder, asked.count, asked.robots, asked.robust, asked.workers)
    else:
        write_trees(asked.folder, asked.count, asked.ends)


def write_trees(folder: Path, count: int, ends: int) -> None:
    """Write `count` trees with so many ends each."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(count):
        tree = synthetic_tree(seed, ends)
        write_vtk(folder / f"tree_{seed:02d}.vtp", tree)
        write_mask(folder / f"tree_{seed:02d}.nii.gz", draw_mask(tree, seed=seed))
        print(f"seed {seed}: {len(tree.branches)} ends")


def reach_ends(folder: Path, count: int, names: list[str] | None, robust: bool, workers: int) -> None:
    """Plan to the ends of the first `count` masks of a folder, and print how many are reached, tree by tree."""
    known = read_robot_files()
    robots = {name: known[name] for name in names or known}
    kind = "robust" if robust else "nominal"
    total = dict.fromkeys(COUNTED, 0)
    with local_client(workers) as client:
        for mask in sorted(folder.glob("tree_*.nii.gz"))[:count]:
            place = folder / f"{mask.name.split('.')[0]}-{kind}"
            found = reach_tree(mask, robots, place, from_carina=True, robust=robust, bound_s=0.0, client=client)
            best = found.counts()["any"]
            for name in COUNTED:
                total[name] += best[name]
            print(mask.name, *(f"{name.replace('_', ' ')} {best[name]}" for name in COUNTED), sep=", ", flush=True)
    wide = max(total["wide_enough"], 1)
    for name in COUNTED[1:]:
        print(f"{name.replace('_', ' ')}: {total[name]} of {total['wide_enough']}, {total[name] / wide:.1%}")


if __name__ == "__main__":
    main()
