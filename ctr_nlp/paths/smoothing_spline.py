"""Natural cubic smoothing splines near noisy points, smoothed as generalised cross-validation chooses.

For points y at knots t_0 < ... < t_{n-1}, h_i = t_{i+1} - t_i, the spline that minimises
|y - f(t)|^2 + lambda int |f''|^2 has the values f = y - lambda Q g, where (R + lambda Q^T Q) g = Q^T y and g are
its second derivatives at the inner knots; Q (n, n - 2) takes second divided differences, R (n - 2, n - 2) is the
Gram matrix of the hat functions (Green and Silverman, Nonparametric Regression and Generalized Linear Models,
1994, section 2.3). Generalised cross-validation minimises |y - f|^2 / tr(I - A)^2 over lambda, A the map from y
to f (Woltring, Advances in Engineering Software 8(2), 1986). All coordinates share one lambda, so that the result
does not depend on the axes.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg import solveh_banded
from scipy.optimize import minimize_scalar

from ctr_nlp.typing import Array

LOG_LAMBDA_RANGE = (-9.0, 4.0)
"""Powers of ten of lambda, mm^3, among which the least score is looked for."""
LOG_LAMBDA_TOLERANCE = 0.2


def smooth_values(knots: Array, points: Array) -> Array:
    """Return the points (n, k) of the smoothing spline at its knots.

    knots: (n,), growing, n of at least 5. points: (n, k), those it is near to. Raises LinAlgError where the
    equations cannot be solved.
    """
    width = np.diff(knots)
    inner = len(knots) - 2
    differences = sparse.dia_array(
        (
            np.array(
                [
                    np.pad(1 / width[:-1], (0, 2)),
                    np.pad(-1 / width[:-1] - 1 / width[1:], (0, 2)),
                    np.pad(1 / width[1:], (0, 2)),
                ]
            ),
            (0, -1, -2),
        ),
        shape=(inner + 2, inner),
    ).tocsr()
    stiffness = (differences.T @ differences).toarray()
    # Upper bands, as solveh_banded stores them: the diagonal is row 2.
    stiff = np.zeros((3, inner))
    gram = np.zeros((3, inner))
    for k in range(3):
        stiff[2 - k, k:] = np.diagonal(stiffness, k)
    gram[2] = (width[:-1] + width[1:]) / 3
    gram[1, 1:] = width[1:-1] / 6
    bends = differences.T @ points
    together = np.hstack([bends, stiffness])
    columns = bends.shape[1]

    def score(log_lambda: float) -> float:
        scale = 10.0**log_lambda
        solved = solveh_banded(gram + scale * stiff, together, check_finite=False)
        # |y - f|^2 = |lambda Q g|^2, and tr(I - A) = lambda tr((R + lambda Q^T Q)^-1 Q^T Q); lambda cancels.
        moved = differences @ solved[:, :columns]
        return float((moved**2).sum() / np.trace(solved[:, columns:]) ** 2)

    found = minimize_scalar(
        score, bounds=LOG_LAMBDA_RANGE, method="bounded", options={"xatol": LOG_LAMBDA_TOLERANCE}
    )
    best = 10.0**found.x
    return np.asarray(points - best * (differences @ solveh_banded(gram + best * stiff, bends)))
