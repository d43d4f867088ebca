/* The elastic model's stability margins, of LANES robots at once; lanes.c and branch.c come before this file. */

/* The smallest root of the characteristic polynomial of a tridiagonal matrix, by Laguerre's method from the left. */
static V smallest_roots(const V *diagonal, const V *beside, long n) {
    V x = diagonal[0];
    for (long i = 0; i < n; ++i) {
        V low = diagonal[i];
        if (i) low -= size_of_each(beside[i - 1]);
        if (i < n - 1) low -= size_of_each(beside[i]);
        x = smaller(x, low);
    }
    x -= 1e-9 * (1 + size_of_each(x));
    double size = n;
    M open = every(1);
    for (int k = 0; k < 60 && some(open); ++k) {
        V p = diagonal[0] - x, inverse = 1 / p, slope = all(-1), bend = all(0), first = -inverse, second = first * first;
        M left = p > 0;
        for (long i = 1; i < n; ++i) {
            V part = beside[i - 1] * inverse;
            part *= part;
            bend = part * (bend - 2 * slope * slope * inverse), slope = -1 + part * slope;
            p = diagonal[i] - x - part * p, left &= p > 0, inverse = 1 / p;
            V ratio = slope * inverse;
            first += ratio, second += ratio * ratio - bend * inverse;
        }
        /* Beyond the root by rounding, where a pivot is not positive: that is its place. */
        open &= left;
        V step = size / (by_lane_sqrt(larger(all(0), (size - 1) * (size * second - first * first))) - first);
        x = choose(open, x + step, x);
        open &= step > 1e-14 * (1 + size_of_each(x));
    }
    return x;
}

/* A symmetric matrix times v, from row and column `from` on. */
static void multiplied(const V *a, const V *v, long n, long from, V *to) {
    long i = from;
    /* Four sums at a time: one alone would wait for each of its additions. */
    for (; i + 4 <= n; i += 4) {
        const V *row = a + n * i;
        V first = all(0), second = all(0), third = all(0), fourth = all(0);
        for (long j = from; j < n; ++j) {
            first += row[j] * v[j], second += row[j + n] * v[j];
            third += row[j + 2 * n] * v[j], fourth += row[j + 3 * n] * v[j];
        }
        to[i] = first, to[i + 1] = second, to[i + 2] = third, to[i + 3] = fourth;
    }
    for (; i < n; ++i) to[i] = product(a + n * i + from, v + from, n - from);
}

/* The smallest eigenvalue of a symmetric matrix (n, n), which is lost: it is made tridiagonal by Householder's
   reflections. room: 4 n. */
APART V smallest_eigenvalues(V *a, long n, V *room) {
    V *diagonal = room, *beside = room + n, *v = beside + n, *pulled = v + n;
    for (long k = 0; k < n; ++k) {
        V *row = a + n * k;
        diagonal[k] = row[k];
        beside[k] = k < n - 1 ? row[k + 1] : all(0);
        if (k >= n - 2) continue;
        V size = product(row + k + 1, row + k + 1, n - k - 1), part = all(0);
        M done = size - row[k + 1] * row[k + 1] <= 1e-30 * size;
        V root = by_lane_sqrt(size);
        beside[k] = choose(done, row[k + 1], choose(row[k + 1] < 0, root, -root));
        for (long i = k + 1; i < n; ++i) v[i] = choose(done, all(0), row[i]);
        v[k + 1] = choose(done, all(0), v[k + 1] - beside[k]);
        V half = 1 / choose(done, all(1), size - beside[k] * row[k + 1]);
        multiplied(a, v, n, k + 1, pulled);
        for (long i = k + 1; i < n; ++i) pulled[i] *= half, part += v[i] * pulled[i];
        part *= half / 2;
        for (long i = k + 1; i < n; ++i) pulled[i] -= part * v[i];
        for (long i = k + 1; i < n; ++i) {
            V one = v[i], other = pulled[i], *into = a + n * i;
            for (long j = k + 1; j < n; ++j) into[j] -= one * pulled[j] + other * v[j];
        }
    }
    return smallest_roots(diagonal, beside, n);
}

/* The margins of LANES robots at x (LANES, ..), numbers (LANES, ..). */
APART V margins_beside(const Elastic *e, const double *numbers, const double *x) {
    if (!AGAINST(e)) return all(1);
    RESERVE(second, AGAINST(e) * AGAINST(e) + 4 * AGAINST(e));
    const double *arg[] = {x, numbers};
    double *res[] = {(double *)second};
    CALL(e, second)(arg, res, 0, 0, 0);
    V found = smallest_eigenvalues(second, AGAINST(e), second + AGAINST(e) * AGAINST(e));
    RELEASE(second);
    return choose(found > 1, all(1), found);
}

/* Copy `entries` numbers of up to LANES rows, `step` apart, into all lanes; those without a row repeat the first. */
static void fill_lanes(const double *rows, long step, long entries, long count, double *to) {
    for (long l = 0; l < LANES; ++l) memcpy(to + entries * l, rows + (l < count ? l * step : 0), entries * sizeof *to);
}

static double margin_at(const Elastic *e, const double *numbers, const double *x) {
    double own[LANES * MOST_TUBES * NUMBERS], at[LANES * SIDE];
    fill_lanes(numbers, 0, TUBES(e) * NUMBERS, 1, own);
    fill_lanes(x, 0, 2 * TUBES(e) + 2, 1, at);
    V found = margins_beside(e, own, at);
    return lane(&found, 0);
}

/* The margin at every x, with steps in numbers from row to row. */
void margins(const Elastic *e, const double *numbers, long step, const double *x, long rows, double *found) {
    long n = 2 * TUBES(e) + 2;
    double own[LANES * MOST_TUBES * NUMBERS], at[LANES * SIDE];
    for (long first = 0; first < rows; first += LANES) {
        long here = rows - first < LANES ? rows - first : LANES;
        if (step || !first) fill_lanes(numbers + step * first, step, TUBES(e) * NUMBERS, here, own);
        fill_lanes(x + n * first, n, n, here, at);
        V of_lanes = margins_beside(e, own, at);
        for (long l = 0; l < here; ++l) found[first + l] = lane(&of_lanes, l);
    }
}
