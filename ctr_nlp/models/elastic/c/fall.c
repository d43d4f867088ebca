/* Falls of the elastic model: where its branch ends, a robot goes down the gradient of its energy into another
   equilibrium; branch.c, margin.c and energy.c come before this file. */

enum { MOST_STEPS = 2000, MOST_FALLS = 20, PLACES = 11 };

/* What rows are turned by, by the twists a. */
static void turned(const Elastic *e, const Energy *of, const double *a, double *angles) {
    for (long r = 0; r < e->rows; ++r) {
        angles[r] = 0;
        for (long k = of->begins[r]; k < of->begins[r + 1]; ++k) angles[r] += of->turns[k] * a[of->columns[k]];
    }
}

/* The energy at twists a and its gradient; motors: angles between the tubes' motors. angles: what they are at a. */
static double energy_at(const Elastic *e, const Energy *of, const double *motors, const double *a, double *angles,
                        double *gradient) {
    double found = product(a, a, of->n) / 2;
    turned(e, of, a, angles);
    memcpy(gradient, a, of->n * sizeof *a);
    for (long r = 0; r < e->rows; ++r) {
        if (of->begins[r] == of->begins[r + 1]) continue;
        double pull = of->strengths[r] * sin(angles[r] += motors[r]);
        found -= of->strengths[r] * cos(angles[r]);
        for (long k = of->begins[r]; k < of->begins[r + 1]; ++k) gradient[of->columns[k]] += pull * of->turns[k];
    }
    return found;
}

/* Cholesky's factor of I + factor times a symmetric matrix, in the lower triangle; whether there is one. */
static int factored(const double *matrix, long n, double factor, double *l) {
    for (long j = 0; j < n; ++j) {
        for (long i = j; i < n; ++i) l[i + n * j] = factor * matrix[i + n * j];
        l[j + n * j] += 1;
    }
    for (long k = 0; k < n; ++k) {
        if (!(l[k + n * k] > 0)) return 0;
        double root = sqrt(l[k + n * k]);
        for (long i = k; i < n; ++i) l[i + n * k] /= root;
        for (long j = k + 1; j < n; ++j)
            for (long i = j; i < n; ++i) l[i + n * j] -= l[j + n * k] * l[i + n * k];
    }
    return 1;
}

static void solved_by(const double *l, long n, double *b) {
    for (long k = 0; k < n; ++k) {
        b[k] /= l[k + n * k];
        for (long i = k + 1; i < n; ++i) b[i] -= l[i + n * k] * b[k];
    }
    for (long k = n - 1; k >= 0; --k) b[k] = (b[k] - product(l + k + 1 + n * k, b + k + 1, n - k - 1)) / l[k + n * k];
}

/* Whether a symmetric matrix less `shift` on its diagonal has positive pivots only; a: its rows from the diagonal on,
   eliminated. */
static int definite(const double *matrix, long n, double shift, double *restrict a) {
    for (long i = 0; i < n; ++i) {
        for (long j = i; j < n; ++j) a[n * i + j] = matrix[n * i + j];
        a[n * i + i] -= shift;
    }
    for (long k = 0; k < n; ++k) {
        const double *pivot = a + n * k;
        if (!(pivot[k] > 0)) return 0;
        double inverse = 1 / pivot[k];
        for (long i = k + 1; i < n; ++i) {
            double part = pivot[i] * inverse, *restrict row = a + n * i;
#pragma omp simd
            for (long j = i; j < n; ++j) row[j] -= part * pivot[j];
        }
    }
    return 1;
}

/* Solve for v in place, with what `definite` leaves of a matrix, and make its length one. */
static void inverted(const double *a, long n, double *v) {
    double size = 0;
    for (long k = 0; k < n; ++k) {
        double part = v[k] / a[n * k + k];
        for (long i = k + 1; i < n; ++i) v[i] -= part * a[n * k + i];
    }
    for (long k = n - 1; k >= 0; --k) {
        for (long i = k + 1; i < n; ++i) v[k] -= a[n * k + i] * v[i];
        v[k] /= a[n * k + k], size += v[k] * v[k];
    }
    for (long i = 0; i < n; ++i) v[i] /= sqrt(size);
}

