"""Solvers of chains of Nlps."""
