/* Sequential quadratic programming for one small dense problem; what it does is said in sqp.py.

   Rows: x itself, then the constraints. Functions are as CasADi calls them; matrices are stored column by column. */

#include <math.h>
#include <string.h>

#define MOST_HALVINGS 25
#define STALL 6          /* iterations that lower the merit by less than STALLED of it end the work */
#define STALLED 1e-13
#define NEAR 1e-2        /* a step as small as this may be the last: derivatives of first order tell */
#define STILL 1e-6       /* after a step as small as this, multipliers are those of the next point, whole */
#define ACTIVE 1e-9      /* how near to its bound a row is held */
#define DAMPING 1e-9
#define HELD 1e3         /* curvature across active rows, in parts of the largest there is */
#define SWEEPS 12

typedef int (*Function)(const double **, double **, long long *, double *, int);

typedef struct {
    long n, m;
    Function value, slopes, expansion;
    const double *p, *lower, *upper; /* bounds of all rows */
    double tolerance;
    long most;                       /* iterations after which the work ends */
    double *x, *multipliers;         /* where to start, and what was found */
    double *rows;                    /* their values there */
    double objective, kkt, violation;
    long iterations, expansions, evaluations, status;
} Program;

enum { SOLVED, STOPPED, STUCK, NO_STEP };

static double most(double a, double b) { return a > b || a != a ? a : b; }

/* A matrix and right side become its Cholesky factor and solution; 0 where it is not positive definite. */
static int factor(long n, double *a) {
    for (long j = 0; j < n; ++j) {
        double pivot = a[j * n + j];
        for (long k = 0; k < j; ++k) pivot -= a[k * n + j] * a[k * n + j];
        if (!(pivot > 1e-14 * fabs(a[j * n + j]))) return 0;
        pivot = a[j * n + j] = sqrt(pivot);
        for (long i = j + 1; i < n; ++i) {
            double sum = a[j * n + i];
            for (long k = 0; k < j; ++k) sum -= a[k * n + i] * a[k * n + j];
            a[j * n + i] = sum / pivot;
        }
    }
    return 1;
}

static void solve(long n, const double *factor, double *b) {
    for (long k = 0; k < n; ++k) {
        b[k] /= factor[k * n + k];
        for (long i = k + 1; i < n; ++i) b[i] -= factor[k * n + i] * b[k];
    }
    for (long i = n - 1; i >= 0; --i) {
        for (long k = i + 1; k < n; ++k) b[i] -= factor[i * n + k] * b[k];
        b[i] /= factor[i * n + i];
    }
}

/* A symmetric matrix with the absolute values of its eigenvalues, by Jacobi's rotations. */
static void make_convex(long n, double *h) {
    double a[n * n], vectors[n * n];
    memcpy(a, h, sizeof a);
    for (long i = 0; i < n * n; ++i) vectors[i] = i % (n + 1) == 0;
    for (int sweep = 0; sweep < SWEEPS; ++sweep) {
        double off = 0, on = 0;
        for (long i = 0; i < n; ++i)
            for (long j = 0; j <= i; ++j) *(i == j ? &on : &off) += a[i * n + j] * a[i * n + j];
        if (!(off > 1e-20 * on)) break;
        for (long p = 0; p < n; ++p)
            for (long q = p + 1; q < n; ++q) {
                double apart = a[q * n + q] - a[p * n + p], twice = 2 * a[p * n + q];
                if (twice == 0) continue;
                double t = copysign(1, apart) * twice / (fabs(apart) + sqrt(apart * apart + twice * twice));
                double c = 1 / sqrt(1 + t * t), s = t * c;
                for (long k = 0; k < n; ++k) {
                    double u = a[k * n + p], v = a[k * n + q];
                    a[k * n + p] = c * u - s * v, a[k * n + q] = s * u + c * v;
                }
                for (long k = 0; k < n; ++k) {
                    double u = a[p * n + k], v = a[q * n + k];
                    a[p * n + k] = c * u - s * v, a[q * n + k] = s * u + c * v;
                    u = vectors[p * n + k], v = vectors[q * n + k];
                    vectors[p * n + k] = c * u - s * v, vectors[q * n + k] = s * u + c * v;
                }
            }
    }
    for (long i = 0; i < n; ++i)
        for (long j = 0; j < n; ++j) {
            double sum = 0;
            for (long k = 0; k < n; ++k) sum += fabs(a[k * n + k]) * vectors[k * n + i] * vectors[k * n + j];
            h[i * n + j] = sum;
        }
}

