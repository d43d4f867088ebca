/* What a lumen's wall is like near to a robot; what it means is said in wall.py. */

#include <math.h>
#include <string.h>

#define NEWTON 4     /* steps from the nearest point of the table to the nearest of the path */
#define CLOSE 1e-6   /* mm: a step to the nearest of the path that is as good as none */
#define SPARE 4      /* mm beyond the nearest of the table that is kept in mind for the next point */
#define COLUMNS 14   /* of what describes a place, as in terms/lumen.py */
#define PROJECTED 18 /* numbers of what look_beside finds for a point */
#define FIELD_NUMBERS 13 /* and evaluate_beside */
#define BLOCK 8      /* cells along each side of a block, as in paths/distance_field.py */
#define SIDE 11      /* coefficients along each side of a block */

typedef int (*Function)(const double **, double **, long long *, double *, int);

/* A grid of a distance field (paths/distance_field.py): to_grid (3, 4) by rows, from mm to units of the grid; index: of
   the block at each place of the grid of blocks, of this shape; coefficients: (blocks, 11, 11, 11), mm. */
typedef struct {
    double to_grid[12], to_mm[12];
    long shape[3];
    const int *index;
    const float *coefficients;
} Grid;

/* A wall that is a distance field, on grids from the finest to the coarsest. A robot keeps inside of it (sign 1) or
   outside (sign -1), margin mm further away than from other walls. sharpest, flattest: limits of radii of curvature. */
typedef struct {
    const Grid *grid;
    long grids;
    double sign, margin, sharpest, flattest, far;
} Field;

/* points: of so many samples a lane, from x, shares of the extensions, the tubes' numbers and those of a load, of which
   there are so many as loaded, in every lane.
   table: points (nodes, 3), mm; along: their arc lengths; path, radius: cubic pieces between them, by falling powers.
   Without nodes there is no such path. field: so many fields besides, the nearest of which counts.
   widest: the longest step of the table. known: whether what is kept was found, at x and under the load kept. */
typedef struct {
    Function points;
    long unknowns, loaded, tubes, places, finer, samples, lanes, nodes;
    const double *shares, *numbers, *table, *along, *path, *radius, *outer;
    double clearance, centred, tiny, spacing, widest;
    double *x, *load, *at, *kept_x, *kept_load, *kept;
    long known, fields;
    const Field *field;
} Wall;

