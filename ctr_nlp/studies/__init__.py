"""Studies of many plans: comparisons, trade-offs, benchmarks, clearance, and reproduction of the paper."""