/* The product of a row of the Jacobian, x's own rows included, with d. */
static double along(const Program *o, const double *jacobian, long row, const double *d) {
    if (row < o->n) return d[row];
    double sum = 0;
    for (long j = 0; j < o->n; ++j) sum += jacobian[j * o->m + row - o->n] * d[j];
    return sum;
}

static double entry(const Program *o, const double *jacobian, long row, long j) {
    return row < o->n ? row == j : jacobian[j * o->m + row - o->n];
}

/* Rows that a quadratic problem holds at their bounds. side: 1 at a lower bound, -1 at an upper one. pressure: of the
   rows, then of one that is to be held. normals, pulled: side times a row, and the inverse Hessian times that. */
typedef struct {
    long count, *rows;
    double *side, *pressure, *normals, *pulled;
} Held;

/* The row, not held, that d violates most; -1 where none is violated. */
static long most_violated(const Program *o, const Held *held, const double *jacobian, const double *value,
                          const double *d, double *side, double *excess) {
    long found = -1;
    *side = 0, *excess = ACTIVE;
    for (long row = 0; row < o->n + o->m; ++row) {
        int skip = 0;
        for (long k = 0; k < held->count; ++k) skip |= held->rows[k] == row;
        if (skip) continue;
        double at = value[row] + along(o, jacobian, row, d);
        if (o->lower[row] - at > *excess) found = row, *side = 1, *excess = o->lower[row] - at;
        if (at - o->upper[row] > *excess) found = row, *side = -1, *excess = at - o->upper[row];
    }
    return found;
}

/* What of a direction leaves held rows where they are, and how their pressures fall along it; 0 where held rows
   depend on each other. */
static int project(long n, const Held *held, double *direction, double *fall) {
    long count = held->count;
    double gram[n * n];
    for (long k = 0; k < count; ++k) {
        fall[k] = 0;
        for (long i = 0; i < n; ++i) fall[k] += held->normals[k * n + i] * direction[i];
        for (long l = 0; l <= k; ++l) {
            double sum = 0;
            for (long i = 0; i < n; ++i) sum += held->normals[k * n + i] * held->pulled[l * n + i];
            gram[l * count + k] = gram[k * count + l] = sum;
        }
    }
    if (count && !factor(count, gram)) return 0;
    solve(count, gram, fall);
    for (long k = 0; k < count; ++k)
        for (long i = 0; i < n; ++i) direction[i] -= held->pulled[k * n + i] * fall[k];
    return 1;
}

static void let_go(long n, Held *held, long k) {
    --held->count;
    for (; k < held->count; ++k) {
        held->rows[k] = held->rows[k + 1], held->side[k] = held->side[k + 1];
        held->pressure[k] = held->pressure[k + 1];
        memcpy(held->normals + k * n, held->normals + (k + 1) * n, n * sizeof(double));
        memcpy(held->pulled + k * n, held->pulled + (k + 1) * n, n * sizeof(double));
    }
    held->pressure[k] = held->pressure[k + 1];
}

/* Move d until a row is at its bound, which then is held; rows whose pressure vanishes on the way are let go. */
static int hold(const Program *o, Held *held, const double *factor, const double *jacobian, long row, double side,
                double excess, double *d) {
    long n = o->n;
    double *normal = held->normals + n * n, pulled[n], direction[n], fall[n];
    for (long j = 0; j < n; ++j) normal[j] = pulled[j] = side * entry(o, jacobian, row, j);
    solve(n, factor, pulled);
    held->pressure[held->count] = 0;
    for (;;) {
        double length = 0, part = INFINITY;
        long leaves = -1;
        memcpy(direction, pulled, sizeof pulled);
        if (!project(n, held, direction, fall)) return 0;
        for (long i = 0; i < n; ++i) length += direction[i] * normal[i];
        double whole = held->count < n && length > 1e-14 ? excess / length : INFINITY;
        for (long k = 0; k < held->count; ++k)
            if (fall[k] > 0 && o->lower[held->rows[k]] < o->upper[held->rows[k]] && held->pressure[k] / fall[k] < part)
                part = held->pressure[k] / fall[k], leaves = k;
        double step = part < whole ? part : whole;
        if (!(step < INFINITY)) return 0;
        for (long k = 0; k < held->count; ++k) held->pressure[k] -= step * fall[k];
        held->pressure[held->count] += step;
        if (whole < INFINITY) {
            for (long i = 0; i < n; ++i) d[i] += step * direction[i];
            excess -= step * length;
        }
        if (step == whole) break;
        let_go(n, held, leaves);
    }
    memcpy(held->normals + held->count * n, normal, n * sizeof(double));
    memcpy(held->pulled + held->count * n, pulled, sizeof pulled);
    held->rows[held->count] = row, held->side[held->count++] = side;
    return 1;
}