/* What of the path is nearest to a point, and the wall there. bend: the curvature, limited as the lumen is wide. */
typedef struct {
    double centre[3], tangent[3], curvature[3], bend[3], radius, taper, behind, ahead, distance, slope;
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

static void look_at_path(const Wall *w, const double *p, Seen *seen, Near *near) {
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
    near->distance = sqrt(dot(away, away)), near->behind = s, near->ahead = end - s, near->slope = 1;
    memcpy(near->curvature, bend, sizeof near->curvature);
    /* Bends sharper than the lumen is wide are noise of the path's points. */
    double size = sqrt(dot(bend, bend)), sharpest = 1 / near->radius / most(size, w->tiny);
    for (int k = 0; k < 3 && sharpest < 1; ++k) bend[k] *= sharpest;
}

/* The cubic B-splines of the four nodes around a place t in [0, 1] of a cell, and their derivatives. */
static void basis(double t, double values[3][4]) {
    double s = 1 - t;
    values[0][0] = s * s * s / 6, values[0][3] = t * t * t / 6;
    values[0][1] = (3 * t * t * t - 6 * t * t + 4) / 6, values[0][2] = (-3 * t * t * t + 3 * t * t + 3 * t + 1) / 6;
    values[1][0] = -s * s / 2, values[1][3] = t * t / 2;
    values[1][1] = (3 * t * t - 4 * t) / 2, values[1][2] = (-3 * t * t + 2 * t + 1) / 2;
    values[2][0] = s, values[2][1] = 3 * t - 2, values[2][2] = 1 - 3 * t, values[2][3] = t;
}

static void to_units(const double *affine, const double *p, double *to) {
    for (int k = 0; k < 3; ++k) to[k] = dot(affine + 4 * k, p) + affine[4 * k + 3];
}

/* The coefficients of the block that has a place, or none. */
static const float *block_at(const Grid *g, const double *place) {
    long at[3];
    for (int k = 0; k < 3; ++k) {
        at[k] = (long)floor(place[k] / BLOCK);
        if (at[k] < 0 || at[k] >= g->shape[k]) return 0;
    }
    int block = g->index[(at[0] * g->shape[1] + at[1]) * g->shape[2] + at[2]];
    return block < 0 ? 0 : g->coefficients + (long)block * SIDE * SIDE * SIDE;
}

/* The splines along each axis at a place of a grid, and the first coefficient of its block that they multiply. */
static void place_in_block(const double *place, double along[3][3][4], long *first) {
    for (int k = 0; k < 3; ++k) {
        long cell = (long)floor(place[k]);
        basis(place[k] - cell, along[k]);
        first[k] = cell % BLOCK;
    }
}

/* Distance at a place of a grid, its slope and its second derivatives (3, 3), by units of the grid. */
static double evaluate_block(const float *block, const double *place, double *slope, double *bend) {
    double along[3][3][4], found[3][3][3] = {{{0}}};
    long first[3];
    place_in_block(place, along, first);
    for (int i = 0; i < 4; ++i) {
        double plane[3][3] = {{0}}; /* by the orders of the derivatives along the second and the third axis */
        for (int j = 0; j < 4; ++j) {
            const float *c = block + ((first[0] + i) * SIDE + first[1] + j) * SIDE + first[2];
            for (int third = 0; third < 3; ++third) {
                const double *b = along[2][third];
                double row = c[0] * b[0] + c[1] * b[1] + c[2] * b[2] + c[3] * b[3];
                for (int second = 0; second + third < 3; ++second) plane[second][third] += along[1][second][j] * row;
            }
        }
        for (int second = 0; second < 3; ++second)
            for (int third = 0; second + third < 3; ++third)
                for (int order = 0; order + second + third < 3; ++order)
                    found[order][second][third] += along[0][order][i] * plane[second][third];
    }
    slope[0] = found[1][0][0], slope[1] = found[0][1][0], slope[2] = found[0][0][1];
    bend[0] = found[2][0][0], bend[4] = found[0][2][0], bend[8] = found[0][0][2];
    bend[1] = bend[3] = found[1][1][0], bend[2] = bend[6] = found[1][0][1], bend[5] = bend[7] = found[0][1][1];
    return found[0][0][0];
}

/* The distance alone at a place of a grid: a quarter of the work of evaluate_block. */
static double evaluate_block_distance(const float *block, const double *place) {
    double along[3][3][4], found = 0;
    long first[3];
    place_in_block(place, along, first);
    for (int i = 0; i < 4; ++i) {
        double plane = 0;
        for (int j = 0; j < 4; ++j) {
            const float *c = block + ((first[0] + i) * SIDE + first[1] + j) * SIDE + first[2];
            const double *b = along[2][0];
            plane += along[1][0][j] * (c[0] * b[0] + c[1] * b[1] + c[2] * b[2] + c[3] * b[3]);
        }
        found += along[0][0][i] * plane;
    }
    return found;
}

/* Where a field is evaluated for a point: the finest grid that has it, the block there and the place in units of that
   grid. Beyond the coarsest grid, `inside` is the nearest point in it, and `away` how far that is, mm. */
typedef struct {
    const Grid *grid;
    const float *block;
    double place[3], inside[3], away;
} Located;

static Located locate(const Field *f, const double *p) {
    const Grid *coarsest = f->grid + f->grids - 1;
    double within_units[3];
    Located at = {.grid = f->grid, .inside = {p[0], p[1], p[2]}};
    to_units(coarsest->to_grid, p, at.place);
    for (int k = 0; k < 3; ++k) within_units[k] = within(at.place[k], 0, coarsest->shape[k] * BLOCK - 1e-9);
    if (memcmp(at.place, within_units, sizeof at.place)) {
        to_units(coarsest->to_mm, within_units, at.inside);
        for (int k = 0; k < 3; ++k) at.away += (p[k] - at.inside[k]) * (p[k] - at.inside[k]);
        at.away = sqrt(at.away);
    }
    for (;; ++at.grid) {
        to_units(at.grid->to_grid, at.inside, at.place);
        if (at.grid == coarsest) /* rounding must not take a place at its border out of it */
            for (int k = 0; k < 3; ++k) at.place[k] = within(at.place[k], 0, coarsest->shape[k] * BLOCK - 1e-9);
        if ((at.block = block_at(at.grid, at.place)) || at.grid == coarsest) return at;
    }
}

static int all_finite(const double *p) { return isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2]); }

/* Signed distance at a point, mm. Beyond the coarsest grid it is that of the nearest place in it, less the distance
   from there. */
static double field_distance(const Field *f, const double *p) {
    if (!all_finite(p)) return NAN;
    Located at = locate(f, p);
    return f->sign * (evaluate_block_distance(at.block, at.place) - at.away);
}

