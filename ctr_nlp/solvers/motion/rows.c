/* The loops of rows.py over the rows of a chain. Rows: x itself, the frames' constraints, the links.

   Frames' blocks are as CasADi leaves them, column by column. The links' matrix is stored by rows; its columns, in
   order, are the rows before the links, so that links may pass through constraints. */

#include <math.h>

#define LEFT 0.01 /* the part of every distance to a bound that a step leaves */

typedef struct {
    double *x, *slack, *at_lower, *at_upper; /* (T n), then (rows) each */
} Point;

typedef struct {
    long frames, unknowns, constraints, links, width;
    long bent, curved;             /* whether links pass through constraints; whether these are not linear */
    const double *lower, *upper;   /* of rows, as given */
    const double *low, *high;      /* of slacks; far away where there is none */
    const double *free;            /* (T n): 1, or 0 where x is fixed */
    const int *starts, *columns;   /* of the links' matrix */
    const double *entries, *offset, *weight;
    const double *gradient, *jacobian; /* of the frames at the point */
    double *slope, *value;         /* of the whole objective, with room for constraints behind, and of the rows */
    double *band, *right;          /* the Newton system, its lower band column by column, and then its solution */
    double *rows;                  /* room for one number a row */
    double *per_lower, *per_upper; /* of rows: one over the distance of their slack to its bound */
    Point at, step, trial;
} Chain;

static long size(const Chain *c) { return c->frames * c->unknowns; }
static long before_links(const Chain *c) { return size(c) + c->frames * c->constraints; }
static long all_rows(const Chain *c) { return before_links(c) + c->links; }
static double most(double a, double b) { return a > b ? a : b; } /* one instruction; fmax is a call */
static double least(double a, double b) { return a < b ? a : b; }
static double worst(double a, double b) { return a > b || a != a ? a : b; } /* what is no number stays */

/* result = x, the frames' Jacobian times x, the links times x */
static void times(const Chain *c, const double *x, double *result) {
    long n = c->unknowns, m = c->constraints, of_x = size(c), row = of_x;
    for (long i = 0; i < of_x; ++i) result[i] = x[i];
    for (long k = 0; k < c->frames; ++k)
        for (long i = 0; i < m; ++i, ++row) {
            double sum = 0;
            for (long j = 0; j < n; ++j) sum += c->jacobian[(k * n + j) * m + i] * x[k * n + j];
            result[row] = sum;
        }
    for (long i = 0; i < c->links; ++i, ++row) {
        double sum = 0;
        for (int e = c->starts[i]; e < c->starts[i + 1]; ++e) sum += c->entries[e] * result[c->columns[e]];
        result[row] = sum;
    }
}

/* result += the frames' transposed Jacobian times constraints */
static void add_pulls(const Chain *c, const double *constraints, double *result) {
    long n = c->unknowns, m = c->constraints;
    for (long k = 0; k < c->frames * n; ++k)
        for (long i = 0; i < m; ++i) result[k] += c->jacobian[k * m + i] * constraints[k / n * m + i];
}

/* result (T n) += the transposed Jacobian of all rows times rows; it has room for constraints behind */
static void add_transposed(const Chain *c, const double *rows, double *result) {
    long of_x = size(c), to_links = before_links(c);
    for (long i = 0; i < of_x; ++i) result[i] += rows[i];
    for (long i = of_x; i < to_links; ++i) result[i] = 0;
    add_pulls(c, rows + of_x, result);
    for (long i = 0; i < c->links; ++i)
        for (int e = c->starts[i]; e < c->starts[i + 1]; ++e)
            result[c->columns[e]] += c->entries[e] * rows[to_links + i];
    if (c->bent) add_pulls(c, result + of_x, result);
}

/* Values of all rows at x; returns the objective. f, g: of the frames there. */
static double evaluate(const Chain *c, const double *x, const double *f, const double *g) {
    long of_x = size(c), to_links = before_links(c);
    double objective = 0;
    for (long k = 0; k < c->frames; ++k) objective += f[k];
    for (long i = 0; i < of_x; ++i) c->value[i] = x[i];
    for (long i = of_x; i < to_links; ++i) c->value[i] = g[i - of_x];
    for (long i = 0; i < c->links; ++i) {
        double linked = c->offset[i];
        for (int e = c->starts[i]; e < c->starts[i + 1]; ++e) linked += c->entries[e] * c->value[c->columns[e]];
        c->value[to_links + i] = linked;
        objective += c->weight[i] * linked * linked;
    }
    return objective;
}

