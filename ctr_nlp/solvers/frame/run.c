/* Frames solved one after the other, each from the one before it; sqp.c comes before this file. */

#include <time.h>

#define BY_FAR 0.25 /* parts of an error in which another one is much less */

/* What is given of every frame, and what is found: rows of arrays that are stored frame by frame.

   picks: which rows of the program are the configuration and what else may only change so much from frame to frame.
   low, high: their limits; most: by how much they may change. previous: where in p the configuration of the frame
   before stands; decided: how many of its entries. here: of the frame before, updated. course: three rows as long as x,
   updated: by how much x moved in the frame before, by how much more than in the one before that, and by how much it
   is expected to move in the next, which is begun there if that is better; null where each is begun at x.

   around: where some parameters hold near a robot only, what gives these from x and the load's numbers, which begin at
   place load in p: described entries from place in p on, and then the slack that they need, x's last entry; null where
   all hold everywhere. A mm of it costs p[weight] mm^2, and hard times as much beyond p[allowed] mm, where that sets in over rounded mm;
   a mm^2 costs firm mm^2 (ocp/terms/lumen.py, contact). Rounds around solutions end where the slack needed
   changes by no more than settled mm. */
typedef struct {
    void (*around)(void *, const double *, const double *, double *);
    void *of;
    long load, place, described, weight, allowed, rounds;
    double firm, hard, rounded, settled, *found;
    long sizes_p, picked, decided, previous;
    const long *picks;
    const double *p, *low, *high, *most;
    double feasible, optimal;
    double *here, *course, *x, *rows, *multipliers, *objective, *kkt, *seconds;
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
    const double beyond = fmax(slack - o->p[r->allowed], 0), corner = fmin(beyond, r->rounded);
    const double more = (r->hard - 1) * corner * (beyond - corner / 2) / r->rounded;
    return o->p[r->weight] * (slack + more) + r->firm * slack * slack;
}

/* What is around the robot as it is; returns the slack that it needs. */
static double surround(const Run *r, const Program *o) {
    r->around(r->of, o->x, o->p + r->load, r->found);
    return r->found[r->described];
}

/* Take what surround has found. */
static void take(const Run *r, Program *o) {
    o->x[o->n - 1] = r->found[r->described];
    memcpy((double *)o->p + r->place, r->found, r->described * sizeof *o->p);
}

/* The objective of x, and the l1 merit by penalties above the multipliers that there are. */
static double merit(const Run *r, Program *o, double *objective) {
    double rows[o->n + o->m], penalty[] = {0, 0};
    Point point = {.value = rows};
    if (r->around) surround(r, o), take(r, o);
    at(o, o->value, &point);
    adapt(o, o->multipliers, penalty);
    *objective = point.f;
    return point.f + violation(o, rows, penalty);
}

/* Begin a frame where x is expected, if the merit is less there than where the frame before ended; whether it is.
   stay: the objective where that ended. */
static int go_on(const Run *r, Program *o, double *stay) {
    long n = o->n;
    double before[n], there;
    const double *ahead = r->course + 2 * n;
    memcpy(before, o->x, sizeof before);
    double least = merit(r, o, stay);
    for (long i = 0; i < n; ++i) o->x[i] = before[i] + ahead[i];
    keep_within(o);
    int better = merit(r, o, &there) < least;
    if (!better) memcpy(o->x, before, sizeof before);
    return better;
}

/* What a frame tells of the next: an unknown will move as it did; or by as much more as it moved more this time,
   where that would have told its movement better this time by far. */
static void expect(const Run *r, long n, const double *before, const double *x) {
    double *moved = r->course, *more = moved + n, *ahead = more + n;
    for (long i = 0; i < n; ++i) {
        double now = x[i] - before[i], change = now - moved[i];
        ahead[i] = now + (fabs(change - more[i]) < BY_FAR * fabs(change) ? change : 0);
        moved[i] = now, more[i] = change;
    }
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

static void attempt(const Run *r, Program *o) {
    (r->around ? settle(r, o) : sqp(o));
    keep_within(o);
}

/* Solve a frame from where it is begun; from where the frame before ended, with the iterations that are left, where
   this was another place and leads to no solution, or to one that is worse than to stay. */
static void solve_frame(const Run *r, Program *o, const double *before) {
    double stay = INFINITY;
    int elsewhere = r->course && go_on(r, o, &stay);
    attempt(r, o);
    long spent = o->iterations, most = o->most;
    if (!elsewhere || (solved(r, o) && o->objective <= stay)) return;
    memcpy(o->x, before, o->n * sizeof *before), memset(o->multipliers, 0, (o->n + o->m) * sizeof *before);
    keep_within(o);
    o->most = spent < most ? most - spent : 0;
    attempt(r, o);
    o->most = most, o->iterations += spent;
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
        solve_frame(r, o, before);
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
            if (r->course) memset(r->course, 0, 3 * sizeof before);
            break;
        }
        for (long k = 0; k < r->picked; ++k) {
            long row = r->picks[k];
            r->here[k] = within(found[row], lower[row], upper[row]);
        }
        if (r->course) expect(r, n, before, o->x);
    }
    return found_all;
}
