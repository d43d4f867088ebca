"""Benchmarks of speed: single rows, comparison with another commit, growth, other solvers, uncompiled time.

Times are processor times of the thread, or of all processes of a program, so that other programs matter little.
"""
