"""Checks, files and processes that any room may use. Knows no robot, no curve and no program."""