/* Measures of the point, whose frames have been expanded. */
void assess(const Chain *c, const double *f, const double *g, double *objective, double *violation, double *gap,
            double *stationarity, double *smallest, double *largest) {
    long of_x = size(c), to_links = before_links(c), rows = all_rows(c);
    const Point *at = &c->at;
    *objective = evaluate(c, at->x, f, g);
    *violation = -INFINITY, *gap = *stationarity = *largest = 0, *smallest = INFINITY;
    for (long i = 0; i < of_x; ++i) c->slope[i] = c->gradient[i];
    for (long i = of_x; i < to_links; ++i) c->slope[i] = 0;
    for (long i = 0; i < c->links; ++i)
        for (int e = c->starts[i]; e < c->starts[i + 1]; ++e)
            c->slope[c->columns[e]] += c->entries[e] * 2 * c->weight[i] * c->value[to_links + i];
    if (c->bent) add_pulls(c, c->slope + of_x, c->slope);
    for (long i = 0; i < rows; ++i) {
        double value = c->value[i], slack = at->slack[i];
        double lower = at->at_lower[i] * (slack - c->low[i]), upper = at->at_upper[i] * (c->high[i] - slack);
        *violation = worst(most(c->lower[i] - value, value - c->upper[i]), *violation);
        *gap = worst(fabs(value - slack), *gap);
        *smallest = least(least(lower, upper), *smallest);
        *largest = worst(most(lower, upper), *largest);
        c->rows[i] = at->at_upper[i] - at->at_lower[i];
    }
    double *slope = c->right;
    for (long i = 0; i < of_x; ++i) slope[i] = c->slope[i];
    add_transposed(c, c->rows, slope);
    for (long i = 0; i < of_x; ++i) *stationarity = worst(c->free[i] * fabs(slope[i]), *stationarity);
}

/* The Jacobian of a link that passes through constraints, from the first unknown on that it may reach; returns how
   many entries it has, at most width + 1. */
static long through_constraints(const Chain *c, long link, double *row, long *first) {
    long n = c->unknowns, m = c->constraints, of_x = size(c), end = 0;
    *first = of_x;
    for (int e = c->starts[link]; e < c->starts[link + 1]; ++e) {
        long column = c->columns[e], constraint = column - of_x;
        long start = constraint < 0 ? column : constraint / m * n, count = constraint < 0 ? 1 : n;
        if (start < *first) *first = start;
        if (start + count > end) end = start + count;
    }
    for (long i = 0; i < end - *first; ++i) row[i] = 0;
    for (int e = c->starts[link]; e < c->starts[link + 1]; ++e) {
        long constraint = c->columns[e] - of_x, start = constraint / m * n;
        if (constraint < 0)
            row[c->columns[e] - *first] += c->entries[e];
        else
            for (long j = start; j < start + n; ++j)
                row[j - *first] += c->entries[e] * c->jacobian[j * m + constraint % m];
    }
    return end - *first;
}

/* band += weight times the square of a link's Jacobian */
static void add_square(const Chain *c, long link, double weight, double *band) {
    long high = c->width + 1, first, count = c->starts[link + 1] - c->starts[link];
    const int *columns = c->columns + c->starts[link];
    const double *entries = c->entries + c->starts[link];
    if (count == 0 || columns[count - 1] < size(c)) {
        for (long a = 0; a < count; ++a)
            for (long b = 0; b <= a; ++b)
                band[columns[b] * high + columns[a] - columns[b]] += weight * entries[a] * entries[b];
        return;
    }
    double row[high];
    count = through_constraints(c, link, row, &first);
    for (long b = 0; b < count; ++b) {
        double *column = band + (first + b) * high;
        for (long a = b; a < count; ++a) column[a - b] += weight * row[a] * row[b];
    }
}

/* The Newton system of a barrier problem about a point, without slacks and multipliers; hessian is the frames'. */
void assemble(const Chain *c, const double *hessian, double barrier, double damping) {
    long n = c->unknowns, m = c->constraints, of_x = size(c), to_links = before_links(c), rows = all_rows(c);
    long high = c->width + 1;
    double *restrict band = c->band, *restrict right = c->right, *restrict sigma = c->step.slack;
    double *restrict push = c->rows, *restrict per_lower = c->per_lower, *restrict per_upper = c->per_upper;
    const double *restrict slack = c->at.slack, *restrict low = c->low, *restrict up = c->high;
    const double *restrict at_lower = c->at.at_lower, *restrict at_upper = c->at.at_upper;
    const double *restrict value = c->value;
    for (long i = 0; i < rows; ++i) {
        per_lower[i] = 1 / (slack[i] - low[i]), per_upper[i] = 1 / (up[i] - slack[i]);
        sigma[i] = at_lower[i] * per_lower[i] + at_upper[i] * per_upper[i];
        push[i] = barrier * (per_upper[i] - per_lower[i]) + sigma[i] * (value[i] - slack[i]);
    }
    for (long i = 0; i < of_x; ++i) right[i] = c->slope[i];
    add_transposed(c, push, right);
    for (long i = 0; i < of_x * high; ++i) band[i] = 0;
    for (long k = 0; k < of_x; ++k) {
        long frame = k / n, j = k % n;
        band[k * high] = sigma[k] + damping;
        for (long i = j; i < n; ++i) {
            const double *first = c->jacobian + (frame * n + i) * m, *second = c->jacobian + k * m;
            double sum = hessian[k * n + i];
            for (long row = 0; row < m; ++row) sum += sigma[of_x + frame * m + row] * first[row] * second[row];
            band[k * high + i - j] += sum;
        }
    }
    for (long i = 0; i < c->links; ++i) add_square(c, i, 2 * c->weight[i] + sigma[to_links + i], band);
    for (long k = 0; k < of_x; ++k) {
        right[k] = -right[k];
        if (c->free[k]) continue;
        for (long i = 0; i < high; ++i) band[k * high + i] = 0;
        for (long i = 1; i < high && i <= k; ++i) band[(k - i) * high + i] = 0;
        band[k * high] = 1, right[k] = 0;
    }
}

