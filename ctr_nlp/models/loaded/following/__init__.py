"""Loaded robots along motions: the places of a course, and the equilibria there."""
