/* Equilibria of the elastic model: Newton's method along a branch; lanes.c comes before this file.

   The model's equations are in the two functions, which are generated. Rows may differ in the numbers of their tubes. */

typedef int (*Function)(const double **, double **, long long *, double *, int);

/* d tubes of NUMBERS numbers each; motors: (x, numbers) -> alpha, slopes (d, d - 1) over phi, column by column, of one
   robot. The others are of LANES robots at once. motors_beside: motors. energy: (x, numbers) -> as vectors, the strengths
   and angles of rows, between the tubes `first` and `other`, what unit twists of tubes against each other turn these
   angles (rows, against) and tips (d, against) by, row by row, and what helices turn both by of themselves; of the first
   of these those that are not always 0, at `columns`, which begin at `starts` (rows + 1) row by row. second:
   (x, numbers) -> as vectors, the energy's second variation (against, against) for these twists. shape: -> vectors (3,
   vectors) and the tips' directions; points: (arc lengths, vectors, extensions, numbers) -> the points there, for LANES
   arc lengths of one robot.

   converged: the last step of Newton's method, near: on the way, rad; stray: how far an equilibrium may be from its
   prediction; leap: rad that tips may be predicted to turn against each other in a step, beyond their motors;
   smallest: part of a step; stride: rad that tubes are turned by at once; push, fall: rad that tubes turn by against
   each other where a branch ends, and at most in a step of a fall; iterations: at most. */
typedef struct {
    long d, rows, against, vectors;
    const long *first, *other, *starts, *columns;
    Function motors, energy, second, shape, points, motors_beside;
    double converged, near, stray, leap, smallest, stride, push, fall;
    long iterations;
} Elastic;

enum { MOST_TUBES = 8, NUMBERS = 8, SIDE = 2 * MOST_TUBES + 2 };

/* An equilibrium x at q, with d alpha / d phi, column by column, and its determinant; stable: whether it is. */
typedef struct {
    double q[SIDE], x[SIDE], slopes[MOST_TUBES * MOST_TUBES], determinant;
    long stable;
} State;

