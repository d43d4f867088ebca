/* Sequential quadratic programming for one small dense problem; what it does is said in sqp.py.

   Rows: x itself, then the constraints. Functions are as CasADi calls them; matrices are stored column by column. */

#include <math.h>
#include <string.h>

#define MOST_ITERATIONS 60
#define MOST_HALVINGS 25
#define STALL 6          /* iterations that lower the merit by less than STALLED of it end the work */
#define STALLED 1e-13
#define NEAR 1e-3        /* a step as small as this may be the last: derivatives of first order tell */
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
    double *x, *multipliers;         /* where to start, and what was found */
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
    for (long i = 0; i < n; ++i) {
        for (long k = 0; k < i; ++k) b[i] -= factor[k * n + i] * b[k];
        b[i] /= factor[i * n + i];
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

/* Goldfarb and Idnani's dual method: minimise d'Hd/2 + gradient'd with all rows within their bounds.

   h: positive definite, lost. multipliers: of all rows. 0 where no d is feasible. */
static int quadratic(const Program *o, double *h, const double *gradient, const double *jacobian,
                     const double *value, double *d, double *multipliers) {
    long n = o->n, rows = n + o->m, held = 0, active[n];
    double side[n], u[n + 1], normals[n * n], pulled[n * n], inverse[n * n]; /* pulled: inverse times normals */
    if (!factor(n, h)) return 0;
    for (long j = 0; j < n; ++j) {
        for (long i = 0; i < n; ++i) inverse[j * n + i] = i == j;
        solve(n, h, inverse + j * n);
        d[j] = -gradient[j];
    }
    solve(n, h, d);
    for (long guard = 0; guard < 20 * rows + 20; ++guard) {
        long worst = -1;
        double sign = 0, excess = ACTIVE;
        for (long row = 0; row < rows; ++row) {
            int skip = 0;
            for (long k = 0; k < held; ++k) skip |= active[k] == row;
            double at = value[row] + along(o, jacobian, row, d);
            if (!skip && o->lower[row] - at > excess) worst = row, sign = 1, excess = o->lower[row] - at;
            if (!skip && at - o->upper[row] > excess) worst = row, sign = -1, excess = at - o->upper[row];
        }
        if (worst < 0) {
            for (long row = 0; row < rows; ++row) multipliers[row] = 0;
            for (long k = 0; k < held; ++k) multipliers[active[k]] = -side[k] * u[k];
            return 1;
        }
        double normal[n];
        for (long j = 0; j < n; ++j) normal[j] = sign * entry(o, jacobian, worst, j);
        u[held] = 0;
        for (;;) {
            double z[n], straight[n], r[n], gram[n * n], length = 0;
            for (long i = 0; i < n; ++i) {
                straight[i] = 0;
                for (long j = 0; j < n; ++j) straight[i] += inverse[j * n + i] * normal[j];
            }
            memcpy(z, straight, sizeof z);
            for (long k = 0; k < held; ++k) {
                r[k] = 0;
                for (long i = 0; i < n; ++i) r[k] += normals[k * n + i] * z[i];
                for (long l = 0; l <= k; ++l) {
                    double sum = 0;
                    for (long i = 0; i < n; ++i) sum += normals[k * n + i] * pulled[l * n + i];
                    gram[l * held + k] = gram[k * held + l] = sum;
                }
            }
            if (held) {
                if (!factor(held, gram)) return 0;
                solve(held, gram, r);
            }
            for (long k = 0; k < held; ++k)
                for (long i = 0; i < n; ++i) z[i] -= pulled[k * n + i] * r[k];
            for (long i = 0; i < n; ++i) length += z[i] * normal[i];
            double full = held < n && length > 1e-14 ? excess / length : INFINITY, part = INFINITY;
            long leaves = -1;
            for (long k = 0; k < held; ++k)
                if (r[k] > 0 && o->lower[active[k]] < o->upper[active[k]] && u[k] / r[k] < part)
                    part = u[k] / r[k], leaves = k;
            double step = part < full ? part : full;
            if (!(step < INFINITY)) return 0;
            for (long k = 0; k < held; ++k) u[k] -= step * r[k];
            u[held] += step;
            if (full < INFINITY) {
                for (long i = 0; i < n; ++i) d[i] += step * z[i];
                excess -= step * length;
            }
            if (step == full) {
                active[held] = worst, side[held] = sign;
                memcpy(normals + held * n, normal, sizeof normal);
                memcpy(pulled + held * n, straight, sizeof straight);
                ++held;
                break;
            }
            --held;
            for (long k = leaves; k < held; ++k) {
                active[k] = active[k + 1], side[k] = side[k + 1], u[k] = u[k + 1];
                memcpy(normals + k * n, normals + (k + 1) * n, sizeof normal);
                memcpy(pulled + k * n, pulled + (k + 1) * n, sizeof normal);
            }
            u[held] = u[held + 1];
        }
    }
    return 0;
}

static double violation(const Program *o, const double *value) {
    double sum = 0;
    for (long i = 0; i < o->n + o->m; ++i) {
        sum += most(o->lower[i] - value[i], 0);
        sum += most(value[i] - o->upper[i], 0);
    }
    return sum;
}

/* Stationarity, infeasibility and complementarity, of the problem itself. */
static void judge(Program *o, double objective, const double *gradient, const double *jacobian, const double *value) {
    o->objective = objective, o->kkt = o->violation = 0;
    for (long j = 0; j < o->n; ++j) {
        double slope = gradient[j] + o->multipliers[j];
        for (long i = 0; i < o->m; ++i) slope += jacobian[j * o->m + i] * o->multipliers[o->n + i];
        o->kkt = most(fabs(slope), o->kkt);
    }
    for (long i = 0; i < o->n + o->m; ++i) {
        double multiplier = o->multipliers[i], slack = fabs((multiplier > 0 ? o->upper : o->lower)[i] - value[i]);
        o->violation = most(most(o->lower[i] - value[i], value[i] - o->upper[i]), o->violation);
        o->kkt = most(fabs(multiplier) * (slack < INFINITY ? slack : 1), o->kkt);
    }
    o->kkt = most(o->violation, o->kkt);
}

static void at(Program *o, Function function, const double *x, double *f, double *gradient, double *value,
               double *jacobian, double *hessian) {
    double one = 1;
    const double *arg[] = {x, o->p, &one, o->multipliers + o->n};
    double *values[] = {f, value + o->n}, *all[] = {f, gradient, value + o->n, jacobian, hessian};
    memcpy(value, x, o->n * sizeof *x);
    function(arg, function == o->value ? values : all, 0, 0, 0);
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

void sqp(Program *o) {
    long n = o->n, rows = n + o->m, calm = 0;
    double f, gradient[n], value[rows], jacobian[n * o->m + 1], hessian[n * n];
    double d[n], next[rows], to[n], penalty = 0, small = INFINITY;
    o->status = STOPPED, o->expansions = o->evaluations = 0;
    for (o->iterations = 0;; ++o->iterations) {
        if (small < NEAR) {
            at(o, o->slopes, o->x, &f, gradient, value, jacobian, 0), ++o->evaluations;
            judge(o, f, gradient, jacobian, value);
            if (o->kkt <= o->tolerance) { o->status = SOLVED; return; }
        }
        at(o, o->expansion, o->x, &f, gradient, value, jacobian, hessian), ++o->expansions;
        judge(o, f, gradient, jacobian, value);
        if (o->kkt <= o->tolerance) { o->status = SOLVED; return; }
        if (o->iterations == MOST_ITERATIONS) return;
        if (calm >= STALL) { o->status = STUCK; return; }
        prepare(o, jacobian, value, hessian);
        if (!quadratic(o, hessian, gradient, jacobian, value, d, next)) { o->status = NO_STEP; return; }
        double slope = 0, outside = violation(o, value);
        for (long j = 0; j < n; ++j) slope += gradient[j] * d[j];
        for (long i = 0; i < rows; ++i) penalty = most(1.1 * fabs(next[i]), penalty);
        double merit = f + penalty * outside, step = 1, found = INFINITY, tried[rows];
        slope -= penalty * outside;
        int halvings = 0;
        for (; halvings < MOST_HALVINGS; ++halvings, step /= 2) {
            for (long j = 0; j < n; ++j) to[j] = o->x[j] + step * d[j];
            at(o, o->value, to, &found, 0, tried, 0, 0), ++o->evaluations;
            found += penalty * violation(o, tried);
            if (found <= merit + 1e-4 * step * slope + 1e-12 * fabs(merit)) break;
        }
        if (halvings == MOST_HALVINGS) { memcpy(o->multipliers, next, sizeof next); calm = STALL; small = INFINITY; continue; }
        calm = merit - found < STALLED * (1e-6 + fabs(merit)) ? calm + 1 : 0;
        small = 0;
        for (long j = 0; j < n; ++j) small = most(fabs(to[j] - o->x[j]), small), o->x[j] = to[j];
        for (long i = 0; i < rows; ++i) o->multipliers[i] += step * (next[i] - o->multipliers[i]);
    }
}
