"""Solvers of one Nlp after another."""
