/* The iterations of banded.py, many in one call; rows.c comes before this file. */

#include <string.h>

/* A function of a frame for all of them, each a row: the struct of mapped.py. whole: instead, what evaluates all of
   them; null where there is none. */
typedef struct {
    int (*of_rows)(const double *const *, double *const *, long);
    void (*whole)(void);
    long rows;
    const double *in[4];
    double *out[5];
} Mapped;

/* A barrier method on its way. merits: of this barrier problem, the last of them; told: of an iterate. */
typedef struct {
    Chain *chain;
    const Mapped *values, *expansion;
    double *x_of_values, *x_of_expansion, *multipliers; /* what they read */
    double *hessian, *convexified, *merit, *told_x;
    double tolerance, feasible, last_barrier, close, shrink, damping, most_damping, diverged, loose, stalled;
    long most_iterations, most_halvings, stall;
    double barrier, penalty;
    long number, expanded, merits;
    double measures[6]; /* objective, violation, gap, stationarity, least and most product */
    long known, told_number;
    double told_objective, told_violation, told_error;
} Loop;

enum { GOING, SOLVED, ACCEPTABLE, INFEASIBLE, STUCK, STOPPED };

/* Evaluate; where there is no memory for it, nothing is known there. */
static void evaluated(const Mapped *m) {
    if (m->whole)
        m->whole();
    else if (m->of_rows(m->in, m->out, m->rows))
        for (long i = 0; i < m->rows; ++i) m->out[0][i] = NAN;
}

/* The multipliers of the frames' constraints, with what links that pass through them add; the rows' values are those
   at the point. */
static void of_constraints(const Chain *c, double *result) {
    long of_x = size(c), to_links = before_links(c);
    for (long i = of_x; i < to_links; ++i) result[i - of_x] = c->at.at_upper[i] - c->at.at_lower[i];
    for (long i = 0; c->bent && i < c->links; ++i) {
        long row = to_links + i;
        double pull = c->at.at_upper[row] - c->at.at_lower[row] + 2 * c->weight[i] * c->value[row];
        for (int e = c->starts[i]; e < c->starts[i + 1]; ++e)
            if (c->columns[e] >= of_x) result[c->columns[e] - of_x] += c->entries[e] * pull;
    }
}

/* KKT residual of a barrier problem; with barrier 0, of the problem itself. */
static double error(const Loop *s, double barrier) {
    const double *m = s->measures;
    return worst(worst(m[3], m[2]), worst(fabs(m[4] - barrier), fabs(m[5] - barrier)));
}

static void expand(Loop *s) {
    Chain *c = s->chain;
    long of_x = size(c);
    double *m = s->measures, **out = (double **)s->expansion->out;
    memcpy(s->x_of_expansion, c->at.x, of_x * sizeof *m);
    of_constraints(c, s->multipliers);
    evaluated(s->expansion);
    assess(c, out[0], out[2], m, m + 1, m + 2, m + 3, m + 4, m + 5);
    int feasible = m[1] <= s->feasible && m[0] == m[0], better = feasible && (s->known < 2 || m[0] < s->told_objective);
    if (better || s->known < 2) {
        s->known = feasible ? 2 : 1, s->told_number = s->number;
        s->told_objective = m[0], s->told_violation = m[1], s->told_error = error(s, 0);
        memcpy(s->told_x, c->at.x, of_x * sizeof *m);
    }
    s->expanded = 1;
}

/* A step downhill: with exact Hessians, else convex ones, more and more damped where rounding asks; 0 for none. */
static int newton(Loop *s) {
    Chain *c = s->chain;
    assemble(c, s->hessian, s->barrier, s->damping);
    if (solve(c)) return 1;
    convex(c->frames, c->unknowns, s->hessian, s->convexified);
    for (double damping = s->damping; damping <= s->most_damping; damping *= 1e3) {
        assemble(c, s->convexified, s->barrier, damping);
        if (solve(c)) return 1;
    }
    return 0;
}

static double merit_at(Loop *s, int of_trial) {
    double **out = (double **)(of_trial ? s->values : s->expansion)->out;
    return merit(s->chain, of_trial, out[0], out[of_trial ? 1 : 2], s->barrier, s->penalty);
}

/* Go as far along a step as the merit falls enough; 0 where it never does. slope: less the penalty's part. */
static int searched(Loop *s, double primal, double dual, double slope, double gap) {
    Chain *c = s->chain;
    double before = s->merit[s->merits - 1];
    slope -= s->penalty * gap;
    for (long k = 0; k < s->most_halvings; ++k, primal /= 2) {
        advance_trial(c, primal, dual);
        memcpy(s->x_of_values, c->trial.x, size(c) * sizeof *c->trial.x);
        evaluated(s->values);
        double found = merit_at(s, 1);
        if (found <= before + 1e-4 * primal * slope + 1e-12 * fabs(before)) {
            accept_trial(c);
            s->merit[s->merits++] = found;
            return 1;
        }
    }
    return 0;
}

/* One step from a point that has been expanded; GOING where it is not the last. */
static long stepped(Loop *s) {
    Chain *c = s->chain;
    if (error(s, 0) <= s->tolerance) return SOLVED;
    int stalled = s->measures[2] <= s->feasible && s->merits > s->stall;
    if (stalled) {
        double last = s->merit[s->merits - 1], earlier = s->merit[s->merits - s->stall];
        stalled = earlier - last < s->stalled * (1 + fabs(last));
    }
    if (stalled && s->barrier == s->last_barrier) return ACCEPTABLE;
    while (s->barrier > s->last_barrier && (stalled || error(s, s->barrier) < s->close * s->barrier)) {
        s->barrier = most(s->last_barrier, s->shrink * s->barrier);
        s->merits = 0, stalled = 0;
    }
    double multiplier, primal, dual, slope, gap;
    if (!newton(s)) return INFEASIBLE;
    complete(c, s->barrier, &multiplier, &primal, &dual, &slope, &gap);
    double needed = 1.1 * multiplier;
    if (needed > s->diverged) return INFEASIBLE;
    if (!(needed <= s->penalty && s->penalty <= s->loose * needed)) s->penalty = needed, s->merits = 0;
    if (!s->merits) s->merit[s->merits++] = merit_at(s, 0);
    if (!searched(s, primal, dual, slope, gap)) return STUCK;
    if (s->number == s->most_iterations) return STOPPED;
    ++s->number, s->expanded = 0;
    return GOING;
}

/* Expand so many points, with steps between them, and tell of the best feasible one, else of the last. */
long iterate(Loop *s, long points) {
    s->known = 0;
    for (long k = 0; k < points;) {
        if (s->expanded) {
            long status = stepped(s);
            if (status != GOING) return status;
        }
        expand(s);
        ++k;
    }
    return GOING;
}
