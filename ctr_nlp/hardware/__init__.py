"""From plans to trajectories to devices. Knows plans, no NLPs."""
