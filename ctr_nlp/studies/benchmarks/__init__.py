"""What is measured: pure functions from problems to records; ratios are taken within one run."""

from ctr_nlp.studies.benchmarks.records import Record, regressions

__all__ = ["Record", "regressions"]
