"""Comparison with forward models of other laboratories: interface to their programs, and agreement with ours."""
