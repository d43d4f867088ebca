/* Vectors V with one robot in each of LANES lanes, and masks M of lanes. The language of generated code (V, M, all,
   choose, by_lane_sin, ...) comes before this file; with one lane, vectors are numbers and masks are 0 or 1. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Sizes of a structure and calls of its functions. Text for one structure alone (one_structure.py) defines constants and
   names before this file: graphics cards have no arrays of variable length, and are slow with pointers to functions. The
   number of tubes, TUBES(e), is a constant in both: short loops over tubes are unrolled. */
#ifndef ONE_STRUCTURE
#define ROWS(e) ((e)->rows)
#define AGAINST(e) ((e)->against)
#define VECTORS(e) ((e)->vectors)
#define TURNS(e) ((e)->starts[(e)->rows])
#define FIRST(e) ((e)->first)
#define OTHER(e) ((e)->other)
#define STARTS(e) ((e)->starts)
#define COLUMNS(e) ((e)->columns)
#define CALL(e, function) ((e)->function)
#define RESERVE(name, count) V *name = aligned_alloc(sizeof(V), ((count) + 1) * sizeof(V))
#define RELEASE(name) free(name)
#endif

#if LANES == 1
static inline int some(M mask) { return mask; }
static inline M unless(M mask) { return !mask; }
static inline M every(int yes) { return yes; }
static inline V sine_and_cosine(V a, V *cosine) {
    *cosine = cos(a);
    return sin(a);
}
#else
static inline int some(M mask) {
    long long found = 0;
    EACH found |= mask[l];
    return found != 0;
}
static inline M unless(M mask) { return ~mask; }
static inline M every(int yes) { return (M){0} - yes; }
#endif

/* Long functions that several call: compilers take long where they put copies into each. */
#define APART static __attribute__((noinline))

static inline double lane(const V *a, long l) { return ((const double *)a)[l]; }
static inline void set_lane(V *a, long l, double value) { ((double *)a)[l] = value; }
static inline V size_of_each(V a) { return choose(a < 0, -a, a); }
static inline V smaller(V a, V b) { return choose(b < a, b, a); }
static inline V larger(V a, V b) { return choose(b > a, b, a); }

/* Of two columns of vectors. */
static inline V product(const V *a, const V *b, long n) {
    V one = all(0), other = all(0);
    long i = 0;
    for (; i + 2 <= n; i += 2) one += a[i] * b[i], other += a[i + 1] * b[i + 1];
    return i < n ? one + other + a[i] * b[i] : one + other;
}

static inline void added(V part, const V *row, long n, V *to) {
    for (long i = 0; i < n; ++i) to[i] += part * row[i];
}

static inline V largest_of(const V *a, long n) {
    V found = all(0);
    for (long i = 0; i < n; ++i) found = choose(size_of_each(a[i]) <= found, found, size_of_each(a[i]));
    return found;
}
