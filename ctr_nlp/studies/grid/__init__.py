"""Studies of many plans: the study file, its cases, their rows of results, and figures of these."""
