"""Steering step by step without a screen: targets, joints, simulated robots, recordings. Knows no browser."""
