"""Plans as timed motions of axes. Knows no device."""
