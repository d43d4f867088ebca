/* One robot a thread, as on graphics cards; the other files come before this one. EACH_ROBOT: the number of this thread. */

KERNEL void rest_of_each(const Elastic e, const double *numbers, long step, const double *q, long rows,
                         const double *sigma, long samples, double *x, double *tips, double *margin, double *points) {
    long n = 2 * TUBES(&e) + 2;
    EACH_ROBOT(row, rows)
    rests(&e, numbers + step * row, step, q + n * row, 1, sigma, samples, x + n * row, tips + 3 * row, margin + row,
          points + 3 * samples * row);
}

/* Each robot's own motion through goals (places, ..) in one batch (rows, places, ..), from rest at the first: x (rows,
   places, ..), NaN from where it is lost; fell (rows,): how often it fell into another equilibrium on the way. */
KERNEL void motion_of_each(const Elastic e, const double *numbers, long step, const double *goals, long rows,
                           long places, double *x, long *fell) {
    long n = 2 * TUBES(&e) + 2;
    EACH_ROBOT(row, rows) {
        const double *own = numbers + step * row, *at = goals + n * places * row;
        double *to = x + n * places * row, jumps[MOST_FALLS * MOST_TUBES];
        long falls, found;
        State state;
        settle(&e, own, 0, at, 1, &state, &found);
        fell[row] = 0;
        for (long k = 0; k < places; ++k) {
            if (found && k) found = follow(&e, own, &state, at + n * k, jumps, &falls), fell[row] += falls;
            for (long i = 0; i < n; ++i) to[n * k + i] = found ? state.x[i] : NAN;
        }
    }
}