/* The same, with its slope and its second derivatives (3, 3) by mm. */
static double evaluate_field(const Field *f, const double *p, double *slope, double *bend) {
    double units_slope[3], units_bend[9];
    if (!all_finite(p)) {
        for (int i = 0; i < 9; ++i) slope[i % 3] = bend[i] = NAN;
        return NAN;
    }
    Located at = locate(f, p);
    const double *to_grid = at.grid->to_grid;
    double distance = evaluate_block(at.block, at.place, units_slope, units_bend) - at.away;
    for (int i = 0; i < 3; ++i) {
        slope[i] = 0;
        for (int k = 0; k < 3; ++k) slope[i] += units_slope[k] * to_grid[4 * k + i];
        for (int j = 0; j < 3; ++j) {
            bend[3 * i + j] = 0;
            for (int k = 0; k < 3; ++k)
                for (int l = 0; l < 3; ++l)
                    bend[3 * i + j] += to_grid[4 * k + i] * units_bend[3 * k + l] * to_grid[4 * l + j];
        }
    }
    for (int i = 0; i < 3 && at.away > 0; ++i) slope[i] = (at.inside[i] - p[i]) / at.away;
    for (int i = 0; i < 9; ++i) bend[i] = f->sign * (at.away > 0 ? 0 : bend[i]);
    for (int i = 0; i < 3; ++i) slope[i] *= f->sign;
    return f->sign * distance;
}

static double form(const double *matrix, const double *left, const double *right) {
    double image[3];
    for (int k = 0; k < 3; ++k) image[k] = dot(matrix + 3 * k, right);
    return dot(left, image);
}

/* The path and radius whose lumen has the wall of a field near a point: osculating_path of paths/distance_field.py. */
static void osculate(const Field *f, const double *p, double distance, const double *slope, const double *bend, Near *near) {
    double length = sqrt(dot(slope, slope)), normal[3] = {0, 0, 1}, first[3] = {0}, other[3];
    for (int k = 0; k < 3 && length > 1e-6; ++k) normal[k] = slope[k] / length;
    int least = fabs(normal[1]) < fabs(normal[0]) ? 1 : 0;
    least = fabs(normal[2]) < fabs(normal[least]) ? 2 : least;
    first[(least + 1) % 3] = normal[(least + 2) % 3], first[(least + 2) % 3] = -normal[(least + 1) % 3];
    double size = sqrt(dot(first, first));
    for (int k = 0; k < 3; ++k) first[k] /= size;
    for (int k = 0; k < 3; ++k)
        other[k] = normal[(k + 1) % 3] * first[(k + 2) % 3] - normal[(k + 2) % 3] * first[(k + 1) % 3];
    double steep = length > 1e-6 ? length : 1, both = form(bend, first, other) / steep;
    double one = form(bend, first, first) / steep, two = form(bend, other, other) / steep;
    double mean = (one + two) / 2, half = (one - two) / 2 + 0.0, spread = hypot(half, both), angle = atan2(both, half) / 2;
    double along = within(mean + spread, -1 / f->sharpest, 1 / f->sharpest);
    double across = 1 / within(spread - mean, 1 / f->flattest, 1 / f->sharpest);
    for (int k = 0; k < 3; ++k) {
        near->tangent[k] = cos(angle) * first[k] + sin(angle) * other[k];
        near->centre[k] = p[k] + across * normal[k], near->bend[k] = -along * normal[k];
        near->curvature[k] = near->bend[k];
    }
    near->distance = across, near->radius = distance - f->margin + across;
    near->taper = 0, near->behind = near->ahead = f->far, near->slope = length;
}

/* What is left of the lumen at a point: the signed distance to the nearest of all walls, mm. Which wall that is, goes
   to `which`: the number of its field, or -1 for the path, which `near` then describes. */
static double left_at(const Wall *w, const double *p, Seen *seen, Near *near, long *which) {
    double least = NAN;
    *which = -1;
    if (w->nodes) {
        look_at_path(w, p, seen, near);
        least = near->radius - near->distance;
    }
    for (long i = 0; i < w->fields; ++i) {
        double left = field_distance(w->field + i, p) - w->field[i].margin;
        if (left < least || (!w->nodes && !i)) least = left, *which = i;
    }
    return least;
}

