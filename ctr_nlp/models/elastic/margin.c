/* The elastic model's energy and its stability margins; branch.c comes before this file. */

#include <stdlib.h>

/* The smallest root of the characteristic polynomial of a tridiagonal matrix, by Laguerre's method from the left. */
static double smallest_root(const double *diagonal, const double *beside, long n) {
    double x = diagonal[0];
    for (long i = 0; i < n; ++i) {
        double low = diagonal[i] - (i ? fabs(beside[i - 1]) : 0) - (i < n - 1 ? fabs(beside[i]) : 0);
        if (low < x) x = low;
    }
    x -= 1e-9 * (1 + fabs(x));
    for (int k = 0; k < 60; ++k) {
        double p = diagonal[0] - x, slope = -1, bend = 0, first = slope / p, second = first * first;
        for (long i = 1; i < n && p > 0; ++i) {
            double part = beside[i - 1] * beside[i - 1] / (p * p);
            bend = part * (bend - 2 * slope * slope / p), slope = -1 + part * slope;
            p = diagonal[i] - x - part * p;
            first += slope / p, second += slope * slope / (p * p) - bend / p;
        }
        if (!(p > 0)) return x;
        double step = n / (-first + sqrt(fmax(0, (n - 1) * (n * second - first * first))));
        x += step;
        if (!(step > 1e-14 * (1 + fabs(x)))) return x;
    }
    return x;
}

/* Whether a symmetric matrix less `shift` on its diagonal has positive pivots only; a: its rows from the diagonal on,
   eliminated. */
static int definite(const double *matrix, long n, double shift, double *restrict a) {
    for (long i = 0; i < n; ++i) {
        for (long j = i; j < n; ++j) a[n * i + j] = matrix[n * i + j];
        a[n * i + i] -= shift;
    }
    for (long k = 0; k < n; ++k) {
        const double *pivot = a + n * k;
        if (!(pivot[k] > 0)) return 0;
        double inverse = 1 / pivot[k];
        for (long i = k + 1; i < n; ++i) {
            double part = pivot[i] * inverse, *restrict row = a + n * i;
#pragma omp simd
            for (long j = i; j < n; ++j) row[j] -= part * pivot[j];
        }
    }
    return 1;
}

/* Of two vectors; in four sums, which processors take side by side. */
static double product(const double *a, const double *b, long n) {
    double sums[4] = {0};
    long i = 0;
    for (; i + 4 <= n; i += 4)
        for (int l = 0; l < 4; ++l) sums[l] += a[i + l] * b[i + l];
    for (; i < n; ++i) sums[0] += a[i] * b[i];
    return sums[0] + sums[1] + sums[2] + sums[3];
}

/* A matrix (n, n) times a vector. */
static void times(const double *restrict matrix, long n, const double *v, double *restrict found) {
    memset(found, 0, n * sizeof *found);
    for (long j = 0; j < n; ++j) {
        double part = v[j];
#pragma omp simd
        for (long i = 0; i < n; ++i) found[i] += matrix[i + n * j] * part;
    }
}

/* The smallest eigenvalue of a symmetric matrix (n, n), by Lanczos' method, confirmed by the pivots. */
static double smallest_eigenvalue(const double *matrix, long n, double *work) {
    double *restrict basis = work, *copy = basis + n * (n + 1), *diagonal = copy + n * n, *beside = diagonal + n, size = 0;
    double residual = 1e-7, found = 1;
    for (long i = 0; i < n; ++i) basis[i] = 0.2 + fmod(0.618033988749895 * (i + 1), 1.0), size += basis[i] * basis[i];
    for (long i = 0; i < n; ++i) basis[i] /= sqrt(size);
    for (long k = 0; k < n; ++k) {
        const double *v = basis + n * k;
        double *next = basis + n * (k + 1);
        times(matrix, n, v, next);
        for (long j = k; j >= 0; --j) {
            double part = product(basis + n * j, next, n);
            for (long i = 0; i < n; ++i) next[i] -= part * basis[i + n * j];
            if (j == k) diagonal[k] = part;
        }
        beside[k] = sqrt(product(next, next, n));
        int last = k == n - 1 || beside[k] < 1e-13;
        if (k > 3 || last) {
            found = smallest_root(diagonal, beside, k + 1);
            double before = 0, here = 1, norm = 1;
            for (long i = 0; i < k; ++i) {
                double ahead = ((found - diagonal[i]) * here - (i ? beside[i - 1] * before : 0)) / beside[i];
                before = here, here = ahead, norm += ahead * ahead;
            }
            if (last) return found;
            if (beside[k] * fabs(here) < residual * sqrt(norm)) {
                if (definite(matrix, n, found - 1e-9 * (1 + fabs(found)), copy)) return found;
                residual *= 1e-3;
            }
        }
        for (long i = 0; i < n; ++i) next[i] /= beside[k];
    }
    return found;
}

/* Solve for v in place, with what `definite` leaves of a matrix, and make its length one. */
static void inverted(const double *a, long n, double *v) {
    double size = 0;
    for (long k = 0; k < n; ++k) {
        double part = v[k] / a[n * k + k];
        for (long i = k + 1; i < n; ++i) v[i] -= part * a[n * k + i];
    }
    for (long k = n - 1; k >= 0; --k) {
        for (long i = k + 1; i < n; ++i) v[k] -= a[n * k + i] * v[i];
        v[k] /= a[n * k + k], size += v[k] * v[k];
    }
    for (long i = 0; i < n; ++i) v[i] /= sqrt(size);
}

