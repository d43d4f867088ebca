"""The rest of a motion planned anew while the robot moves, for what is known of it by then."""
