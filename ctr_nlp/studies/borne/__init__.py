"""Forces that plans bear: at their tips, and of the walls that they touch."""
