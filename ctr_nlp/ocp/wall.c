/* What a lumen's wall is like near to a robot; what it means is said in wall.py. */

#include <math.h>
#include <string.h>

#define NEWTON 4     /* steps from the nearest point of the table to the nearest of the path */
#define CLOSE 1e-6   /* mm: a step to the nearest of the path that is as good as none */
#define SPARE 4      /* mm beyond the nearest of the table that is kept in mind for the next point */
#define COLUMNS 13   /* of what describes a place, as in terms/lumen.py */

typedef int (*Function)(const double **, double **, long long *, double *, int);

/* points: of so many samples a lane, from x, shares of the extensions, the tubes' numbers and those of a load, of which
   there are so many as loaded, in every lane.
   table: points (nodes, 3), mm; along: their arc lengths; path, radius: cubic pieces between them, by falling powers.
   widest: the longest step of the table. known: whether what is kept was found, at x and under the load kept. */
typedef struct {
    Function points;
    long unknowns, loaded, tubes, places, finer, samples, lanes, nodes;
    const double *shares, *numbers, *table, *along, *path, *radius, *outer;
    double clearance, centred, tiny, spacing, widest;
    double *x, *load, *at, *kept_x, *kept_load, *kept;
    long known;
} Wall;

/* What of the path is nearest to a point, and the wall there. */
typedef struct {
    double centre[3], tangent[3], bend[3], radius, taper, behind, ahead, distance;
} Near;

static double most(double a, double b) { return a > b || a != a ? a : b; }
static double within(double value, double low, double high) { return value < low ? low : value > high ? high : value; }
static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double square(const Wall *w, long i, const double *p) {
    double x = p[0] - w->table[3 * i], y = p[1] - w->table[3 * i + 1], z = p[2] - w->table[3 * i + 2];
    return x * x + y * y + z * z;
}

/* What is known of the table around a point that was looked at: its nearest, and that those before `from` and after
   `to` were at least so many mm beyond. */
typedef struct {
    long found, from, to;
    double at[3], beyond;
} Seen;

/* The table's point that is nearest to p: exactly, and soon where p is near to what was looked at before. Where a point
   is further away than asked for by so much, none within that of the path is nearer. */
static long nearest(const Wall *w, const double *p, Seen *seen) {
    double least = INFINITY, away[] = {p[0] - seen->at[0], p[1] - seen->at[1], p[2] - seen->at[2]};
    for (long i = seen->from; i <= seen->to; ++i) {
        double at = square(w, i, p);
        if (at < least) least = at, seen->found = i;
    }
    double root = sqrt(least);
    if (root + sqrt(dot(away, away)) <= seen->beyond) return seen->found;
    long guess = seen->from = seen->to = seen->found;
    for (int side = -1; side <= 1; side += 2)
        for (long i = guess + side; i >= 0 && i < w->nodes;) {
            double at = square(w, i, p), reach = root + SPARE;
            if (at < least) least = at, root = sqrt(least), seen->found = i;
            if (at < reach * reach) {
                *(side < 0 ? &seen->from : &seen->to) = i, i += side;
            } else
                i += side * ((long)((sqrt(at) - reach) / w->widest) + 1);
        }
    memcpy(seen->at, p, sizeof seen->at), seen->beyond = root + SPARE;
    return seen->found;
}

static long piece(const Wall *w, double s, long guess) {
    while (guess > 0 && s < w->along[guess]) --guess;
    while (guess < w->nodes - 2 && s >= w->along[guess + 1]) ++guess;
    return guess;
}

/* Path, tangent and bend at t mm into a piece. */
static void path(const Wall *w, long i, double t, double *at, double *tangent, double *bend) {
    long power = 3 * (w->nodes - 1);
    for (int k = 0; k < 3; ++k) {
        const double *c = w->path + 3 * i + k;
        at[k] = ((c[0] * t + c[power]) * t + c[2 * power]) * t + c[3 * power];
        tangent[k] = (3 * c[0] * t + 2 * c[power]) * t + c[2 * power];
        bend[k] = 6 * c[0] * t + 2 * c[power];
    }
}

