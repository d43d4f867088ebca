/* The elastic model's stability margins; branch.c comes before this file. */

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

/* The smallest eigenvalue of a symmetric matrix (n, n), which is lost: it is made tridiagonal by Householder's
   reflections. */
static double smallest_eigenvalue(double *restrict a, long n) {
    double diagonal[n], beside[n], v[n], pulled[n];
    for (long k = 0; k < n; ++k) {
        double *row = a + n * k, size = 0, part = 0;
        diagonal[k] = row[k];
        for (long i = k + 1; i < n; ++i) size += row[i] * row[i];
        if (k >= n - 2 || size - row[k + 1] * row[k + 1] <= 1e-30 * size) {
            beside[k] = k < n - 1 ? row[k + 1] : 0;
            continue;
        }
        beside[k] = -copysign(sqrt(size), row[k + 1]);
        memcpy(v + k + 1, row + k + 1, (n - k - 1) * sizeof *v);
        v[k + 1] -= beside[k];
        double half = size - beside[k] * row[k + 1];
        for (long i = k + 1; i < n; ++i) {
            double sum = 0;
#pragma omp simd reduction(+ : sum)
            for (long j = k + 1; j < n; ++j) sum += a[n * i + j] * v[j];
            pulled[i] = sum / half, part += v[i] * pulled[i];
        }
        for (long i = k + 1; i < n; ++i) pulled[i] -= part / (2 * half) * v[i];
        for (long i = k + 1; i < n; ++i) {
            double one = v[i], other = pulled[i], *restrict into = a + n * i;
#pragma omp simd
            for (long j = k + 1; j < n; ++j) into[j] -= one * pulled[j] + other * v[j];
        }
    }
    return smallest_root(diagonal, beside, n);
}

static double margin_at(const Elastic *e, const double *numbers, const double *x) {
    double second[e->against * e->against + 1];
    const double *arg[] = {x, numbers};
    double *res[] = {second};
    if (!e->against) return 1;
    e->second(arg, res, 0, 0, 0);
    double found = smallest_eigenvalue(second, e->against);
    return found > 1 ? 1 : found;
}

/* The margin at every x, with steps in numbers from row to row. */
void margins(const Elastic *e, const double *numbers, long step, const double *x, long rows, double *found) {
    for (long row = 0; row < rows; ++row, x += 2 * e->d + 2, numbers += step) found[row] = margin_at(e, numbers, x);
}
