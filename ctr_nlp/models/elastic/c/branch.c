/* Equilibria of the elastic model: Newton's method along a branch.

   The model's equations are in the two functions, which are generated. Rows may differ in the numbers of their tubes. */

#include <math.h>
#include <string.h>

typedef int (*Function)(const double **, double **, long long *, double *, int);

/* d tubes; motors: (x, numbers) -> alpha, slopes (d, d - 1) over phi, column by column. energy: (x, numbers) -> the
   strengths and angles of rows, between the tubes `first` and `other`, and what unit twists of tubes against each other
   turn these angles (rows, against) and tips (d, against) by, row by row. second: (x, numbers) -> the energy's second
   variation (against, against) for these twists.
   shape: -> vectors (3, vectors) and the tip's direction; points: (arc lengths, vectors, extensions, numbers) -> the
   points there, for LANES arc lengths at once.

   converged: the last step of Newton's method, near: on the way, rad; stray: how far an equilibrium may be from its
   prediction; leap: rad that tips may be predicted to turn against each other in a step, beyond their motors;
   smallest: part of a step; stride: rad that tubes are turned by at once; push, fall: rad that tubes turn by against
   each other where a branch ends, and at most in a step of a fall; iterations: at most. */
typedef struct {
    long d, rows, against, vectors;
    const long *first, *other;
    Function motors, energy, second, shape, points;
    double converged, near, stray, leap, smallest, stride, push, fall;
    long iterations;
} Elastic;

enum { MOST_TUBES = 8, SIDE = 2 * MOST_TUBES + 2 };

/* An equilibrium x at q, with d alpha / d phi, column by column, and its determinant; stable: whether it is. */
typedef struct {
    double q[SIDE], x[SIDE], slopes[MOST_TUBES * MOST_TUBES], determinant;
    long stable;
} State;

/* Solve slopes turn = turn in place; the determinant, 0 where they are singular. */
static double solved_for(long d, const double *slopes, double *turn) {
    double a[MOST_TUBES * MOST_TUBES], found = 1;
    memcpy(a, slopes, d * d * sizeof *a);
    for (long k = 0; k < d; ++k) {
        long best = k;
        for (long i = k + 1; i < d; ++i)
            if (fabs(a[i + d * k]) > fabs(a[best + d * k])) best = i;
        if (a[best + d * k] == 0) return 0;
        if (best != k) {
            for (long j = k; j < d; ++j) {
                double kept = a[k + d * j];
                a[k + d * j] = a[best + d * j], a[best + d * j] = kept;
            }
            double kept = turn[k];
            turn[k] = turn[best], turn[best] = kept, found = -found;
        }
        found *= a[k + d * k];
        for (long i = k + 1; i < d; ++i) {
            double part = a[i + d * k] / a[k + d * k];
            for (long j = k + 1; j < d; ++j) a[i + d * j] -= part * a[k + d * j];
            turn[i] -= part * turn[k];
        }
    }
    for (long k = d - 1; k >= 0; --k) {
        for (long j = k + 1; j < d; ++j) turn[k] -= a[k + d * j] * turn[j];
        turn[k] /= a[k + d * k];
    }
    return found;
}

static void motors(const Elastic *e, const double *x, const double *numbers, double *alpha, double *slopes) {
    const double *arg[] = {x, numbers};
    double *res[] = {alpha, slopes};
    e->motors(arg, res, 0, 0, 0);
    for (long i = 0; i < e->d; ++i) slopes[i + e->d * (e->d - 1)] = 1;
}

static double largest(const double *a, long n) {
    double found = 0;
    for (long i = 0; i < n; ++i)
        if (!(fabs(a[i]) <= found)) found = fabs(a[i]);
    return found;
}

/* Newton's method at q from to->x; whether it ends, with the last step below `converged`. */
static int newton(const Elastic *e, const double *numbers, const double *q, State *to, double converged) {
    long d = e->d;
    memcpy(to->x + d, q + d, (d + 2) * sizeof *q);
    for (long k = 0; k < e->iterations; ++k) {
        double turn[MOST_TUBES], alpha[MOST_TUBES];
        motors(e, to->x, numbers, alpha, to->slopes);
        for (long i = 0; i < d; ++i) turn[i] = q[i] - alpha[i];
        to->determinant = solved_for(d, to->slopes, turn);
        double size = largest(turn, d);
        if (to->determinant == 0 || !(size < 1)) return 0;
        for (long i = 0; i < d; ++i) to->x[i] += turn[i];
        if (size < converged) {
            memcpy(to->q, q, (2 * d + 2) * sizeof *q);
            return 1;
        }
    }
    return 0;
}