static void look(const Wall *w, const double *p, Seen *seen, Near *near) {
    double *at = near->centre, *tangent = near->tangent, *bend = near->bend, away[3];
    long i = nearest(w, p, seen), power = w->nodes - 1;
    double s = w->along[i], end = w->along[w->nodes - 1];
    i = piece(w, s, i < power ? i : power - 1);
    for (int step = 0;; ++step) {
        path(w, i, s - w->along[i], at, tangent, bend);
        for (int k = 0; k < 3; ++k) away[k] = p[k] - at[k];
        if (step == NEWTON) break;
        double further = dot(away, tangent) / most(dot(tangent, tangent) - dot(away, bend), 0.1), before = s;
        s = within(s + within(further, -w->spacing, w->spacing), 0, end);
        if (fabs(s - before) < CLOSE) break;
        i = piece(w, s, i);
    }
    const double *c = w->radius + i;
    double t = s - w->along[i];
    near->radius = ((c[0] * t + c[power]) * t + c[2 * power]) * t + c[3 * power];
    near->taper = ((3 * c[0] * t + 2 * c[power]) * t + c[2 * power]) / most(1 - dot(away, bend), 0.1);
    near->distance = sqrt(dot(away, away)), near->behind = s, near->ahead = end - s;
}

/* The samples' points in base axes, lane after lane. */
static void sample(Wall *w, const double *x, const double *load) {
    const double *given[] = {w->x, w->shares, w->numbers, w->load};
    double *found[] = {w->at};
    for (long lane = 0; lane < w->lanes; ++lane) {
        memcpy(w->x + lane * w->unknowns, x, w->unknowns * sizeof *x);
        memcpy(w->load + lane * w->loaded, load, w->loaded * sizeof *load);
    }
    w->points(given, found, 0, 0, 0);
}

/* One row of what describes the wall, (rows, COLUMNS) by columns. */
static void write_row(const Wall *w, const Near *near, double room, long rows, double *to) {
    double size = sqrt(dot(near->bend, near->bend)), sharpest = 1 / near->radius / most(size, w->tiny);
    double bent = sharpest < 1 ? sharpest : 1;
    for (int k = 0; k < 3; ++k) {
        to[k * rows] = near->centre[k], to[(3 + k) * rows] = near->tangent[k];
        to[(6 + k) * rows] = near->bend[k] * bent;
    }
    to[9 * rows] = room, to[10 * rows] = near->taper, to[11 * rows] = near->behind, to[12 * rows] = near->ahead;
}

/* What describes the wall around unknowns x under a load, (places, COLUMNS) by columns, and then the slack needed, mm.
   Where robots bear none, it is not looked at. */
void around(Wall *w, const double *x, const double *load, double *found) {
    long rows = w->tubes * w->places, size = w->unknowns * sizeof *x, more = w->loaded * sizeof *load;
    if (!w->known || memcmp(w->kept_x, x, size) || memcmp(w->kept_load, load, more)) {
        double least = INFINITY;
        Seen seen = {.beyond = -1};
        memcpy(w->kept_x, x, size), memcpy(w->kept_load, load, more);
        sample(w, x, load);
        for (long row = 0; row < rows; ++row) {
            double narrow = INFINITY, left = 0, room = 0;
            Near near;
            for (long k = row * w->finer; k < (row + 1) * w->finer; ++k) {
                const double *at = w->at + k / w->samples * 3 * w->samples + k % w->samples;
                double p[] = {at[0], at[w->samples], at[2 * w->samples]};
                look(w, p, &seen, &near);
                room = near.radius - w->outer[row / w->places] - w->clearance;
                left = room - sqrt(near.distance * near.distance + w->centred * w->centred);
                narrow = left < narrow || left != left ? left : narrow;
            }
            least = narrow < least || narrow != narrow ? narrow : least;
            write_row(w, &near, room - (left - narrow), rows, w->kept + row);
        }
        w->kept[rows * COLUMNS] = most(-least, 0), w->known = 1;
    }
    memcpy(found, w->kept, (rows * COLUMNS + 1) * sizeof *found);
}

/* The same for so many frames, a row each. */
void around_all(Wall *w, long frames, const double *x, const double *loads, double *found) {
    long size = w->tubes * w->places * COLUMNS + 1;
    for (long j = 0; j < frames; ++j) around(w, x + j * w->unknowns, loads + j * w->loaded, found + j * size);
}

/* What is left of the lumen beside so many points, rows of three: its radius less the distance to its path, mm. */
void left_beside(const Wall *w, long count, const double *points, double *found) {
    Seen seen = {.beyond = -1};
    for (long i = 0; i < count; ++i) {
        const double *p = points + 3 * i;
        Near near;
        if (isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2])) {
            look(w, p, &seen, &near);
            found[i] = near.radius - near.distance;
        } else
            found[i] = NAN;
    }
}
