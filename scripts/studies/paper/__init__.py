"""Reproduction of the paper's figures and its Table II from one run, compared with the published numbers."""

from paper.parts import SECTIONS
from paper.runs import PaperResults, run_tasks

__all__ = ["SECTIONS", "PaperResults", "run_tasks"]
