"""Plans as trajectories of axes. Knows no device."""