/* Where the tangent of a branch leads to at goal: x. */
static void predicted(const Elastic *e, const double *numbers, const State *from, const double *goal, double *x) {
    long d = e->d;
    double turn[MOST_TUBES], slopes[MOST_TUBES * MOST_TUBES];
    memcpy(x, from->x, d * sizeof *x);
    memcpy(x + d, goal + d, (d + 2) * sizeof *x);
    if (memcmp(goal + d, from->q + d, d * sizeof *x)) {
        motors(e, x, numbers, turn, slopes);
        for (long i = 0; i < d; ++i) turn[i] = goal[i] - turn[i];
    } else
        for (long i = 0; i < d; ++i) turn[i] = goal[i] - from->q[i];
    if (solved_for(d, from->slopes, turn) != 0)
        for (long i = 0; i < d; ++i) x[i] += turn[i];
}

/* The same, better, with a state before `from` on a line on which tubes turn and do not slide: the cubic through both
   with their tangents, a ratio of their distance ahead. */
static void extrapolated(const Elastic *e, const State *before, const State *from, double ratio, double *x) {
    double slow[MOST_TUBES], fast[MOST_TUBES], s = 1 + ratio;
    for (long i = 0; i < e->d; ++i) slow[i] = fast[i] = from->q[i] - before->q[i];
    if (solved_for(e->d, before->slopes, slow) == 0 || solved_for(e->d, from->slopes, fast) == 0) return;
    for (long i = 0; i < e->d; ++i)
        x[i] = from->x[i] + (from->x[i] - before->x[i]) * (3 - 2 * s) * s * s - (from->x[i] - before->x[i]) +
               s * (s - 1) * ((s - 1) * slow[i] + s * fast[i]);
}

static double margin_at(const Elastic *e, const double *numbers, const double *x);

/* One step along a branch to where it is predicted, ahead; whether it is clear that `to` is on it. An unstable one may
   pass a fold. */
static int stepped(const Elastic *e, const double *numbers, const State *from, const double *goal, double *ahead,
                   State *to, int end) {
    double turn[MOST_TUBES], by_motors[MOST_TUBES];
    for (long i = 0; i + 1 < e->d; ++i) {
        turn[i] = ahead[i] - from->x[i];
        by_motors[i] = (goal[i] - goal[e->d - 1]) - (from->q[i] - from->q[e->d - 1]);
    }
    if (!(largest(turn, e->d - 1) < e->leap + largest(by_motors, e->d - 1))) return 0;
    memcpy(to->x, ahead, e->d * sizeof *ahead);
    to->stable = from->stable;
    if (!newton(e, numbers, goal, to, end ? e->converged : e->near)) return 0;
    for (long i = 0; i < e->d; ++i) ahead[i] -= to->x[i];
    if (!(largest(ahead, e->d) < e->stray)) return 0;
    if (to->determinant * from->determinant > 0) return 1;
    if (!from->stable) to->stable = margin_at(e, numbers, to->x) > 0;
    return !from->stable;
}

/* How far ahead a branch ends, in parts of the way: the square of the determinant falls to 0 there, in a line close by.
   before: the state at `last` parts behind. */
static double until_fold(const State *before, const State *from, double last) {
    double behind = before->determinant * before->determinant, here = from->determinant * from->determinant;
    return here < behind ? last * here / (behind - here) : HUGE_VAL;
}

/* Follow a branch towards goal, in steps of at most `most` of the way; whether it goes so far. Towards a fold a step
   goes three quarters of the way: from there Newton's method still finds the branch from its tangent. */
static int along(const Elastic *e, const double *numbers, State *state, const double *goal, double most) {
    double start[SIDE], place[SIDE], ahead[SIDE], done = 0, last = 0, part = most < 1 ? most : 1;
    long n = 2 * e->d + 2;
    int turns = !memcmp(goal + e->d, state->q + e->d, e->d * sizeof *goal);
    State before, to;
    memcpy(start, state->q, n * sizeof *start);
    while (part >= e->smallest) {
        int end = done + part >= 1;
        for (long i = 0; i < n; ++i) place[i] = end ? goal[i] : start[i] + (done + part) * (goal[i] - start[i]);
        predicted(e, numbers, state, place, ahead);
        if (turns && last > 0) extrapolated(e, &before, state, part / last, ahead);
        if (!stepped(e, numbers, state, place, ahead, &to, end)) {
            part /= 2;
            continue;
        }
        before = *state, *state = to;
        if (end) return 1;
        done += part, last = part;
        part = fmin(fmin(fmin(2 * part, most), 1 - done), 0.75 * until_fold(&before, state, last));
    }
    return 0;
}

/* Follow a branch through goals, one after the other, and write the equilibria; how many were reached. */
long walk(const Elastic *e, const double *numbers, State *state, const double *goals, long count, double *x) {
    long n = 2 * e->d + 2, k = 0;
    while (k < count && along(e, numbers, state, goals + k * n, 1)) memcpy(x + n * k++, state->x, n * sizeof *x);
    return k;
}
