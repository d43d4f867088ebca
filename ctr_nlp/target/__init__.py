"""What is followed: curves, lumens, targets and problems. Knows no model and no program."""
