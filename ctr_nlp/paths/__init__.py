"""Targets of motions: curves, lumens, targets and problems. Imports no model and no solver."""
