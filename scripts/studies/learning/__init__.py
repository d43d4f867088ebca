"""Errors of a trained network on held-out shapes, and its learning curve."""
