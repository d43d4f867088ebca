/* Frames solved one after the other, each from the one before it; sqp.c comes before this file. */

#include <time.h>

/* What is given of every frame, and what is found: rows of arrays that are stored frame by frame.

   picks: which rows of the program are the configuration and what else may only change so much from frame to frame.
   low, high: their limits; most: by how much they may change. previous: where in p the configuration of the frame
   before stands; decided: how many of its entries. here: of the frame before, updated. moved: by how much x changed in
   the frame before, updated: a frame is begun where x would go on so; null where each is begun at x.

   around: where some parameters hold near a robot only, what gives these, described entries from place in p on, and
   then the slack that they need, x's last entry; null where all hold everywhere. A mm of it costs p[weight] mm^2, and
   firm mm^2 a mm^2. Rounds around solutions end where the slack needed changes by no more than settled mm. */
typedef struct {
    void (*around)(void *, const double *, double *);
    void *of;
    long place, described, weight, rounds;
    double firm, settled, *found;
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

static void keep_within(Program *o) {
    for (long i = 0; i < o->n; ++i) o->x[i] = within(o->x[i], o->lower[i], o->upper[i]);
}

static int solved(const Run *r, const Program *o) { return o->violation <= r->feasible && o->kkt <= r->optimal; }

static double cost(const Run *r, const Program *o, double slack) {
    return o->p[r->weight] * slack + r->firm * slack * slack;
}

/* What is around the robot as it is; returns the slack that it needs. */
static double surround(const Run *r, const Program *o) {
    r->around(r->of, o->x, r->found);
    return r->found[r->described];
}

/* Take what surround has found. */
static void take(const Run *r, Program *o) {
    o->x[o->n - 1] = r->found[r->described];
    memcpy((double *)o->p + r->place, r->found, r->described * sizeof *o->p);
}

static double objective(const Run *r, Program *o, Point *point) {
    if (r->around) surround(r, o), take(r, o);
    at(o, o->value, point);
    return point->f;
}

/* Begin a frame where the motion would go on, if that is better than where the frame before ended. */
static void go_on(const Run *r, Program *o) {
    long n = o->n;
    double before[n], rows[n + o->m];
    const double even[] = {1, 1};
    Point point = {.value = rows};
    memcpy(before, o->x, sizeof before);
    double stay = objective(r, o, &point);
    for (long i = 0; i < n; ++i) o->x[i] = before[i] + r->moved[i];
    keep_within(o);
    if (!(objective(r, o, &point) < stay && violation(o, rows, even) <= r->feasible))
        memcpy(o->x, before, sizeof before);
}

/* Solve a frame again around its own solution until that needs the same slack; the best of these is kept. */
static void settle(const Run *r, Program *o) {
    long n = o->n, rows = n + o->m, iterations = 0;
    double x[n], multipliers[rows], values[rows], least = INFINITY;
    Program best = *o;
    surround(r, o);
    for (long round = 0; round < r->rounds; ++round) {
        take(r, o);
        sqp(o);
        keep_within(o);
        iterations += o->iterations;
        if (!solved(r, o)) break;
        double slack = o->x[n - 1];
        double needed = surround(r, o), whole = o->objective + cost(r, o, needed) - cost(r, o, slack);
        if (whole < least) {
            least = whole, best = *o;
            memcpy(x, o->x, sizeof x), memcpy(values, o->rows, sizeof values);
            memcpy(multipliers, o->multipliers, sizeof multipliers);
        }
        if (fabs(needed - slack) <= r->settled) break;
    }
    if (least < INFINITY) {
        *o = best, o->objective = least;
        memcpy(o->x, x, sizeof x), memcpy(o->rows, values, sizeof values);
        memcpy(o->multipliers, multipliers, sizeof multipliers);
    }
    o->iterations = iterations;
}

/* Solve so many frames; how many were solved. The program's x and multipliers are where the first frame starts, and its
   bounds those of rows that are not picked. Where a frame is not solved, it is the last that is tried, and x is again
   where the frame before ended.

   starts: where each frame is begun, of which none then depends on the one before; null where they do. */
long run(const Run *r, Program *o, long frames, const double *starts) {
    long n = o->n, rows = n + o->m;
    double *p = (double *)o->p, *lower = (double *)o->lower, *upper = (double *)o->upper;
    long found_all = 0;
    for (long frame = 0; frame < frames; ++frame) {
        double begun = now(), *found = r->rows + frame * rows, before[n];
        memcpy(p, r->p + frame * r->sizes_p, r->sizes_p * sizeof *p);
        if (starts) {
            memcpy(o->x, starts + frame * n, sizeof before);
            memset(o->multipliers, 0, rows * sizeof *p);
        } else
            memcpy(p + r->previous, r->here, r->decided * sizeof *p);
        memcpy(before, o->x, sizeof before);
        for (long k = 0; k < r->picked; ++k) {
            lower[r->picks[k]] = most(r->low[k], r->here[k] - r->most[k]);
            upper[r->picks[k]] = -most(-r->high[k], -r->here[k] - r->most[k]);
        }
        keep_within(o);
        if (r->moved) go_on(r, o);
        (r->around ? settle(r, o) : sqp(o));
        keep_within(o);
        memcpy(found, o->x, n * sizeof *found);
        memcpy(found + n, o->rows + n, o->m * sizeof *found);
        memcpy(r->x + frame * n, o->x, n * sizeof *found);
        memcpy(r->multipliers + frame * rows, o->multipliers, rows * sizeof *found);
        r->objective[frame] = o->objective, r->kkt[frame] = o->kkt;
        r->iterations[frame] = o->iterations, r->status[frame] = o->status;
        r->seconds[frame] = now() - begun;
        r->solved[frame] = solved(r, o);
        found_all += r->solved[frame];
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
    return found_all;
}
