"""What a study costs beside its plans: a projection to many workers, and a comparison with a pool of processes."""
