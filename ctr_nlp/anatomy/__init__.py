"""Anatomy: readers of centrelines and masks, and a seeded generator of synthetic airways."""
