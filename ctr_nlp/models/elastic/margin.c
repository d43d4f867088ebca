/* Stability margins of the elastic model; branch.c comes before this file. */

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

/* Whether a symmetric matrix less `shift` on its diagonal has positive pivots only. */
static int definite(const double *matrix, long n, double shift, double *a) {
    for (long j = 0; j < n; ++j) {
        for (long i = 0; i <= j; ++i) a[i + n * j] = matrix[i + n * j];
        a[j + n * j] -= shift;
    }
    for (long k = 0; k < n; ++k) {
        if (!(a[k + n * k] > 0)) return 0;
        for (long j = k + 1; j < n; ++j) {
            double part = a[k + n * j] / a[k + n * k];
            for (long i = k + 1; i <= j; ++i) a[i + n * j] -= part * a[k + n * i];
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

/* The smallest eigenvalue of a symmetric matrix (n, n), by Lanczos' method, confirmed by the pivots. */
static double smallest_eigenvalue(const double *matrix, long n, double *work) {
    double *restrict basis = work, *copy = basis + n * (n + 1), *diagonal = copy + n * n, *beside = diagonal + n, size = 0;
    double residual = 1e-7, found = 1;
    for (long i = 0; i < n; ++i) basis[i] = 0.2 + fmod(0.618033988749895 * (i + 1), 1.0), size += basis[i] * basis[i];
    for (long i = 0; i < n; ++i) basis[i] /= sqrt(size);
    for (long k = 0; k < n; ++k) {
        const double *v = basis + n * k;
        double *next = basis + n * (k + 1);
        memset(next, 0, n * sizeof *next);
        for (long j = 0; j < n; ++j)
            for (long i = 0; i < n; ++i) next[i] += matrix[i + n * j] * v[j];
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

/* The margin at every x, with steps in numbers from row to row: K is the identity in terms of scaled twists.

   work: room. */
void margins(const Elastic *e, const double *numbers, long step, const double *x, long rows, double *found,
             double *work) {
    long side = 2 * e->d + 2;
    double *weights = work, *scales = weights + e->rows, *row = scales + e->twists, *matrix = row + e->twists;
    for (long at = 0; at < rows; ++at, x += side, numbers += step) {
        const double *arg[] = {x, numbers};
        double *res[] = {weights, scales};
        long place[e->twists + 1], columns[e->twists + 1], n = 0;
        e->weights(arg, res, 0, 0, 0);
        for (long i = 0; i < e->twists; ++i) place[i] = scales[i] > 0 ? n++ : -1;
        memset(matrix, 0, n * n * sizeof *matrix);
        for (long i = 0; i < n; ++i) matrix[i + n * i] = 1;
        for (long r = 0; r < e->rows; ++r) {
            if (weights[r] == 0) continue;
            long count = 0;
            for (long k = e->starts[r]; k < e->starts[r + 1]; ++k) {
                long column = e->columns[k];
                if (place[column] < 0) continue;
                row[count] = e->entries[k] * scales[column], columns[count++] = place[column];
            }
            for (long j = 0; j < count; ++j) {
                double *into = matrix + n * columns[j], part = weights[r] * row[j];
                for (long i = 0; i <= j; ++i) into[columns[i]] += part * row[i];
            }
        }
        for (long j = 0; j < n; ++j)
            for (long i = 0; i < j; ++i) matrix[j + n * i] = matrix[i + n * j];
        found[at] = n ? fmin(1, smallest_eigenvalue(matrix, n, matrix + n * n)) : 1;
    }
}
