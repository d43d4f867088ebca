"""Programs that solve many problems: comparisons, the paper's results, clearance, benchmarks."""
