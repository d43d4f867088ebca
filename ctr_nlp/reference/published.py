"""What the seed printed."""

TABLE_II = {
    "cos": {"e3": 1.81, "e4": 1.67, "t_c": 0.25, "baseline_e3": 1.84, "baseline_e4": 1.58, "baseline_t_c": 1.63},
    "arc": {"e3": 1.62, "e4": 1.36, "t_c": 0.10, "baseline_e3": 1.81, "baseline_e4": 1.78, "baseline_t_c": 1.34},
    "line": {"e3": 7.46, "e4": 4.84, "t_c": 0.10, "baseline_e3": 7.58, "baseline_e4": 5.77, "baseline_t_c": 1.31},
    "line_arc": {
        "e3": 2.67,
        "e4": 1.88,
        "t_c": 0.13,
        "baseline_e3": 2.84,
        "baseline_e4": 2.36,
        "baseline_t_c": 1.39,
    },
    "synthesis": {
        "e3": 0.98,
        "e4": 0.46,
        "t_c": 0.14,
        "baseline_e3": 3.28,
        "baseline_e4": 2.94,
        "baseline_t_c": 1.43,
    },
    "bronchus": {
        "e3": 2.02,
        "e4": 1.93,
        "t_c": 0.26,
        "baseline_e3": 2.71,
        "baseline_e4": 2.53,
        "baseline_t_c": 1.67,
    },
}
"""Table II, stiffness model: e3, e4 in mm and t_c in s of the seed's method and of its Euclidean baseline.

Its bronchus is a phantom's centreline that was not published; ours of that name is another one.
"""