/* Goldfarb and Idnani's dual method: minimise d'hd/2 + gradient'd with all rows within their bounds.

   h: positive definite, lost. multipliers: of all rows. 0 where no d was found. */
static int quadratic(const Program *o, double *h, const double *gradient, const double *jacobian,
                     const double *value, double *d, double *multipliers) {
    long n = o->n, rows = n + o->m, kept[n], row;
    double sides[n], pressures[n + 1], normals[(n + 1) * n], pulled[n * n], side, excess;
    Held held = {0, kept, sides, pressures, normals, pulled};
    if (!factor(n, h)) return 0;
    for (long j = 0; j < n; ++j) d[j] = -gradient[j];
    solve(n, h, d);
    for (long left = 20 * (rows + 1); (row = most_violated(o, &held, jacobian, value, d, &side, &excess)) >= 0;)
        if (!left-- || !hold(o, &held, h, jacobian, row, side, excess, d)) return 0;
    for (row = 0; row < rows; ++row) multipliers[row] = 0;
    for (long k = 0; k < held.count; ++k) multipliers[kept[k]] = -sides[k] * pressures[k];
    return 1;
}

/* What rows leave their bounds by, each weighed by the penalty of its kind: x's own rows, then constraints. */
static double violation(const Program *o, const double *value, const double *penalty) {
    double sum = 0;
    for (long i = 0; i < o->n + o->m; ++i) {
        sum += penalty[i >= o->n] * most(o->lower[i] - value[i], 0);
        sum += penalty[i >= o->n] * most(value[i] - o->upper[i], 0);
    }
    return sum;
}

/* What is known of the problem at one x: its functions' results, and the values of all rows. */
typedef struct {
    double f, *gradient, *value, *jacobian, *hessian;
} Point;

/* Stationarity, infeasibility and complementarity, of the problem itself. */
static void judge(Program *o, const Point *point) {
    o->objective = point->f, o->kkt = o->violation = 0;
    for (long j = 0; j < o->n; ++j) {
        double slope = point->gradient[j] + o->multipliers[j];
        for (long i = 0; i < o->m; ++i) slope += point->jacobian[j * o->m + i] * o->multipliers[o->n + i];
        o->kkt = most(fabs(slope), o->kkt);
    }
    for (long i = 0; i < o->n + o->m; ++i) {
        double multiplier = o->multipliers[i], value = point->value[i];
        double slack = fabs((multiplier > 0 ? o->upper : o->lower)[i] - value);
        o->violation = most(most(o->lower[i] - value, value - o->upper[i]), o->violation);
        o->kkt = most(fabs(multiplier) * (slack < INFINITY ? slack : 1), o->kkt);
    }
    o->kkt = most(o->violation, o->kkt);
}

static void at(Program *o, Function function, Point *point) {
    double one = 1, *constraints = point->value + o->n;
    const double *arg[] = {o->x, o->p, &one, o->multipliers + o->n};
    double *values[] = {&point->f, constraints};
    double *all[] = {&point->f, point->gradient, constraints, point->jacobian, point->hessian};
    memcpy(point->value, o->x, o->n * sizeof *o->x);
    function(arg, function == o->value ? values : all, 0, 0, 0);
    ++*(function == o->expansion ? &o->expansions : &o->evaluations);
}

