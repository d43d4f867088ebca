"""Motions that several robots make together, and tubes that several motions have in common.

`scenarios` plans one motion for several robots, `tasks` joins the motions of several tasks, and `design` makes the
tubes themselves unknowns, within rules of manufacture.
"""
