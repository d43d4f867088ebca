"""Programs that start from measurements of a robot."""
