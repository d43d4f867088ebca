"""Nonlinear programs as symbols: one frame, its terms, and chains of frames. Knows no solver."""
