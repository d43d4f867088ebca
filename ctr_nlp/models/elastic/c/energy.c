/* The elastic model's energy, its gradient and second variation; branch.c and margin.c come before this file. */

#include <stdlib.h>

/* Of two vectors; in four sums, which processors take side by side. */
static double product(const double *a, const double *b, long n) {
    double sums[4] = {0};
    long i = 0;
    for (; i + 4 <= n; i += 4)
        for (int l = 0; l < 4; ++l) sums[l] += a[i + l] * b[i + l];
    for (; i < n; ++i) sums[0] += a[i] * b[i];
    return sums[0] + sums[1] + sums[2] + sums[3];
}

/* The energy at one beta, of a robot whose twists are a in terms of the n scaled ones that are there: |a|^2 / 2 less
   the strengths times the cosines of angles, which the twists in columns turn by turns. row, rows, work: room. */
typedef struct {
    long n, *begins, *columns, *places;
    double *strengths, *angles, *turns, *scales, *matrix, *row, *rows, *work;
    void *room;
} Energy;

static Energy energy_for(const Elastic *e) {
    long rows = e->rows, n = e->twists, entries = e->starts[rows], work = 2 * n * n + 6 * n + 2 * rows;
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
