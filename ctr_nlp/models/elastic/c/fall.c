/* Falls of the elastic model: where its branch ends, a robot goes down the gradient of its energy into another
   equilibrium, LANES robots at once; branch.c, margin.c and energy.c come before this file. */

enum { MOST_STEPS = 2000, MOST_TRIALS = 8000, MOST_FALLS = 20, PLACES = 11 };

/* Whether symmetric matrices plus `shift` on their diagonals have positive pivots only; a: their rows from the diagonal
   on, eliminated, with the inverses of pivots in place of these. */
APART M definite(const V *matrix, long n, V shift, V *a) {
    M found = every(1);
    memcpy(a, matrix, n * n * sizeof *a);
    for (long i = 0; i < n; ++i) a[n * i + i] += shift;
    for (long k = 0; k < n; ++k) {
        V *pivot = a + n * k;
        found &= pivot[k] > 0;
        pivot[k] = 1 / pivot[k];
        for (long i = k + 1; i < n; ++i) added(-pivot[i] * pivot[k], pivot + i, n - i, a + n * i + i);
    }
    return found;
}

/* Solve for v in place, with what `definite` leaves of matrices. */
APART void solved_by(const V *a, long n, V *v) {
    for (long k = 0; k < n; ++k) added(-v[k] * a[n * k + k], a + n * k + k + 1, n - k - 1, v + k + 1);
    for (long k = n - 1; k >= 0; --k)
        v[k] = (v[k] - product(a + n * k + k + 1, v + k + 1, n - k - 1)) * a[n * k + k];
}

/* The unit vectors of the smallest eigenvalues, by inverse iterations. l: room for n (n + 4). */
static void softest(const Energy *of, V *l, V *v) {
    long n = of->n;
    for (long i = 0; i < n; ++i)
        for (long j = 0; j < n; ++j) l[n * i + j] = of->matrix[i < j ? n * i + j : n * j + i];
    V least = smallest_eigenvalues(l, n, l + n * n), shift = 1e-3 * (1 + size_of_each(least));
    M good = every(0);
    for (long k = 0; k < 60 && some(unless(good)); ++k) {
        shift = choose(good, shift, k ? 2 * shift : shift);
        good = definite(of->matrix, n, shift - least, l);
    }
    for (long i = 0; i < n; ++i) v[i] = all(0.2 + fmod(0.618033988749895 * (i + 1), 1.0));
    for (long k = 0; k < 10; ++k) {
        solved_by(l, n, v);
        V size = by_lane_sqrt(product(v, v, n));
        for (long i = 0; i < n; ++i) v[i] /= size;
    }
}

/* The least energies that robots come to from the angles of equilibria, as twists a, with a push towards where they
   last changed to; which of them come there. By Rosenbrock's method of second order that is L-stable (ROS2; Verwer,
   Spee, Blom, Hundsdorfer, SIAM J. Sci. Comput. 20, 1999), down the gradient in steps of at most `fall` rad, and never
   uphill. falling: which of them are asked for. */
APART M fall(const Elastic *e, Energy *of, const V *motors, const V *from, const V *towards, M falling, V *a) {
    const double gamma = 1 - sqrt(0.5);
    long n = of->n, rows = of->rows;
    V *l = of->work, *slope = l + n * n, *first = slope + n, *second = first + n, *ahead = second + n;
    V *angles = ahead + n, *there = angles + rows, *turn = there + rows, time = all(8), height = all(0);
    M moved = falling, done = every(0);
    V steps = all(0);
    memset(first, 0, n * sizeof *first);
    energy_at(e, of, first, from, a);
    for (long i = 0; i < n; ++i) a[i] = -a[i];
    bent(e, of);
    /* l and what follows it are free until the first step. */
    softest(of, l, turn + rows);
    V *v = turn + rows;
    turned(e, of, v, there);
    V side = product(there, towards, rows), push = e->push / largest_of(there, rows);
    added(choose(side < 0, -push, push), v, n, a);
    for (long k = 0; k < MOST_TRIALS && some(falling); ++k) {
        if (some(moved)) {
            turned(e, of, a, angles);
            added(all(1), motors, rows, angles);
            height = energy_at(e, of, a, angles, slope);
            bent(e, of);
        }
        V scale = 1 / (gamma * time);
        M good = definite(of->matrix, n, scale, l);
        for (long i = 0; i < n; ++i) first[i] = -scale * slope[i];
        solved_by(l, n, first);
        turned(e, of, first, turn);
        for (long i = 0; i < n; ++i) ahead[i] = a[i] + time * first[i];
        for (long r = 0; r < rows; ++r) there[r] = angles[r] + time * turn[r];
        energy_at(e, of, ahead, there, second);
        for (long i = 0; i < n; ++i) second[i] = scale * (-second[i] - 2 * first[i]);
        solved_by(l, n, second);
        for (long i = 0; i < n; ++i) first[i] = time * (1.5 * first[i] + 0.5 * second[i]), ahead[i] = a[i] + first[i];
        turned(e, of, first, turn);
        for (long r = 0; r < rows; ++r) there[r] = angles[r] + turn[r];
        V size = choose(good, largest_of(turn, rows), all(0));
        V lower = energy_at(e, of, ahead, there, 0);
        moved = falling & good & (size <= e->fall) & ((size < 1e-6) | (lower < height));
        for (long i = 0; i < n; ++i) a[i] = choose(moved, ahead[i], a[i]);
        steps += one_where(moved);
        M ends = moved & (size < e->converged) & (time > 40);
        done |= ends;
        V longer = choose(size > 0.1 * e->fall, 0.8 * e->fall / size, all(8));
        V shorter = choose(size > e->fall, larger(all(0.1), 0.8 * e->fall / size), all(0.5));
        time *= choose(moved, longer, shorter);
        falling &= unless(ends) & (time > 1e-12) & (steps < (double)MOST_STEPS);
    }
    return done;
}