/* Solve slopes turn = turn in place; the determinant, 0 where they are singular. */
APART double solved_for(long d, const double *slopes, double *turn) {
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

static void motors_at(const Elastic *e, const double *x, const double *numbers, double *alpha, double *slopes) {
    const double *arg[] = {x, numbers};
    double *res[] = {alpha, slopes};
    CALL(e, motors)(arg, res, 0, 0, 0);
    for (long i = 0; i < TUBES(e); ++i) slopes[i + TUBES(e) * (TUBES(e) - 1)] = 1;
}

/* Take the slopes of one of LANES robots, which are without the last column. */
static void take_slopes(const Elastic *e, const double *slopes, long lane, State *to) {
    long d = TUBES(e);
    memcpy(to->slopes, slopes + d * (d - 1) * lane, d * (d - 1) * sizeof *slopes);
    for (long i = 0; i < d; ++i) to->slopes[i + d * (d - 1)] = 1;
}

static int equal(const double *a, const double *b, long n) {
    long i = 0;
    while (i < n && a[i] == b[i]) ++i;
    return i == n;
}

static double largest(const double *a, long n) {
    double found = 0;
    for (long i = 0; i < n; ++i)
        if (!(fabs(a[i]) <= found)) found = fabs(a[i]);
    return found;
}

/* One step of Newton's method at q from to->x with motors' angles alpha and to->slopes there: how far, rad; HUGE_VAL
   where it leads nowhere. */
static double improved(const Elastic *e, const double *q, const double *alpha, State *to) {
    double turn[MOST_TUBES];
    for (long i = 0; i < TUBES(e); ++i) turn[i] = q[i] - alpha[i];
    to->determinant = solved_for(TUBES(e), to->slopes, turn);
    double size = largest(turn, TUBES(e));
    if (to->determinant == 0 || !(size < 1)) return HUGE_VAL;
    for (long i = 0; i < TUBES(e); ++i) to->x[i] += turn[i];
    return size;
}

/* Newton's method at q from to->x; whether it ends, with the last step below `converged`. */
APART int newton(const Elastic *e, const double *numbers, const double *q, State *to, double converged) {
    long d = TUBES(e);
    double size = 1, alpha[MOST_TUBES];
    memcpy(to->x + d, q + d, (d + 2) * sizeof *q);
    memcpy(to->q, q, (2 * d + 2) * sizeof *q);
    for (long k = 0; k < e->iterations && size >= converged && size <= 1; ++k) {
        motors_at(e, to->x, numbers, alpha, to->slopes);
        size = improved(e, q, alpha, to);
    }
    return size < converged;
}

/* Where the tangent of a branch leads to at goal: x. */
static void predicted(const Elastic *e, const double *numbers, const State *from, const double *goal, double *x) {
    long d = TUBES(e);
    double turn[MOST_TUBES], slopes[MOST_TUBES * MOST_TUBES];
    memcpy(x, from->x, d * sizeof *x);
    memcpy(x + d, goal + d, (d + 2) * sizeof *x);
    if (!equal(goal + d, from->q + d, d)) {
        motors_at(e, x, numbers, turn, slopes);
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
    for (long i = 0; i < TUBES(e); ++i) slow[i] = fast[i] = from->q[i] - before->q[i];
    if (solved_for(TUBES(e), before->slopes, slow) == 0 || solved_for(TUBES(e), from->slopes, fast) == 0) return;
    for (long i = 0; i < TUBES(e); ++i)
        x[i] = from->x[i] + (from->x[i] - before->x[i]) * (3 - 2 * s) * s * s - (from->x[i] - before->x[i]) +
               s * (s - 1) * ((s - 1) * slow[i] + s * fast[i]);
}

static double margin_at(const Elastic *e, const double *numbers, const double *x);

/* Whether tips may turn to where they are predicted, ahead, in one step. */
static int near_enough(const Elastic *e, const State *from, const double *goal, const double *ahead) {
    double turn[MOST_TUBES], by_motors[MOST_TUBES];
    for (long i = 0; i + 1 < TUBES(e); ++i) {
        turn[i] = ahead[i] - from->x[i];
        by_motors[i] = (goal[i] - goal[TUBES(e) - 1]) - (from->q[i] - from->q[TUBES(e) - 1]);
    }
    return largest(turn, TUBES(e) - 1) < e->leap + largest(by_motors, TUBES(e) - 1);
}

/* Whether an equilibrium is where it was predicted, ahead. */
static int as_predicted(const Elastic *e, const double *ahead, const State *to) {
    double apart[MOST_TUBES];
    for (long i = 0; i < TUBES(e); ++i) apart[i] = ahead[i] - to->x[i];
    return largest(apart, TUBES(e)) < e->stray;
}

/* Whether no fold lies between two neighbouring equilibria of a branch. */
static int alike(const State *from, const State *to) { return to->determinant * from->determinant > 0; }

/* A way along a branch: `start` of it at the state `at`, of which a part is done, the `last` of it since `before`; the
   next part, and the most at once. turns: whether tubes turn and do not slide. */
typedef struct {
    State at, before;
    double start[SIDE], goal[SIDE], done, last, part, most;
    int turns;
} Way;

static void set_off(const Elastic *e, Way *way, const State *from, const double *goal, double most) {
    long n = 2 * TUBES(e) + 2;
    way->at = *from;
    memcpy(way->start, from->q, n * sizeof *goal);
    memcpy(way->goal, goal, n * sizeof *goal);
    way->turns = equal(goal + TUBES(e), from->q + TUBES(e), TUBES(e));
    way->done = way->last = 0, way->part = way->most = fmin(most, 1);
}

static int at_end(const Way *way) { return way->done + way->part >= 1; }

/* The place after the next part, and what is predicted there; whether that is near enough. */
static int foreseen(const Elastic *e, const double *numbers, const Way *way, double *place, double *ahead) {
    double done = way->done + way->part;
    for (long i = 0; i < 2 * TUBES(e) + 2; ++i)
        place[i] = at_end(way) ? way->goal[i] : way->start[i] + done * (way->goal[i] - way->start[i]);
    predicted(e, numbers, &way->at, place, ahead);
    if (way->turns && way->last > 0) extrapolated(e, &way->before, &way->at, way->part / way->last, ahead);
    return near_enough(e, &way->at, place, ahead);
}

/* How far ahead a branch ends, in parts of the way: the square of the determinant falls to 0 there, in a line close by.
   before: the state at `last` parts behind. */
static double until_fold(const State *before, const State *from, double last) {
    double behind = before->determinant * before->determinant, here = from->determinant * from->determinant;
    return here < behind ? last * here / (behind - here) : HUGE_VAL;
}

/* Go on to the equilibrium after the next part; whether that is the end. Towards a fold the part after it is three
   quarters of the rest: from there Newton's method still finds the branch from its tangent. */
static int gone_on(Way *way, const State *to) {
    int end = at_end(way);
    way->before = way->at, way->at = *to;
    way->done += way->part, way->last = way->part;
    way->part = fmin(fmin(2 * way->part, way->most), 1 - way->done);
    way->part = fmin(way->part, 0.75 * until_fold(&way->before, &way->at, way->last));
    return end;
}

/* The equilibrium after the next part of a way; whether it is clear that it is on the branch. An unstable one may pass
   a fold. */
static int stepped(const Elastic *e, const double *numbers, const Way *way, State *to) {
    double place[SIDE], ahead[SIDE];
    if (!foreseen(e, numbers, way, place, ahead)) return 0;
    memcpy(to->x, ahead, TUBES(e) * sizeof *ahead);
    to->stable = way->at.stable;
    if (!newton(e, numbers, place, to, at_end(way) ? e->converged : e->near)) return 0;
    if (!as_predicted(e, ahead, to)) return 0;
    if (alike(&way->at, to)) return 1;
    if (!way->at.stable) to->stable = margin_at(e, numbers, to->x) > 0;
    return !way->at.stable;
}

/* Follow a branch towards goal, in steps of at most `most` of the way; whether it goes so far. */
APART int along(const Elastic *e, const double *numbers, State *state, const double *goal, double most) {
    Way way;
    State to;
    int there = 0;
    set_off(e, &way, state, goal, most);
    while (!there && way.part >= e->smallest)
        if (stepped(e, numbers, &way, &to))
            there = gone_on(&way, &to);
        else
            way.part /= 2;
    *state = way.at;
    return there;
}

/* Follow a branch through goals, one after the other, and write the equilibria; how many were reached. */
long walk(const Elastic *e, const double *numbers, State *state, const double *goals, long count, double *x) {
    long n = 2 * TUBES(e) + 2, k = 0;
    while (k < count && along(e, numbers, state, goals + k * n, 1)) memcpy(x + n * k++, state->x, n * sizeof *x);
    return k;
}
