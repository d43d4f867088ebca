"""Loops: robots to experiment on, sensors, what these say of tubes, and steering by that. Knows no device."""
