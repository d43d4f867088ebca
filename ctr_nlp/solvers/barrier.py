"""Numbers of the primal-dual interior-point method that both of its implementations share.

One solves a chain of frames (`motion/`), the other a motion that several robots share (`scenarios/`); their linear
algebra differs, the method (Fiacco and McCormick's monotone barrier, as in Waechter and Biegler 2006) does not.
"""

from __future__ import annotations

BARRIER_RESIDUAL_FACTOR = 20.0
"""A barrier problem is solved until its residual is this many times its barrier."""
BARRIER_SHRINK_FACTOR = 0.05
"""The next barrier is this part of the last one."""
MAX_STEP_HALVINGS = 25
"""Halvings of a step after which it counts as too small."""
STALL_ITERATIONS = 6
"""A barrier problem is left when so many iterations hardly lower the merit."""
BOUND_RELAXATION = 1e-9
"""How far bounds are moved outwards, so that bounds that meet still have an interior, rad or mm."""
INFINITE_BOUND = 1e20
"""Stands for an infinite bound: its distance enters denominators as a number, so that no case is needed."""
