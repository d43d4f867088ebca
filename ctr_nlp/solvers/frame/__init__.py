"""Solvers of the program of one frame, and of many frames one after another."""