/* The unit vector of the smallest eigenvalue, by inverse iterations. */
static void softest(const Energy *of, double *l, double *v) {
    long n = of->n;
    memcpy(l, of->matrix, n * n * sizeof *l);
    double least = smallest_eigenvalue(l, n), shift = 1e-3 * (1 + fabs(least));
    while (!definite(of->matrix, n, least - shift, l)) shift *= 2;
    for (long i = 0; i < n; ++i) v[i] = 0.2 + fmod(0.618033988749895 * (i + 1), 1.0);
    for (long k = 0; k < 30; ++k) inverted(l, n, v);
}

/* One step down the gradient from twists a, for about the time given, by Rosenbrock's method of second order that is
   L-stable (ROS2; Verwer, Spee, Blom, Hundsdorfer, SIAM J. Sci. Comput. 20, 1999): at most `fall` rad, and never
   uphill. The rad that it turned tubes by against each other. */
static double step_down(const Elastic *e, const Energy *of, const double *motors, double *a, double *time) {
    const double gamma = 1 - sqrt(0.5);
    long n = of->n;
    double *l = of->work, *slope = l + n * n, *first = slope + n, *second = first + n, *ahead = second + n;
    double *angles = ahead + n, *there = angles + e->rows, size = 0;
    double height = energy_at(e, of, motors, a, angles, slope);
    bent(e, of, angles);
    for (; *time > 1e-12; *time *= size > e->fall ? fmax(0.1, 0.8 * e->fall / size) : 0.5) {
        size = 0;
        if (!factored(of->matrix, n, gamma * *time, l)) continue;
        for (long i = 0; i < n; ++i) first[i] = -slope[i];
        solved_by(l, n, first);
        for (long i = 0; i < n; ++i) ahead[i] = a[i] + *time * first[i];
        energy_at(e, of, motors, ahead, there, second);
        for (long i = 0; i < n; ++i) second[i] = -second[i] - 2 * first[i];
        solved_by(l, n, second);
        for (long i = 0; i < n; ++i) first[i] = *time * (1.5 * first[i] + 0.5 * second[i]), ahead[i] = a[i] + first[i];
        turned(e, of, first, there);
        size = largest(there, e->rows);
        if (size <= e->fall && (size < 1e-6 || energy_at(e, of, motors, ahead, there, second) < height)) break;
    }
    memcpy(a, ahead, n * sizeof *a);
    return size;
}

/* The least energy that a robot comes to from the angles of an equilibrium, as twists a, with a push towards where
   they last changed to; whether it comes there. */
static int fall(const Elastic *e, const Energy *of, const double *motors, const double *angles, const double *towards,
                double *a) {
    long n = of->n;
    double *v = of->work, *there = v + n, *l = there + e->rows, along = 0, time = 8;
    memset(a, 0, n * sizeof *a);
    for (long r = 0; r < e->rows; ++r) {
        double pull = of->strengths[r] * sin(angles[r]);
        for (long k = of->begins[r]; k < of->begins[r + 1]; ++k) a[of->columns[k]] -= pull * of->turns[k];
    }
    bent(e, of, angles);
    softest(of, l, v);
    turned(e, of, v, there);
    for (long r = 0; r < e->rows; ++r) along += there[r] * towards[r];
    for (long i = 0; i < n; ++i) a[i] += v[i] * copysign(e->push / largest(there, e->rows), along);
    for (long k = 0; k < MOST_STEPS; ++k) {
        double size = step_down(e, of, motors, a, &time);
        if (size < e->converged && time > 40) return 1;
        time *= size > 0.125 * e->fall ? e->fall / size : 8;
    }
    return 0;
}

