"""Nonlinear programs as symbols: one frame, and all frames of a motion. Nothing here knows a solver.

`nlp` is the program of one frame, `written` its expressions and derivatives. `chain` (with `links`) is one robot's
motion over all frames, `scenarios` that of several robots that share their motors. `alike`, `at_place` and
`parted` rewrite a frame's derivatives so that compiled code evaluates many sample points of a robot together.
"""