/* About the equilibria at past (LANES, ..) that robots fall into from states nearby: x (LANES, ..); for which there is
   one. asked: for which it is looked for. */
APART M settling(const Elastic *e, const double *numbers, const State *const *from, const double *past, M asked,
                  Energy *of, V *room, double *x) {
    long d = TUBES(e), side = 2 * d + 2, rows = of->rows;
    V *towards = room, *motors = room + rows, *angles = motors + rows, *a = angles + rows;
    double at[LANES * SIDE], ahead[LANES * SIDE];
    for (long l = 0; l < LANES; ++l) {
        double most = 0, turn = 0, *on = ahead + side * l;
        predicted(e, numbers + d * NUMBERS * l, from[l], past + side * l, on);
        for (long i = 0; i < side; ++i) {
            on[i] -= from[l]->x[i], most = fmax(most, fabs(on[i]));
            if (i < d) turn = fmax(turn, fabs(on[i]));
        }
        double step = fmin(1e-4 / fmax(turn, 1e-300), 1e-2 / fmax(most, 1e-300));
        for (long i = 0; i < side; ++i) on[i] = from[l]->x[i] + step * on[i];
        memcpy(at + side * l, from[l]->x, side * sizeof *at);
    }
    described(e, numbers, ahead, of);
    memcpy(towards, of->angles, rows * sizeof *towards);
    described(e, numbers, at, of);
    memcpy(angles, of->angles, rows * sizeof *angles);
    described(e, numbers, past, of);
    for (long r = 0; r < rows; ++r) {
        towards[r] -= angles[r];
        for (long l = 0; l < LANES; ++l)
            set_lane(motors + r, l, past[side * l + FIRST(e)[r]] - past[side * l + OTHER(e)[r]]);
        motors[r] += of->made[r];
    }
    if (of->n == 0) return every(0);
    M found = fall(e, of, motors, angles, towards, asked, a);
    memcpy(x, past, LANES * side * sizeof *x);
    for (long i = d - 1; i >= 0; --i) {
        V tip = of->made[rows + i] + product(of->ends + of->n * i, a, of->n);
        for (long l = 0; l < LANES; ++l) {
            double *own = x + side * l;
            own[i] += lane(&tip, l) - (i < d - 1 ? own[d - 1] : 0);
        }
    }
    return found;
}

/* Let up to LANES robots, numbers (LANES, ..), fall from where their branches end on the way to their goals into stable
   equilibria just past these; found: whether there is one. */
APART void fallen(const Elastic *e, const double *numbers, State *const *states, const double *const *goals,
                   long count, int *found) {
    long d = TUBES(e), side = 2 * d + 2, left = count;
    double past[LANES * SIDE], x[LANES * SIDE];
    const State *from[LANES];
    State to[LANES];
    RESERVE(room, ENERGY_ROOM(e) + 3 * ROWS(e) + AGAINST(e));
    Energy of = energy_in(e, room);
    for (long l = 0; l < LANES; ++l) found[l] = 0, from[l] = states[l < count ? l : 0];
    for (long k = 0; k < PLACES && left; ++k) {
        double part = pow(e->smallest, 1 - k / (PLACES - 1.0));
        V asked = all(0);
        for (long l = 0; l < LANES; ++l) {
            const double *goal = goals[l < count ? l : 0];
            for (long i = 0; i < side; ++i)
                past[side * l + i] = k == PLACES - 1 ? goal[i] : from[l]->q[i] + part * (goal[i] - from[l]->q[i]);
            set_lane(&asked, l, l < count && !found[l]);
        }
        V ends = one_where(settling(e, numbers, from, past, asked > 0, &of, room + ENERGY_ROOM(e), x));
        int near[LANES];
        for (long l = 0; l < LANES; ++l) {
            double *own = x + side * l;
            memcpy(to[l].x, own, side * sizeof *x);
            to[l].stable = 1;
            near[l] = lane(&ends, l) > 0 && newton(e, numbers + d * NUMBERS * l, past + side * l, to + l, e->converged);
            for (long i = 0; i < side; ++i) own[i] -= to[l].x[i];
            near[l] = near[l] && largest(own, side) < e->stray;
            memcpy(own, to[l].x, side * sizeof *x);
        }
        V margin = margins_beside(e, numbers, x);
        for (long l = 0; l < count; ++l)
            if (!found[l] && near[l] && lane(&margin, l) > 0) *states[l] = to[l], found[l] = 1, --left;
    }
    RELEASE(room);
}

/* Fall from where a branch ended on the way to goal, and go on, wherever one ends; whether goal is reached. jumps
   (MOST_FALLS, d): what every fall turned the tips by, as many as there were. */
static int beyond(const Elastic *e, const double *numbers, State *state, const double *goal, double *jumps,
                  long *falls) {
    long d = TUBES(e);
    int there = 0, found[LANES];
    double own[LANES * MOST_TUBES * NUMBERS];
    fill_lanes(numbers, 0, d * NUMBERS, 1, own);
    for (*falls = 0; !there; there = along(e, numbers, state, goal, 1)) {
        const State from = *state;
        if (*falls == MOST_FALLS) return 0;
        fallen(e, own, &state, &goal, 1, found);
        if (!found[0]) return 0;
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