/* About the equilibrium at `past` that a robot falls into from one nearby: x; whether there is one. */
static int settling(const Elastic *e, const double *numbers, const State *from, const double *past, Energy *of,
                    double *x) {
    long d = e->d, side = 2 * d + 2;
    double ahead[SIDE], tips[MOST_TUBES], most = 0, turn = 0, *here = of->angles;
    double *towards = of->rows, *motors = towards + e->rows, *angles = motors + e->rows, *a = angles + e->rows;
    predicted(e, numbers, from, past, ahead);
    for (long i = 0; i < side; ++i) {
        ahead[i] -= from->x[i], most = fmax(most, fabs(ahead[i]));
        if (i < d) turn = fmax(turn, fabs(ahead[i]));
    }
    double step = fmin(1e-4 / fmax(turn, 1e-300), 1e-2 / fmax(most, 1e-300));
    for (long i = 0; i < side; ++i) ahead[i] = from->x[i] + step * ahead[i];
    described(e, numbers, ahead, of);
    memcpy(towards, here, e->rows * sizeof *here);
    described(e, numbers, from->x, of);
    memcpy(angles, here, e->rows * sizeof *here);
    described(e, numbers, past, of);
    for (long r = 0; r < e->rows; ++r) {
        towards[r] -= angles[r];
        motors[r] = past[e->first[r]] - past[e->other[r]];
    }
    if (of->n == 0 || !fall(e, of, motors, angles, towards, a)) return 0;
    memcpy(tips, past, d * sizeof *tips);
    for (long i = 0; i < e->twists; ++i)
        if (of->places[i] >= 0 && e->ends[i] >= 0) tips[e->ends[i]] += of->scales[i] * a[of->places[i]];
    memcpy(x, past, side * sizeof *x);
    for (long i = 0; i < d; ++i) x[i] = tips[i] - (i < d - 1 ? tips[d - 1] : 0);
    return 1;
}

/* Fall from where a branch ends on the way to goal into a stable equilibrium just past it; whether there is one. */
static int fallen(const Elastic *e, const double *numbers, State *state, const double *goal) {
    long d = e->d, side = 2 * d + 2;
    int found = 0;
    Energy of = energy_for(e);
    for (long k = 0; k < PLACES && !found; ++k) {
        double past[SIDE], x[SIDE], part = pow(e->smallest, 1 - k / (PLACES - 1.0));
        State to;
        for (long i = 0; i < side; ++i)
            past[i] = k == PLACES - 1 ? goal[i] : state->q[i] + part * (goal[i] - state->q[i]);
        if (!settling(e, numbers, state, past, &of, x)) continue;
        memcpy(to.x, x, side * sizeof *x);
        to.stable = 1;
        if (!newton(e, numbers, past, &to, e->converged)) continue;
        for (long i = 0; i < side; ++i) x[i] -= to.x[i];
        found = largest(x, side) < e->stray && margin_at(e, numbers, to.x) > 0;
        if (found) *state = to;
    }
    free(of.room);
    return found;
}

/* Follow a branch towards goal, and fall into another wherever it ends; whether goal is reached. jumps (MOST_FALLS, d):
   what every fall turned the tips by, as many as there were. */
static int onwards(const Elastic *e, const double *numbers, State *state, const double *goal, double most, double *jumps,
                   long *falls) {
    long d = e->d;
    int there = along(e, numbers, state, goal, most);
    for (*falls = 0; !there; there = along(e, numbers, state, goal, 1)) {
        const State from = *state;
        if (*falls == MOST_FALLS || !fallen(e, numbers, state, goal)) return 0;
        double *jump = jumps + d * (*falls)++, whole = state->x[d - 1] - from.x[d - 1];
        for (long i = 0; i < d; ++i) jump[i] = i == d - 1 ? whole : state->x[i] - from.x[i] + whole;
    }
    return 1;
}

/* The same for callers. */
int follow(const Elastic *e, const double *numbers, State *state, const double *goal, double *jumps, long *falls) {
    return onwards(e, numbers, state, goal, 1, jumps, falls);
}

/* Turn all tubes from alpha_d to where they are at every q, with steps in numbers from row to row; the
   states there, and whether each was found. */
void settle(const Elastic *e, const double *numbers, long step, const double *q, long rows, State *states, long *found) {
    long d = e->d, n = 2 * d + 2, falls;
    double jumps[MOST_FALLS * MOST_TUBES];
    for (long row = 0; row < rows; ++row, q += n, numbers += step, ++states) {
        double aligned[SIDE], most = 0;
        memcpy(aligned, q, n * sizeof *q);
        memset(states, 0, sizeof *states);
        for (long i = 0; i < d; ++i) aligned[i] = q[d - 1], most = fmax(most, fabs(q[i] - q[d - 1]));
        states->x[d - 1] = q[d - 1], states->stable = 1;
        found[row] = newton(e, numbers, aligned, states, e->converged) &&
                     onwards(e, numbers, states, q, e->stride / most, jumps, &falls);
    }
}