/* The Hessian as a matrix that a quadratic problem can have: exact where rows with multipliers stay active. */
static void prepare(const Program *o, const double *jacobian, const double *value, double *h) {
    long n = o->n;
    double kept[n * n], largest = 0;
    for (long i = 0; i < n; ++i) h[i * n + i] += DAMPING, largest = most(fabs(h[i * n + i]), largest);
    memcpy(kept, h, sizeof kept);
    if (factor(n, kept)) return;
    for (long row = 0; row < n + o->m; ++row) {
        double multiplier = o->multipliers[row], bound = (multiplier > 0 ? o->upper : o->lower)[row];
        if (multiplier == 0 || fabs(bound - value[row]) > 1e-6) continue;
        for (long i = 0; i < n; ++i)
            for (long j = 0; j < n; ++j)
                h[i * n + j] += HELD * largest * entry(o, jacobian, row, i) * entry(o, jacobian, row, j);
    }
    memcpy(kept, h, sizeof kept);
    if (factor(n, kept)) return;
    make_convex(n, h);
    for (long i = 0; i < n; ++i) h[i * n + i] += DAMPING * most(largest, 1);
}

static double largest(long n, const double *d) {
    double found = 0;
    for (long j = 0; j < n; ++j) found = most(fabs(d[j]), found);
    return found;
}

/* Go along d, and as far towards the next multipliers, until the l1 merit function falls enough; by how much it fell,
   -1 where it never does. The whole step is tried first, with the function given for it. */
static double search(Program *o, Point *point, Function whole, const double *d, const double *next, double merit,
                     double slope, const double *penalty, double *step) {
    long n = o->n, rows = n + o->m;
    double from[n], before[rows], size = largest(n, d);
    memcpy(from, o->x, sizeof from), memcpy(before, o->multipliers, sizeof before);
    *step = 1;
    for (int halvings = 0; halvings < MOST_HALVINGS; ++halvings, *step /= 2) {
        for (long j = 0; j < n; ++j) o->x[j] = from[j] + *step * d[j];
        double part = *step * size < STILL ? 1 : *step;
        for (long i = 0; i < rows; ++i) o->multipliers[i] = before[i] + part * (next[i] - before[i]);
        at(o, halvings ? o->value : whole, point);
        double found = point->f + violation(o, point->value, penalty);
        if (found <= merit + 1e-4 * *step * slope + 1e-12 * fabs(merit)) return most(merit - found, 0);
    }
    memcpy(o->x, from, sizeof from), memcpy(o->multipliers, next, sizeof before);
    return -1;
}

/* Penalties above all multipliers of their kind; larger ones of before fade, or steps along curved rows would stay
   short for good (Powell, Numerical Analysis, Lecture Notes in Mathematics 630, 1978). */
static void adapt(const Program *o, const double *multipliers, double *penalty) {
    double least[] = {0, 0};
    for (long i = 0; i < o->n + o->m; ++i) least[i >= o->n] = most(1.1 * fabs(multipliers[i]), least[i >= o->n]);
    for (int kind = 0; kind < 2; ++kind) penalty[kind] = most(least[kind], (least[kind] + penalty[kind]) / 2);
}

void sqp(Program *o) {
    long n = o->n, rows = n + o->m, calm = 0;
    double gradient[n], jacobian[n * o->m + 1], hessian[n * n], d[n], next[rows], penalty[] = {0, 0}, step;
    Point point = {0, gradient, o->rows, jacobian, hessian};
    Function known = o->expansion;
    o->expansions = o->evaluations = 0;
    at(o, known, &point);
    for (o->iterations = 0;; ++o->iterations) {
        judge(o, &point);
        o->status = o->kkt <= o->tolerance ? SOLVED : calm >= STALL ? STUCK : STOPPED;
        if (o->status != STOPPED || o->iterations == o->most) return;
        if (known != o->expansion) at(o, o->expansion, &point);
        prepare(o, jacobian, point.value, hessian);
        o->status = NO_STEP;
        if (!quadratic(o, hessian, gradient, jacobian, point.value, d, next)) return;
        double slope = 0, size = largest(n, d);
        for (long j = 0; j < n; ++j) slope += gradient[j] * d[j];
        adapt(o, next, penalty);
        double outside = violation(o, point.value, penalty), merit = point.f + outside;
        known = size < NEAR ? o->slopes : o->expansion;
        double fell = search(o, &point, known, d, next, merit, slope - outside, penalty, &step);
        calm = fell < 0 ? STALL : fell < STALLED * (1e-6 + fabs(merit)) ? calm + 1 : 0;
        if (fell >= 0 && step == 1) continue;
        known = fell >= 0 && step * size < NEAR ? o->slopes : o->expansion;
        at(o, known, &point);
    }
}
