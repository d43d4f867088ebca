"""Measured shapes to tubes: what a robot's numbers are, how well the data tell them, and what to measure next.

Knows robots, models and how they move; neither plans nor devices.
"""
