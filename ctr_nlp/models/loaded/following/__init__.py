"""Loaded robots followed along motions: the places of a motion, and the equilibria there."""
