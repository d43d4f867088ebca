/* The elastic model's energy, its gradient and second variation; branch.c and margin.c come before this file. */

#include <stdlib.h>

#ifdef LIBMVEC
__attribute__((simd("notinbranch"))) double sin(double);
__attribute__((simd("notinbranch"))) double cos(double);
#endif

/* What processors take side by side. */
typedef double Four __attribute__((vector_size(4 * sizeof(double)), aligned(sizeof(double)), may_alias));

/* Of two vectors. */
static inline double product(const double *a, const double *b, long n) {
    Four sums = {0};
    double rest = 0;
    long i = 0;
    for (; i + 4 <= n; i += 4) sums += *(const Four *)(a + i) * *(const Four *)(b + i);
    for (; i < n; ++i) rest += a[i] * b[i];
    return rest + sums[0] + sums[1] + sums[2] + sums[3];
}

static inline void added(double part, const double *restrict row, long n, double *restrict to) {
    long i = 0;
    for (; i + 4 <= n; i += 4) *(Four *)(to + i) += part * *(const Four *)(row + i);
    for (; i < n; ++i) to[i] += part * row[i];
}

/* The energy at one beta, of a robot whose twists of tubes against each other are a (n,): |a|^2 / 2 less the strengths
   times the cosines of angles, which a turns by turns (rows, n); tips are turned by ends (d, n). made (rows + d,): what helices turn rows and tips by of themselves. sines, cosines
   (rows,), matrix (n, n) and work: room. */
typedef struct {
    long n, rows;
    double *strengths, *angles, *turns, *ends, *made, *sines, *cosines, *matrix, *work;
} Energy;

static Energy energy_for(const Elastic *e) {
    long rows = e->rows, n = e->against, work = n * n + 4 * n + 5 * rows, made = rows + e->d;
    Energy of = {n, rows};
    of.strengths = malloc((4 * rows + made + (rows + e->d) * n + n * n + work) * sizeof(double));
    of.angles = of.strengths + rows, of.sines = of.angles + rows, of.cosines = of.sines + rows;
    of.turns = of.cosines + rows, of.ends = of.turns + rows * n, of.matrix = of.ends + e->d * n;
    of.work = of.matrix + n * n, of.made = of.work + work;
    return of;
}

/* The strengths and turns at the beta of x, and the angles there. */
static void described(const Elastic *e, const double *numbers, const double *x, Energy *of) {
    const double *arg[] = {x, numbers};
    double *res[] = {of->strengths, of->angles, of->turns, of->ends, of->made};
    e->energy(arg, res, 0, 0, 0);
}

/* What rows are turned by, by the twists a. */
static void turned(const Energy *of, const double *a, double *angles) {
    for (long r = 0; r < of->rows; ++r) angles[r] = product(of->turns + of->n * r, a, of->n);
}

/* The energy at twists a and angles, and its gradient. */
static double energy_at(Energy *of, const double *a, const double *angles, double *gradient) {
    memcpy(gradient, a, of->n * sizeof *a);
#pragma omp simd
    for (long r = 0; r < of->rows; ++r) of->sines[r] = of->strengths[r] * sin(angles[r]);
#pragma omp simd
    for (long r = 0; r < of->rows; ++r) of->cosines[r] = of->strengths[r] * cos(angles[r]);
    double found = product(a, a, of->n) / 2;
    for (long r = 0; r < of->rows; ++r) {
        added(of->sines[r], of->turns + of->n * r, of->n, gradient);
        found -= of->cosines[r];
    }
    return found;
}

/* The second variation K + V, in which K is the identity, where the energy was evaluated last: from the diagonal on and some more. */
static void bent(Energy *of) {
    long n = of->n;
    memset(of->matrix, 0, n * n * sizeof *of->matrix);
    for (long i = 0; i < n; ++i) of->matrix[i + n * i] = 1;
    for (long r = 0; r < of->rows; ++r)
        for (long i = 0; i < n; ++i) {
            const double *row = of->turns + n * r;
            long from = i - i % 4;
            added(of->cosines[r] * row[i], row + from, n - from, of->matrix + n * i + from);
        }
}
