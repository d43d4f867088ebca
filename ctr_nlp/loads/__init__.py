"""Forces on the robot of a plan: the largest ones at its tip, and those of the walls that it touches."""