enum { REFINEMENTS = 6 };

/* The smallest eigenvalue by inverse iteration from v, that of a matrix nearby, to 1e-8 by the pivots; NaN where v is
   not near. An eigenvalue is no further from the quotient of v than v's residual, which bounds the shift. */
static double refined(const double *matrix, long n, double *v, double *work) {
    double *product_of = work + n * n;
    for (int k = 0; k < REFINEMENTS; ++k) {
        times(matrix, n, v, product_of);
        double quotient = product(v, product_of, n), residual = 0;
        for (long i = 0; i < n; ++i) residual += pow(product_of[i] - quotient * v[i], 2);
        residual = sqrt(residual);
        if (residual < 1e-7) return definite(matrix, n, quotient - 1e-8 * (1 + fabs(quotient)), work) ? quotient : NAN;
        if (!(residual < 0.3) || !definite(matrix, n, quotient - residual, work)) return NAN;
        inverted(work, n, v);
    }
    return NAN;
}

/* The energy at one beta, of a robot whose twists are a in terms of the n scaled ones that are there: |a|^2 / 2 less
   the strengths times the cosines of angles, which the twists in columns turn by turns. row, rows, work: room. */
typedef struct {
    long n, *begins, *columns, *places;
    double *strengths, *angles, *turns, *scales, *matrix, *row, *rows, *work;
    void *room;
} Energy;

static Energy energy_for(const Elastic *e) {
    long rows = e->rows, n = e->twists, entries = e->starts[rows], work = 3 * n * n + 9 * n + 2 * rows;
    Energy of;
    of.room = malloc((rows + 1 + entries + n) * sizeof(long) + (5 * rows + entries + 3 * n + n * n + work) * sizeof(double));
    of.begins = of.room, of.columns = of.begins + rows + 1, of.places = of.columns + entries;
    of.strengths = (double *)(of.places + n), of.angles = of.strengths + rows, of.turns = of.angles + rows;
    of.scales = of.turns + entries, of.matrix = of.scales + n, of.row = of.matrix + n * n;
    of.rows = of.row + n, of.work = of.rows + 3 * rows + n;
    return of;
}

/* The strengths and turns at the beta of x, and the angles there. */
static void described(const Elastic *e, const double *numbers, const double *x, Energy *of) {
    const double *arg[] = {x, numbers};
    double *res[] = {of->strengths, of->angles, of->scales};
    long count = 0;
    e->energy(arg, res, 0, 0, 0);
    of->n = 0;
    for (long i = 0; i < e->twists; ++i) of->places[i] = of->scales[i] > 0 ? of->n++ : -1;
    for (long r = 0; r < e->rows; ++r) {
        of->begins[r] = count;
        for (long k = e->starts[r]; of->strengths[r] != 0 && k < e->starts[r + 1]; ++k) {
            long twist = e->columns[k];
            if (of->places[twist] < 0) continue;
            of->turns[count] = e->entries[k] * of->scales[twist], of->columns[count++] = of->places[twist];
        }
    }
    of->begins[e->rows] = count;
}

/* The second variation K + V at angles, in which K is the identity. */
static void bent(const Elastic *e, const Energy *of, const double *angles) {
    long n = of->n;
    double *restrict row = of->row;
    memset(of->matrix, 0, n * n * sizeof *row);
    for (long i = 0; i < n; ++i) of->matrix[i + n * i] = 1;
    for (long r = 0; r < e->rows; ++r) {
        long begin = of->begins[r], end = of->begins[r + 1];
        double weight = begin < end ? of->strengths[r] * cos(angles[r]) : 0;
        for (long i = 0; i < n; ++i) row[i] = 0;
        for (long k = begin; k < end; ++k) row[of->columns[k]] = of->turns[k];
        for (long k = begin; k < end; ++k) {
            double *restrict into = of->matrix + n * of->columns[k], part = weight * of->turns[k];
#pragma omp simd
            for (long i = 0; i < n; ++i) into[i] += part * row[i];
        }
    }
}

static double margin_at(const Elastic *e, const double *numbers, const double *x, Energy *of) {
    described(e, numbers, x, of);
    bent(e, of, of->angles);
    return of->n ? fmin(1, smallest_eigenvalue(of->matrix, of->n, of->work)) : 1;
}

/* The margin at every x, with steps in numbers from row to row. Rows that follow each other are likely near each other,
   and so are the vectors of their margins. */
void margins(const Elastic *e, const double *numbers, long step, const double *x, long rows, double *found) {
    Energy of = energy_for(e);
    long before = 0;
    double vector[e->twists + 1];
    for (long at = 0; at < rows; ++at, x += 2 * e->d + 2, numbers += step) {
        described(e, numbers, x, &of);
        bent(e, &of, of.angles);
        long n = of.n;
        double least = n && n == before ? refined(of.matrix, n, vector, of.work) : NAN;
        if (n && isnan(least)) {
            least = smallest_eigenvalue(of.matrix, n, of.work);
            before = definite(of.matrix, n, least - 1e-6 * (1 + fabs(least)), of.work) ? n : 0;
            for (long i = 0; i < n; ++i) vector[i] = 0.2 + fmod(0.618033988749895 * (i + 1), 1.0);
            if (before) inverted(of.work, n, vector);
        }
        found[at] = n ? fmin(1, least) : 1;
    }
    free(of.room);
}

static int holds(const Elastic *e, const double *numbers, const double *x) {
    Energy of = energy_for(e);
    double margin = margin_at(e, numbers, x, &of);
    free(of.room);
    return margin > 0;
}