/* Cholesky's factors take the place of the band, and the solution that of the right side; 0 where the matrix is not
   positive definite. */
int solve(const Chain *c) {
    long of_x = size(c), high = c->width + 1;
    double *right = c->right;
    for (long k = 0; k < of_x; ++k) {
        long below = of_x - k < high ? of_x - k : high;
        double *column = c->band + k * high;
        if (!(column[0] > 0)) return 0;
        double scale = 1 / sqrt(column[0]);
        for (long i = 0; i < below; ++i) column[i] *= scale;
        right[k] *= scale;
        for (long i = 1; i < below; ++i) {
            double *later = column + i * high;
            for (long j = i; j < below; ++j) later[j - i] -= column[i] * column[j];
            right[k + i] -= column[i] * right[k];
        }
    }
    for (long k = of_x - 1; k >= 0; --k) {
        long below = of_x - k < high ? of_x - k : high;
        const double *column = c->band + k * high;
        for (long i = 1; i < below; ++i) right[k] -= column[i] * right[k + i];
        right[k] /= column[0];
    }
    return 1;
}

/* The whole step from its x, which stands in `right`: its slacks and multipliers, the largest multiplier after it,
   how much of it keeps slacks and multipliers positive, and the merit's slope along it less the penalty's part. */
void complete(const Chain *c, double barrier, double *multiplier, double *primal, double *dual, double *slope,
              double *gap) {
    long of_x = size(c), rows = all_rows(c);
    const Point *at = &c->at, *step = &c->step;
    double most_primal = 1 - LEFT, most_dual = 1 - LEFT;
    *multiplier = *slope = *gap = 0;
    for (long i = 0; i < of_x; ++i) {
        step->x[i] = c->right[i];
        *slope += c->slope[i] * step->x[i];
    }
    times(c, step->x, step->slack);
    for (long i = 0; i < rows; ++i) {
        double residual = c->value[i] - at->slack[i], slack = step->slack[i] + residual;
        double per_lower = c->per_lower[i], per_upper = c->per_upper[i];
        double lower = (barrier - at->at_lower[i] * slack) * per_lower - at->at_lower[i];
        double upper = (barrier + at->at_upper[i] * slack) * per_upper - at->at_upper[i];
        step->slack[i] = slack, step->at_lower[i] = lower, step->at_upper[i] = upper;
        *multiplier = worst(fabs(at->at_upper[i] + upper - at->at_lower[i] - lower), *multiplier);
        most_primal = most(most_primal, most(-slack * per_lower, slack * per_upper));
        most_dual = most(most_dual, most(-lower / at->at_lower[i], -upper / at->at_upper[i]));
        *slope += barrier * (per_upper - per_lower) * slack;
        *gap += fabs(residual);
    }
    *primal = (1 - LEFT) / most_primal, *dual = (1 - LEFT) / most_dual;
}

/* The trial becomes the point. */
void accept_trial(Chain *c) {
    Point before = c->at;
    c->at = c->trial;
    c->trial = before;
}

/* trial = at + parts of the step, with slacks within their bounds */
void advance_trial(const Chain *c, double primal, double dual) {
    long of_x = size(c), rows = all_rows(c);
    const Point *at = &c->at, *step = &c->step, *to = &c->trial;
    for (long i = 0; i < of_x; ++i) to->x[i] = at->x[i] + primal * step->x[i];
    for (long i = 0; i < rows; ++i) {
        double margin = 1e-14 * (1 + least(fabs(c->low[i]), fabs(c->high[i])));
        double slack = at->slack[i] + primal * step->slack[i];
        to->slack[i] = least(most(slack, c->low[i] + margin), c->high[i] - margin);
        to->at_lower[i] = at->at_lower[i] + dual * step->at_lower[i];
        to->at_upper[i] = at->at_upper[i] + dual * step->at_upper[i];
    }
}

