/* The elastic model's energy, its gradient and second variation, of LANES robots at once; lanes.c and branch.c come
   before this file. */

/* The energies of robots, each at one beta, whose twists of tubes against each other are a (n,): |a|^2 / 2 less the
   strengths times the cosines of angles (rows,), which a turns by turns (rows, n), of which the entries are stored that
   are not always 0; tips are turned by ends (d, n). made (rows + d,): what helices turn rows and tips by of
   themselves. cosines (rows,): strengths times cosines of angles; matrix (n, n); work: room. */
typedef struct {
    long n, rows;
    V *strengths, *angles, *turns, *ends, *made, *cosines, *matrix, *work;
} Energy;

/* Vectors that the parts of an Energy take. */
#define ENERGY_ROOM(e)                                                                                              \
    (9 * ROWS(e) + TURNS(e) + TUBES(e) * AGAINST(e) + TUBES(e) + 2 * AGAINST(e) * AGAINST(e) + 8 * AGAINST(e))

static Energy energy_in(const Elastic *e, V *room) {
    long rows = ROWS(e), n = AGAINST(e);
    Energy of;
    of.n = n, of.rows = rows;
    of.strengths = room, of.angles = room + rows, of.cosines = of.angles + rows, of.turns = of.cosines + rows;
    of.ends = of.turns + TURNS(e), of.made = of.ends + TUBES(e) * n, of.matrix = of.made + rows + TUBES(e);
    of.work = of.matrix + n * n;
    return of;
}

/* The strengths and turns at the beta of x (LANES, ..), and the angles there. */
static void described(const Elastic *e, const double *numbers, const double *x, Energy *of) {
    const double *arg[] = {x, numbers};
    double *res[] = {(double *)of->strengths, (double *)of->angles, (double *)of->turns, (double *)of->ends,
                     (double *)of->made};
    CALL(e, energy)(arg, res, 0, 0, 0);
}

/* What rows are turned by, by the twists a. */
APART void turned(const Elastic *e, const Energy *of, const V *a, V *angles) {
    for (long r = 0; r < of->rows; ++r) {
        V sum = all(0);
        for (long k = STARTS(e)[r]; k < STARTS(e)[r + 1]; ++k) sum += of->turns[k] * a[COLUMNS(e)[k]];
        angles[r] = sum;
    }
}

/* The energy at twists a and angles; its gradient too, unless that is 0. */
APART V energy_at(const Elastic *e, Energy *of, const V *a, const V *angles, V *gradient) {
    V found = product(a, a, of->n) / 2, cosine;
    if (gradient) memcpy(gradient, a, of->n * sizeof *a);
    for (long r = 0; r < of->rows; ++r) {
        V pull = of->strengths[r] * sine_and_cosine(angles[r], &cosine);
        of->cosines[r] = of->strengths[r] * cosine;
        found -= of->cosines[r];
        for (long k = STARTS(e)[r]; gradient && k < STARTS(e)[r + 1]; ++k) gradient[COLUMNS(e)[k]] += pull * of->turns[k];
    }
    return found;
}

/* The second variation K + V, in which K is the identity, where the energy was evaluated last: from the diagonal on. */
APART void bent(const Elastic *e, Energy *of) {
    long n = of->n;
    memset(of->matrix, 0, n * n * sizeof *of->matrix);
    for (long i = 0; i < n; ++i) of->matrix[i + n * i] = all(1);
    for (long r = 0; r < of->rows; ++r)
        for (long i = STARTS(e)[r]; i < STARTS(e)[r + 1]; ++i) {
            V part = of->cosines[r] * of->turns[i], *row = of->matrix + n * COLUMNS(e)[i];
            for (long j = i; j < STARTS(e)[r + 1]; ++j) row[COLUMNS(e)[j]] += part * of->turns[j];
        }
}
