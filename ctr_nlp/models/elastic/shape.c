/* Shapes of the elastic model: sums of vectors, each times how far a robot travels along it; branch.c, margin.c
   and fall.c come before this file. */

enum { LANES = 8, NUMBERS = 6 };

/* Points (samples, 3) at sigma (samples,), mm, and the tip's direction (3,). */
static void shape_at(const Elastic *e, const double *numbers, const double *x, const double *sigma, long samples,
                     double *points, double *tip) {
    long d = e->d, n = e->vectors, count = d * NUMBERS;
    double vectors[3 * n], s[LANES], beta[LANES * d], known[LANES * count], travels[LANES * n];
    const double *at[] = {x, numbers}, *arg[] = {s, beta, known};
    double *res[] = {vectors, tip}, *found[] = {travels};
    e->shape(at, res, 0, 0, 0);
    for (long l = 0; l < LANES; ++l) {
        memcpy(beta + l * d, x + d, d * sizeof *x);
        memcpy(known + l * count, numbers, count * sizeof *x);
    }
    for (long first = 0; first < samples; first += LANES) {
        long here = samples - first < LANES ? samples - first : LANES;
        double sums[3][LANES] = {{0}};
        for (long l = 0; l < LANES; ++l) s[l] = sigma[first + (l < here ? l : here - 1)] * x[2 * d - 1];
        e->travels(arg, found, 0, 0, 0);
        for (long k = 0; k < n; ++k)
            for (long i = 0; i < 3; ++i)
#pragma omp simd
                for (long l = 0; l < LANES; ++l) sums[i][l] += vectors[3 * k + i] * travels[l * n + k];
        for (long l = 0; l < here; ++l)
            for (long i = 0; i < 3; ++i) points[3 * (first + l) + i] = sums[i][l];
    }
}

/* The same at every x, with steps in numbers and sigma from row to row. */
void shapes(const Elastic *e, const double *numbers, long step, const double *x, long rows, const double *sigma,
            long samples, long sigma_step, double *points, double *tips) {
    for (long row = 0; row < rows; ++row, x += 2 * e->d + 2, numbers += step, sigma += sigma_step)
        shape_at(e, numbers, x, sigma, samples, points + 3 * samples * row, tips + 3 * row);
}

/* Robots at rest at every q without a history: x, points, directions of tips, margins; NaN where none is found. */
void rests(const Elastic *e, const double *numbers, const double *q, long rows, const double *sigma, long samples,
           double *x, double *points, double *tips, double *margins) {
    long n = 2 * e->d + 2, found;
    State state;
    for (long row = 0; row < rows; ++row, x += n) {
        settle(e, numbers, 0, q + n * row, 1, &state, &found);
        for (long i = 0; i < n; ++i) x[i] = found ? state.x[i] : NAN;
        margins[row] = margin_at(e, numbers, x);
        shape_at(e, numbers, x, sigma, samples, points + 3 * samples * row, tips + 3 * row);
    }
}
