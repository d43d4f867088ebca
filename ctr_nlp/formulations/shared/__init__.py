"""Motions that several robots make together, and tubes that several motions have in common."""
