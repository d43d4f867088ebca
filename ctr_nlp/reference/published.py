"""What the seed printed: Table II, stiffness model, as (e3 in mm, e4 in mm, time a frame in s)."""

SEED = {
    "cos": (1.81, 1.67, 0.25),
    "arc": (1.62, 1.36, 0.10),
    "line": (7.46, 4.84, 0.10),
    "line_arc": (2.67, 1.88, 0.13),
    "synthesis": (0.98, 0.46, 0.14),
    "bronchus": (2.02, 1.93, 0.26),
}
"""Of its own method. Its bronchus is a phantom's centreline that was not published; ours is another one."""

BASELINE = {
    "cos": (1.84, 1.58, 1.63),
    "arc": (1.81, 1.78, 1.34),
    "line": (7.58, 5.77, 1.31),
    "line_arc": (2.84, 2.36, 1.39),
    "synthesis": (3.28, 2.94, 1.43),
    "bronchus": (2.71, 2.53, 1.67),
}
"""Of its Euclidean baseline."""
