/* Falls of the elastic model: where its branch ends, a robot goes down the gradient of its energy into another
   equilibrium; branch.c, margin.c and energy.c come before this file. */

enum { MOST_STEPS = 2000, MOST_FALLS = 20, PLACES = 11 };

/* Whether a symmetric matrix less `shift` on its diagonal has positive pivots only; a: its rows from the diagonal on,
   eliminated. */
static int definite(const double *matrix, long n, double shift, double *a) {
    memcpy(a, matrix, n * n * sizeof *a);
    for (long i = 0; i < n; ++i) a[n * i + i] -= shift;
    for (long k = 0; k < n; ++k) {
        const double *pivot = a + n * k;
        if (!(pivot[k] > 0)) return 0;
        double inverse = 1 / pivot[k];
        for (long i = k + 1; i < n; ++i) added(-pivot[i] * inverse, pivot + i - i % 4, n - i + i % 4, a + n * i + i - i % 4);
    }
    return 1;
}

/* Solve for v in place, with what `definite` leaves of a matrix. */
static void solved_by(const double *a, long n, double *v) {
    for (long k = 0; k < n; ++k) added(-v[k] / a[n * k + k], a + n * k + k + 1, n - k - 1, v + k + 1);
    for (long k = n - 1; k >= 0; --k)
        v[k] = (v[k] - product(a + n * k + k + 1, v + k + 1, n - k - 1)) / a[n * k + k];
}

/* The unit vector of the smallest eigenvalue, by inverse iterations. */
static void softest(const Energy *of, double *l, double *v) {
    long n = of->n;
    for (long i = 0; i < n; ++i)
        for (long j = 0; j < n; ++j) l[n * i + j] = of->matrix[i < j ? n * i + j : n * j + i];
    double least = smallest_eigenvalue(l, n), shift = 1e-3 * (1 + fabs(least));
    while (!definite(of->matrix, n, least - shift, l)) shift *= 2;
    for (long i = 0; i < n; ++i) v[i] = 0.2 + fmod(0.618033988749895 * (i + 1), 1.0);
    for (long k = 0; k < 10; ++k) {
        solved_by(l, n, v);
        double size = sqrt(product(v, v, n));
        for (long i = 0; i < n; ++i) v[i] /= size;
    }
}

/* One step down the gradient from twists a, for about the time given, by Rosenbrock's method of second order that is
   L-stable (ROS2; Verwer, Spee, Blom, Hundsdorfer, SIAM J. Sci. Comput. 20, 1999): at most `fall` rad, and never
   uphill. The rad that it turned tubes by against each other. */
static double step_down(const Elastic *e, Energy *of, const double *motors, double *a, double *time) {
    const double gamma = 1 - sqrt(0.5);
    long n = of->n;
    double *l = of->work, *slope = l + n * n, *first = slope + n, *second = first + n, *ahead = second + n;
    double *angles = ahead + n, *there = angles + of->rows, *turn = there + of->rows, size = 0;
    turned(of, a, angles);
    added(1, motors, of->rows, angles);
    double height = energy_at(of, a, angles, slope);
    bent(of);
    for (; *time > 1e-12; *time *= size > e->fall ? fmax(0.1, 0.8 * e->fall / size) : 0.5) {
        double scale = 1 / (gamma * *time);
        size = 0;
        if (!definite(of->matrix, n, -scale, l)) continue;
        for (long i = 0; i < n; ++i) first[i] = -scale * slope[i];
        solved_by(l, n, first);
        turned(of, first, turn);
        for (long i = 0; i < n; ++i) ahead[i] = a[i] + *time * first[i];
        for (long r = 0; r < of->rows; ++r) there[r] = angles[r] + *time * turn[r];
        energy_at(of, ahead, there, second);
        for (long i = 0; i < n; ++i) second[i] = scale * (-second[i] - 2 * first[i]);
        solved_by(l, n, second);
        for (long i = 0; i < n; ++i) first[i] = *time * (1.5 * first[i] + 0.5 * second[i]), ahead[i] = a[i] + first[i];
        turned(of, first, turn);
        size = largest(turn, of->rows);
        for (long r = 0; r < of->rows; ++r) there[r] = angles[r] + turn[r];
        if (size <= e->fall && (size < 1e-6 || energy_at(of, ahead, there, second) < height)) break;
    }
    memcpy(a, ahead, n * sizeof *a);
    return size;
}

/* The least energy that a robot comes to from the angles of an equilibrium, as twists a, with a push towards where
   they last changed to; whether it comes there. */
static int fall(const Elastic *e, Energy *of, const double *motors, const double *angles, const double *towards,
                double *a) {
    long n = of->n;
    double *v = of->work, *there = v + n, *l = there + of->rows, time = 8;
    for (long i = 0; i < n; ++i) v[i] = 0;
    energy_at(of, v, angles, a);
    for (long i = 0; i < n; ++i) a[i] = -a[i];
    bent(of);
    softest(of, l, v);
    turned(of, v, there);
    added(copysign(e->push / largest(there, of->rows), product(there, towards, of->rows)), v, n, a);
    for (long k = 0; k < MOST_STEPS; ++k) {
        double size = step_down(e, of, motors, a, &time);
        if (size < e->converged && time > 40) return 1;
        time *= size > 0.1 * e->fall ? 0.8 * e->fall / size : 8;
    }
    return 0;
}

/* About the equilibrium at `past` that a robot falls into from one nearby: x; whether there is one. */
static int settling(const Elastic *e, const double *numbers, const State *from, const double *past, Energy *of,
                    double *x) {
    long d = e->d, side = 2 * d + 2;
    double ahead[SIDE], tips[MOST_TUBES], most = 0, turn = 0, *here = of->angles;
    double towards[e->rows + 1], motors[e->rows + 1], angles[e->rows + 1], a[e->against + 1];
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
        motors[r] = past[e->first[r]] - past[e->other[r]] + of->made[r];
    }
    if (of->n == 0 || !fall(e, of, motors, angles, towards, a)) return 0;
    for (long i = 0; i < d; ++i) tips[i] = past[i] + of->made[e->rows + i] + product(of->ends + of->n * i, a, of->n);
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
    free(of.strengths);
    return found;
}

/* Fall from where a branch ended on the way to goal, and go on, wherever one ends; whether goal is reached. jumps
   (MOST_FALLS, d): what every fall turned the tips by, as many as there were. */
static int beyond(const Elastic *e, const double *numbers, State *state, const double *goal, double *jumps,
                  long *falls) {
    long d = e->d;
    int there = 0;
    for (*falls = 0; !there; there = along(e, numbers, state, goal, 1)) {
        const State from = *state;
        if (*falls == MOST_FALLS || !fallen(e, numbers, state, goal)) return 0;
        double *jump = jumps + d * (*falls)++, whole = state->x[d - 1] - from.x[d - 1];
        for (long i = 0; i < d; ++i) jump[i] = i == d - 1 ? whole : state->x[i] - from.x[i] + whole;
    }
    return 1;
}

/* Follow a branch towards goal, and fall into another wherever it ends; whether goal is reached. */
int follow(const Elastic *e, const double *numbers, State *state, const double *goal, double *jumps, long *falls) {
    *falls = 0;
    return along(e, numbers, state, goal, 1) || beyond(e, numbers, state, goal, jumps, falls);
}
