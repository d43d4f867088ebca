/* Shapes of the elastic model; the other files come before this one. */

enum { CHUNK = 256 };

/* Points (samples, 3) at sigma (samples,), mm, and the tip's direction (3,). */
static void shape_at(const Elastic *e, const double *numbers, const double *x, const double *sigma, long samples,
                     double *points, double *tip) {
    double vectors[3 * e->vectors], s[LANES], found[3 * LANES];
    const double *at[] = {x, numbers}, *arg[] = {s, vectors, x + e->d, numbers};
    double *whole[] = {vectors, tip}, *res[] = {found};
    e->shape(at, whole, 0, 0, 0);
    for (long first = 0; first < samples; first += LANES) {
        long here = samples - first < LANES ? samples - first : LANES;
        for (long l = 0; l < LANES; ++l) s[l] = sigma[first + (l < here ? l : 0)] * x[2 * e->d - 1];
        e->points(arg, res, 0, 0, 0);
        memcpy(points + 3 * first, found, 3 * here * sizeof *found);
    }
}

/* The same at every x, with steps in numbers and sigma from row to row. */
void shapes(const Elastic *e, const double *numbers, long step, const double *x, long rows, const double *sigma,
            long samples, long sigma_step, double *points, double *tips) {
    for (long row = 0; row < rows; ++row, x += 2 * e->d + 2, numbers += step, sigma += sigma_step)
        shape_at(e, numbers, x, sigma, samples, points + 3 * samples * row, tips + 3 * row);
}

/* Robots at rest at every q without a history: x, the tip's direction, the margin and points, row by row; NaN where no
   equilibrium is found. */
void rests(const Elastic *e, const double *numbers, const double *q, long rows, const double *sigma, long samples,
           double *to) {
    long n = 2 * e->d + 2, found[CHUNK], most = rows < CHUNK ? rows : CHUNK;
    State *states = malloc(most * sizeof *states);
    for (long first = 0; first < rows; first += most) {
        long here = rows - first < most ? rows - first : most;
        settle(e, numbers, 0, q + n * first, here, states, found);
        for (long row = 0; row < here; ++row, to += n + 4 + 3 * samples) {
            for (long i = 0; i < n; ++i) to[i] = found[row] ? states[row].x[i] : NAN;
            shape_at(e, numbers, to, sigma, samples, to + n + 4, to + n);
            to[n + 3] = margin_at(e, numbers, to);
        }
    }
    free(states);
}
