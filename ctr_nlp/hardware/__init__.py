"""Plans to timed commands to devices: knows plans, not NLPs."""