/* The nearest of all walls. */
static void look(const Wall *w, const double *p, Seen *seen, Near *near) {
    double slope[3], bend[9];
    long which;
    left_at(w, p, seen, near, &which);
    if (which < 0) return;
    const Field *f = w->field + which;
    double distance = evaluate_field(f, p, slope, bend);
    osculate(f, p, distance, slope, bend, near);
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
static void write_row(const Near *near, double room, long rows, double *to) {
    for (int k = 0; k < 3; ++k) {
        to[k * rows] = near->centre[k], to[(3 + k) * rows] = near->tangent[k], to[(6 + k) * rows] = near->bend[k];
    }
    to[9 * rows] = room, to[10 * rows] = near->taper, to[11 * rows] = near->behind, to[12 * rows] = near->ahead;
    to[13 * rows] = near->slope;
}

/* Rows of what describes the wall, one a subsample. */
static long all_rows(const Wall *w) { return w->finer * w->tubes * w->places; }

/* The subsample number k, among all lanes. */
static void point_at(const Wall *w, long k, double *p) {
    const double *at = w->at + k / w->samples * 3 * w->samples + k % w->samples;
    for (int i = 0; i < 3; ++i) p[i] = at[i * w->samples];
}

/* Write the row of the wall at the subsample number k of a tube, moved along with it to `to`; the clearance there. */
static double write_wall(const Wall *w, long tube, long k, const double *to, Seen *seen, double *row) {
    double p[3];
    Near near;
    point_at(w, k, p);
    look(w, p, seen, &near);
    /* Programs take away the slope times the distance from the path: so much room is on it. */
    double room = near.radius + (near.slope - 1) * near.distance - w->outer[tube] - w->clearance;
    for (int i = 0; i < 3; ++i) near.centre[i] += to[i] - p[i];
    write_row(&near, room, all_rows(w), row);
    return room - near.slope * sqrt(near.distance * near.distance + w->centred * w->centred);
}

/* What describes the wall around unknowns x under a load, (subsamples, COLUMNS) by columns, and then the slack
   needed, mm. The first subsample of every sample point comes first, then the second of every one. Where robots bear
   none, a load is not looked at. */
void around(Wall *w, const double *x, const double *load, double *found) {
    long rows = w->tubes * w->places, all = all_rows(w), size = w->unknowns * sizeof *x, more = w->loaded * sizeof *load;
    if (!w->known || memcmp(w->kept_x, x, size) || memcmp(w->kept_load, load, more)) {
        double least = INFINITY;
        Seen seen = {.beyond = -1};
        memcpy(w->kept_x, x, size), memcpy(w->kept_load, load, more);
        sample(w, x, load);
        for (long row = 0; row < rows; ++row) {
            /* The subsamples around it, or at a tip those before it. */
            long own = (row + 1) * w->finer - 1, first = own - ((row + 1) % w->places ? w->finer / 2 : w->finer - 1);
            double p[3];
            point_at(w, own, p);
            for (long k = 0; k < w->finer; ++k) {
                double left = write_wall(w, row / w->places, first + k, p, &seen, w->kept + k * rows + row);
                least = left < least || left != left ? left : least;
            }
        }
        w->kept[all * COLUMNS] = most(-least, 0), w->known = 1;
    }
    memcpy(found, w->kept, (all * COLUMNS + 1) * sizeof *found);
}

/* The same for so many frames, a row each. */
void around_all(Wall *w, long frames, const double *x, const double *loads, double *found) {
    long size = all_rows(w) * COLUMNS + 1;
    for (long j = 0; j < frames; ++j) around(w, x + j * w->unknowns, loads + j * w->loaded, found + j * size);
}

/* What is left of the lumen beside so many points, rows of three: the signed distance to the nearest wall, mm. */
void left_beside(const Wall *w, long count, const double *points, double *found) {
    Seen seen = {.beyond = -1};
    for (long i = 0; i < count; ++i) {
        const double *p = points + 3 * i;
        long which;
        Near near;
        found[i] = all_finite(p) ? left_at(w, p, &seen, &near, &which) : NAN;
    }
}

/* The nearest wall beside so many points, rows of three: PROJECTED numbers for each, those of LumenProjection
   (paths/lumen.py) in its order. */
void look_beside(const Wall *w, long count, const double *points, double *found) {
    Seen seen = {.beyond = -1};
    for (long i = 0; i < count; ++i, found += PROJECTED) {
        const double *p = points + 3 * i;
        Near near;
        if (!all_finite(p)) {
            for (int k = 0; k < PROJECTED; ++k) found[k] = NAN;
            continue;
        }
        look(w, p, &seen, &near);
        found[0] = near.distance, found[1] = near.radius;
        memcpy(found + 2, near.centre, 3 * sizeof *found), memcpy(found + 5, near.tangent, 3 * sizeof *found);
        memcpy(found + 8, near.curvature, 3 * sizeof *found), memcpy(found + 11, near.bend, 3 * sizeof *found);
        found[14] = near.taper, found[15] = near.behind, found[16] = near.ahead;
        found[17] = near.slope;
    }
}

/* Signed distance, less the margin, from so many points to a field's surface, mm, its slope and its second derivatives
   (3, 3) by rows: FIELD_NUMBERS numbers for each point. */
void evaluate_beside(const Field *f, long count, const double *points, double *found) {
    for (long i = 0; i < count; ++i, found += FIELD_NUMBERS)
        found[0] = evaluate_field(f, points + 3 * i, found + 1, found + 4) - f->margin;
}
