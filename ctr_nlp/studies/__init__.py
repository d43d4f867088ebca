"""Many plans side by side: trade-offs, survival of perturbed robots, ends that are reached, and Dask workers."""
