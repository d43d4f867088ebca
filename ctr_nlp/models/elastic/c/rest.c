/* Robots at rest without a history, several side by side; the other files come before this one. */

enum { NONE = -1, CHUNK = LANES == 1 ? 1 : 256 };

/* A robot on its way from where all tubes' tips bend alike, towards alpha_d: the row that it is, the way, the equilibrium that is
   looked for at a place, where it is predicted, and steps of Newton's method and falls until now. on_way: whether the aligned
   one is found; falling: whether it waits for a fall. */
typedef struct {
    Way way;
    State to;
    double place[SIDE], ahead[SIDE];
    const double *goal;
    long row, steps, falls;
    int on_way, falling;
} Turned;

static void aligned(const Elastic *e, Turned *robot, const double *q, long row) {
    long d = TUBES(e), n = 2 * d + 2;
    robot->way.done = 0, robot->on_way = robot->falling = 0, robot->steps = robot->falls = 0;
    robot->row = row, robot->goal = q;
    memcpy(robot->place, q, n * sizeof *q);
    memset(robot->to.x, 0, d * sizeof *q);
    robot->to.x[d - 1] = q[d - 1], robot->to.stable = 1;
    memcpy(robot->to.x + d, q + d, (d + 2) * sizeof *q);
}

/* Look for the equilibrium after the next part of the way that is foreseen; whether there is one. */
static int looks_on(const Elastic *e, Turned *robot) {
    Way *way = &robot->way;
    while (way->part >= e->smallest && !foreseen(e, 0, way, robot->place, robot->ahead)) way->part /= 2;
    robot->to.stable = way->at.stable, robot->steps = 0;
    memcpy(robot->to.x + TUBES(e), way->at.x + TUBES(e), (TUBES(e) + 2) * sizeof *robot->ahead);
    memcpy(robot->to.x, robot->ahead, TUBES(e) * sizeof *robot->ahead);
    return way->part >= e->smallest;
}

/* What becomes of a robot by a step of Newton's method from motors' angles alpha: whether it is on its way still. At
   its end way.done is 1. The aligned robot is one from the beginning, wherever its motors are. */
static int turned_on(const Elastic *e, Turned *robot, const double *alpha) {
    Way *way = &robot->way;
    if (!robot->on_way) memcpy(robot->place, alpha, TUBES(e) * sizeof *alpha);
    double size = improved(e, robot->place, alpha, &robot->to), most = 0;
    int found = size < (robot->on_way && !at_end(way) ? e->near : e->converged);
    if (!found && size <= 1 && ++robot->steps < e->iterations) return 1;
    memcpy(robot->to.q, robot->place, (2 * TUBES(e) + 2) * sizeof *robot->place);
    if (robot->on_way) {
        if (!found || !as_predicted(e, robot->ahead, &robot->to) || !alike(&way->at, &robot->to))
            way->part /= 2;
        else if (gone_on(way, &robot->to))
            return 0;
        return looks_on(e, robot);
    }
    if (!found) return 0;
    for (long i = 0; i < TUBES(e); ++i) most = fmax(most, fabs(robot->goal[i] - robot->place[i]));
    robot->on_way = 1;
    set_off(e, way, &robot->to, robot->goal, e->stride / most);
    return looks_on(e, robot);
}

/* Robots whose ways ended early: those that have to fall, and those that have fallen and go on when a lane is free. */
typedef struct {
    Turned robots[4 * LANES];
    long count, falling;
} Waiting;

/* Whether a robot that is not on its way any more may fall into another equilibrium and go on. */
static int may_fall(Turned *robot) {
    return robot->on_way && robot->way.done < 1 && robot->falls++ < MOST_FALLS;
}

static void ended(const Turned *robot, State *states, long *found) {
    states[robot->row] = robot->way.at, found[robot->row] = robot->way.done >= 1;
    states[robot->row].stable &= found[robot->row];
}

/* Take a robot that has fallen out of those that wait; whether there is one. */
static int taken_back(Waiting *waiting, Turned *robot) {
    for (long k = 0; k < waiting->count; ++k)
        if (!waiting->robots[k].falling) {
            *robot = waiting->robots[k];
            if (k != --waiting->count) waiting->robots[k] = waiting->robots[waiting->count];
            return 1;
        }
    return 0;
}

