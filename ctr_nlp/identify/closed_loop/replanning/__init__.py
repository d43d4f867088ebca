"""Re-planning of the rest of a motion while the robot moves, for the robot as estimated by then."""
