"""What is followed: curves, lumens, targets and problems. Imports no model and no solver."""
