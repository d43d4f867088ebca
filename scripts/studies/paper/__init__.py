"""The paper's figures and its Table II remade from one run, beside what the paper printed."""

from paper.parts import SECTIONS
from paper.runs import PaperResults, run_tasks

__all__ = ["SECTIONS", "PaperResults", "run_tasks"]
