/* Shapes of the elastic model; lanes.c, branch.c and margin.c come before this file. */

/* Points (rows, samples, 3) at sigma, mm, and the tips' directions (rows, 3), of up to LANES robots; steps in numbers and
   sigma from row to row. */
static void shapes_beside(const Elastic *e, const double *numbers, long step, const double *x, long rows,
                          const double *sigma, long samples, long sigma_step, double *points, double *tips) {
    long d = TUBES(e), n = 2 * d + 2;
    double own[LANES * MOST_TUBES * NUMBERS], at[LANES * SIDE], found[3 * LANES], s[LANES], ends[3 * LANES];
    RESERVE(vectors, 3 * VECTORS(e));
    fill_lanes(numbers, step, d * NUMBERS, rows, own);
    fill_lanes(x, n, n, rows, at);
    const double *whole[] = {at, own};
    double *res[] = {(double *)vectors, ends}, *one[] = {found};
    CALL(e, shape)(whole, res, 0, 0, 0);
    memcpy(tips, ends, 3 * rows * sizeof *tips);
    for (long l = 0; l < rows; ++l, sigma += sigma_step, points += 3 * samples) {
        const double *arg[] = {s, (const double *)vectors + 3 * VECTORS(e) * l, at + n * l + d, own + d * NUMBERS * l};
        for (long first = 0; first < samples; first += LANES) {
            long here = samples - first < LANES ? samples - first : LANES;
            for (long k = 0; k < LANES; ++k) s[k] = sigma[first + (k < here ? k : 0)] * at[n * l + 2 * d - 1];
            *one = here == LANES ? points + 3 * first : found;
            CALL(e, points)(arg, one, 0, 0, 0);
            if (here < LANES) memcpy(points + 3 * first, found, 3 * here * sizeof *found);
        }
    }
    RELEASE(vectors);
}

/* Points (rows, samples, 3) and tips (rows, 3) at every x, with steps in numbers and sigma from row to row. */
void shapes(const Elastic *e, const double *numbers, long step, const double *x, long rows, const double *sigma,
            long samples, long sigma_step, double *points, double *tips) {
    for (long first = 0; first < rows; first += LANES) {
        long here = rows - first < LANES ? rows - first : LANES;
        shapes_beside(e, numbers + step * first, step, x + (2 * TUBES(e) + 2) * first, here,
                      sigma + sigma_step * first, samples, sigma_step, points + 3 * samples * first,
                      tips + 3 * first);
    }
}
