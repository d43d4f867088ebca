"""Execution of a study on Dask's workers: in batches, and tolerant of workers that die."""
