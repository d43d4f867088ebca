"""How the plans of a study are done: on Dask's workers, in batches, whatever dies meanwhile."""
