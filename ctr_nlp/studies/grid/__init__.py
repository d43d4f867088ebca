"""Studies of thousands of plans, on many processes and machines, whose results are kept as they come."""
