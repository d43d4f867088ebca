"""The paper's Table II as printed: (e3 in mm, e4 in mm, time a frame in s) by problem.

e3 is the root mean square over frames of e2, the error of a frame, and e4 the median (section IV).
"""

TABLE_II_PAPER_METHOD = {
    "cos": (1.81, 1.67, 0.25),
    "arc": (1.62, 1.36, 0.10),
    "line": (7.46, 4.84, 0.10),
    "line_arc": (2.67, 1.88, 0.13),
    "synthesis": (0.98, 0.46, 0.14),
    "bronchus": (2.02, 1.93, 0.26),
}
"""Figures of the paper's own method. Its bronchus is a phantom's centreline that was not published; ours is
another one.
"""

TABLE_II_BASELINE = {
    "cos": (1.84, 1.58, 1.63),
    "arc": (1.81, 1.78, 1.34),
    "line": (7.58, 5.77, 1.31),
    "line_arc": (2.84, 2.36, 1.39),
    "synthesis": (3.28, 2.94, 1.43),
    "bronchus": (2.71, 2.53, 1.67),
}
"""Figures of its Euclidean baseline."""

TABLE_II_PAPER_METHOD_ELASTIC = {
    "cos": (8.17, 6.43),
    "arc": (9.36, 7.51),
    "line": (9.91, 8.02),
    "line_arc": (7.18, 5.31),
    "synthesis": (4.96, 2.90),
    "bronchus": (8.75, 7.17),
}
"""Figures of the motions of `TABLE_II_PAPER_METHOD` on the torsionally compliant model, as (e3 in mm, e4 in mm).
"""

TABLE_II_BASELINE_ELASTIC = {
    "cos": (9.92, 7.85),
    "arc": (10.46, 6.72),
    "line": (11.19, 8.89),
    "line_arc": (10.40, 6.98),
    "synthesis": (7.35, 4.46),
    "bronchus": (9.31, 6.79),
}
"""Figures of the motions of `TABLE_II_BASELINE` on the torsionally compliant model, as (e3 in mm, e4 in mm)."""
