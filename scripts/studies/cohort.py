"""Write a cohort of synthetic trees of airways: for each seed a mask with uneven sections, and its centrelines.

python scripts/studies/cohort.py DIR [--count 30] [--ends 20]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.synthetic_tree import draw_mask, synthetic_tree, write_mask

COHORT_TREES = 30
"""Number of trees; their seeds are 0, 1, 2 and so on."""
COHORT_ENDS = 20
"""Ends of each tree."""


def main() -> None:
    """Write the trees and masks of the seeds from 0 on."""
    parser = argparse.ArgumentParser(description="Write a cohort of synthetic trees of airways.")
    parser.add_argument("folder", metavar="DIR", type=Path, help="folder for the files, which are replaced")
    parser.add_argument("--count", metavar="N", type=int, default=COHORT_TREES, help="trees (default 30)")
    parser.add_argument("--ends", metavar="N", type=int, default=COHORT_ENDS, help="ends of each (default 20)")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    for seed in range(asked.count):
        tree = synthetic_tree(seed, asked.ends)
        write_vtk(asked.folder / f"tree_{seed:02d}.vtp", tree)
        write_mask(asked.folder / f"tree_{seed:02d}.nii.gz", draw_mask(tree, seed=seed))
        print(f"seed {seed}: {len(tree.branches)} ends")


if __name__ == "__main__":
    main()