/* The trial's slacks become the values that rows have, where these keep as far from bounds as a step must. */
static void settle(const Chain *c) {
    for (long i = 0; i < all_rows(c); ++i) {
        double value = c->value[i], slack = c->at.slack[i], low = c->low[i], high = c->high[i];
        if (value - low >= LEFT * (slack - low) && high - value >= LEFT * (high - slack)) c->trial.slack[i] = value;
    }
}

/* The l1 merit function of a barrier problem at the point or the trial; f, g: of the frames there. */
double merit(const Chain *c, int of_trial, const double *f, const double *g, double barrier, double penalty) {
    long rows = all_rows(c);
    const Point *at = of_trial ? &c->trial : &c->at;
    double objective = evaluate(c, at->x, f, g), logs = 0, product = 1, gap = 0;
    if (of_trial && c->curved) settle(c);
    for (long i = 0; i < rows; ++i) {
        product *= (at->slack[i] - c->low[i]) * (c->high[i] - at->slack[i]);
        if (i % 4 == 3 || i == rows - 1) logs += log(product), product = 1;
        gap += fabs(c->value[i] - at->slack[i]);
    }
    return objective - barrier * logs + penalty * gap;
}

/* Frames' Hessians with the absolute values of their eigenvalues, by Jacobi's rotations, LANES frames at once. */

#define LANES 8
#define EACH for (int l = 0; l < LANES; ++l)
#define SWEEPS 12
typedef double V __attribute__((vector_size(8 * LANES)));
typedef long long M __attribute__((vector_size(8 * LANES)));

static V root(V a) {
    V r = a;
    EACH r[l] = sqrt(a[l]);
    return r;
}
static V magnitude(V a) { return (V)((M)a & 0x7fffffffffffffffLL); }

static void rotate(V *a, V *b, V cosine, V sine) {
    V before = *a;
    *a = cosine * before - sine * *b;
    *b = sine * before + cosine * *b;
}

/* a becomes diagonal, and vectors a v of what it was */
static void diagonalise(long n, V a[n][n], V vectors[n][n]) {
    for (int sweep = 0; sweep < SWEEPS; ++sweep) {
        V off = {0}, on = {0};
        for (long p = 0; p < n; ++p) {
            on += a[p][p] * a[p][p];
            for (long q = p + 1; q < n; ++q) off += a[p][q] * a[p][q];
        }
        int done = 1;
        EACH done &= !(off[l] > 1e-18 * on[l]);
        if (done) return;
        for (long p = 0; p < n; ++p)
            for (long q = p + 1; q < n; ++q) {
                V apart = a[q][q] - a[p][p], twice = 2 * a[p][q];
                V side = (V)(((M)apart & (-0x7fffffffffffffffLL - 1)) | (M)((V){} + 1.0));
                V tangent = side * twice / (magnitude(apart) + root(apart * apart + twice * twice) + 1e-300);
                V cosine = 1 / root(1 + tangent * tangent), sine = tangent * cosine;
                a[p][p] -= tangent * a[p][q];
                a[q][q] += tangent * a[p][q];
                a[p][q] = (V){};
                for (long k = 0; k < p; ++k) rotate(&a[k][p], &a[k][q], cosine, sine);
                for (long k = p + 1; k < q; ++k) rotate(&a[p][k], &a[k][q], cosine, sine);
                for (long k = q + 1; k < n; ++k) rotate(&a[p][k], &a[q][k], cosine, sine);
                for (long k = 0; k < n; ++k) rotate(&vectors[p][k], &vectors[q][k], cosine, sine);
            }
    }
}

void convex(long frames, long n, const double *hessian, double *result) {
    for (long first = 0; first < frames; first += LANES) {
        V a[n][n], vectors[n][n];
        for (long i = 0; i < n; ++i)
            for (long j = 0; j < n; ++j) {
                EACH a[i][j][l] = hessian[((first + l < frames ? first + l : first) * n + i) * n + j];
                vectors[i][j] = (V){} + (i == j);
            }
        diagonalise(n, a, vectors);
        for (long i = 0; i < n; ++i)
            for (long j = 0; j <= i; ++j) {
                V sum = {0};
                for (long k = 0; k < n; ++k) sum += magnitude(a[k][k]) * vectors[k][i] * vectors[k][j];
                EACH if (first + l < frames) {
                    double *block = result + (first + l) * n * n;
                    block[i * n + j] = block[j * n + i] = sum[l];
                }
            }
    }
}
