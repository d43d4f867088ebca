"""Solvers of chains: all frames of one robot's motion in one nonlinear program."""
