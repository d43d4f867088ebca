"""Planners: they take a problem (robot, target, lumen) and settings, and return a plan."""
