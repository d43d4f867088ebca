"""Robots from measured shapes: their parameters, how well the data determine these, and what to measure next.

Knows robots, models and how they move; neither plans nor devices.
"""
