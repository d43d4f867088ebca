"""Steering step by step without a screen: targets, joints, draws, recordings. Knows no browser."""
