/* Frames solved one after the other, each from the one before it; sqp.c comes before this file. */

#include <time.h>

/* What is given of every frame, and what is found: rows of arrays that are stored frame by frame.

   picks: which rows of the program are the configuration and what else may only change so much from frame to frame.
   low, high: their limits; most: by how much they may change. previous: where in p the configuration of the frame
   before stands; decided: how many of its entries. here: of the frame before, updated. moved: by how much x changed in
   the frame before, updated: a frame is begun where x would go on so; null where each is begun at x. */
typedef struct {
    long sizes_p, picked, decided, previous;
    const long *picks;
    const double *p, *low, *high, *most;
    double feasible, optimal;
    double *here, *moved, *x, *rows, *multipliers, *objective, *kkt, *seconds;
    long *iterations, *status, *solved;
} Run;

static double now(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return at.tv_sec + 1e-9 * at.tv_nsec;
}

static double within(double value, double low, double high) { return value < low ? low : value > high ? high : value; }

static void bring_within(Program *o) {
    for (long i = 0; i < o->n; ++i) o->x[i] = within(o->x[i], o->lower[i], o->upper[i]);
}

/* Begin a frame where the motion would go on, if that is better than where the frame before ended. */
static void go_on(const Run *r, Program *o) {
    long n = o->n;
    double before[n], rows[n + o->m];
    Point stay = {.value = rows}, further = stay;
    memcpy(before, o->x, sizeof before);
    at(o, o->value, &stay);
    for (long i = 0; i < n; ++i) o->x[i] += r->moved[i];
    bring_within(o);
    at(o, o->value, &further);
    if (!(further.f < stay.f && violation(o, rows) <= r->feasible)) memcpy(o->x, before, sizeof before);
}

/* Solve so many frames; how many were solved. The program's x and multipliers are where the first frame starts, and its
   bounds those of rows that are not picked. Where a frame is not solved, it is the last that is tried, and x is again
   where the frame before ended.

   starts: where each frame is begun, of which none then depends on the one before; null where they do. */
long run(const Run *r, Program *o, long frames, const double *starts) {
    long n = o->n, rows = n + o->m;
    double *p = (double *)o->p, *lower = (double *)o->lower, *upper = (double *)o->upper;
    long solved = 0;
    for (long frame = 0; frame < frames; ++frame) {
        double begun = now(), *found = r->rows + frame * rows, before[n];
        memcpy(p, r->p + frame * r->sizes_p, r->sizes_p * sizeof *p);
        if (!starts) memcpy(p + r->previous, r->here, r->decided * sizeof *p);
        for (long k = 0; k < r->picked; ++k) {
            lower[r->picks[k]] = most(r->low[k], r->here[k] - r->most[k]);
            upper[r->picks[k]] = -most(-r->high[k], -r->here[k] - r->most[k]);
        }
        if (starts) {
            memcpy(o->x, starts + frame * n, sizeof before);
            memset(o->multipliers, 0, rows * sizeof *p);
        }
        memcpy(before, o->x, sizeof before);
        bring_within(o);
        if (r->moved) go_on(r, o);
        sqp(o);
        bring_within(o);
        memcpy(found, o->x, n * sizeof *found);
        memcpy(found + n, o->rows + n, o->m * sizeof *found);
        memcpy(r->x + frame * n, o->x, n * sizeof *found);
        memcpy(r->multipliers + frame * rows, o->multipliers, rows * sizeof *found);
        r->objective[frame] = o->objective, r->kkt[frame] = o->kkt;
        r->iterations[frame] = o->iterations, r->status[frame] = o->status;
        r->seconds[frame] = now() - begun;
        r->solved[frame] = o->violation <= r->feasible && o->kkt <= r->optimal;
        solved += r->solved[frame];
        if (starts) continue;
        if (!r->solved[frame]) {
            memcpy(o->x, before, sizeof before), memset(o->multipliers, 0, rows * sizeof *p);
            if (r->moved) memset(r->moved, 0, sizeof before);
            break;
        }
        for (long k = 0; k < r->picked; ++k) {
            long row = r->picks[k];
            r->here[k] = within(found[row], lower[row], upper[row]);
        }
        for (long i = 0; r->moved && i < n; ++i) r->moved[i] = o->x[i] - before[i];
    }
    return solved;
}
