"""Studies of many plans: the file that describes one, its cases, their rows, and figures of these."""
