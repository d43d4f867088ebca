"""Many plans beside each other: comparisons, trade-offs, benchmarks, clearance, and the paper remade."""
