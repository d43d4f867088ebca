"""Programs that begin with what was measured of a robot."""