/* Let robots fall that wait for it, up to LANES at once; how many of them end there, without an equilibrium. */
static long let_fall(const Elastic *e, const double *numbers, long step, Waiting *waiting, State *states, long *found) {
    long d = TUBES(e), count = 0, lost = 0, places[LANES];
    double own[LANES * MOST_TUBES * NUMBERS];
    State *from[LANES];
    const double *goals[LANES];
    int fell[LANES];
    for (long k = 0; k < waiting->count && count < LANES; ++k)
        if (waiting->robots[k].falling) places[count++] = k;
    for (long l = 0; l < LANES; ++l) {
        Turned *robot = waiting->robots + places[l < count ? l : 0];
        from[l] = &robot->way.at, goals[l] = robot->goal;
        memcpy(own + d * NUMBERS * l, numbers + step * robot->row, d * NUMBERS * sizeof *own);
    }
    fallen(e, own, from, goals, count, fell);
    waiting->falling -= count;
    /* From the last one on, so that the one that takes the place of another has been seen to. */
    for (long l = count - 1; l >= 0; --l) {
        Turned *robot = waiting->robots + places[l];
        robot->falling = 0;
        if (fell[l]) {
            set_off(e, &robot->way, &robot->way.at, robot->goal, 1);
            if (looks_on(e, robot)) continue;
            if ((robot->falling = may_fall(robot))) {
                ++waiting->falling;
                continue;
            }
        }
        ended(robot, states, found), ++lost;
        if (places[l] != --waiting->count) *robot = waiting->robots[waiting->count];
    }
    return lost;
}

/* Turn all tubes from alpha_d to where they are at every q, with steps in numbers from row to row; the states there,
   and whether each was found; one that was not is not stable. Where there are several rows, LANES of them are on their
   way at once. */
void settle(const Elastic *e, const double *numbers, long step, const double *q, long rows, State *states,
            long *found) {
    long d = TUBES(e), n = 2 * d + 2, lanes = rows > 2 ? LANES : 1, next = 0, left = rows;
    Turned robots[LANES];
    Waiting waiting;
    double x[LANES * SIDE], alpha[LANES * MOST_TUBES], slopes[LANES * MOST_TUBES * MOST_TUBES];
    double own[LANES * MOST_TUBES * NUMBERS] = {0};
    const double *arg[] = {x, own};
    double *res[] = {alpha, slopes};
    waiting.count = waiting.falling = 0;
    for (long l = 0; l < LANES; ++l) robots[l].row = NONE;
    while (left > 0) {
        long on_way = 0;
        for (long l = 0; l < lanes; ++l) {
            Turned *robot = robots + l;
            if (robot->row == NONE && (taken_back(&waiting, robot) || next < rows)) {
                if (robot->row == NONE) aligned(e, robot, q + n * next, next), ++next;
                memcpy(own + d * NUMBERS * l, numbers + step * robot->row, d * NUMBERS * sizeof *own);
            }
            on_way += robot->row != NONE;
            memcpy(x + n * l, robots[robot->row == NONE ? 0 : l].to.x, n * sizeof *x);
        }
        /* Few fall at the end, and together with others as long as there are any. */
        if (waiting.falling >= LANES || !on_way) left -= let_fall(e, numbers, step, &waiting, states, found);
        if (!on_way) continue;
        if (lanes > 1)
            CALL(e, motors_beside)(arg, res, 0, 0, 0);
        else
            CALL(e, motors)(arg, res, 0, 0, 0);
        for (long l = 0; l < lanes; ++l) {
            Turned *robot = robots + l;
            if (robot->row == NONE) continue;
            take_slopes(e, slopes, l, &robot->to);
            if (turned_on(e, robot, alpha + d * l)) continue;
            if (may_fall(robot))
                robot->falling = 1, waiting.robots[waiting.count++] = *robot, ++waiting.falling;
            else
                ended(robot, states, found), --left;
            robot->row = NONE;
        }
    }
}

/* Robots at rest at every q without a history, with steps in numbers from row to row: x, the tips' directions, the
   margins and points, NaN where no equilibrium is found. */
void rests(const Elastic *e, const double *numbers, long step, const double *q, long rows, const double *sigma,
           long samples, double *x, double *tips, double *margin, double *points) {
    long n = 2 * TUBES(e) + 2, found[CHUNK];
    State states[CHUNK];
    for (long first = 0; first < rows; first += CHUNK) {
        long here = rows - first < CHUNK ? rows - first : CHUNK;
        const double *own = numbers + step * first;
        double *at = x + n * first;
        settle(e, own, step, q + n * first, here, states, found);
        for (long row = 0; row < here; ++row)
            for (long i = 0; i < n; ++i) at[n * row + i] = found[row] ? states[row].x[i] : NAN;
        shapes(e, own, step, at, here, sigma, samples, 0, points + 3 * samples * first, tips + 3 * first);
        margins(e, own, step, at, here, margin + first);
    }
}
