"""Programs that solve many problems: comparisons, the paper remade, clearance, benchmarks."""
