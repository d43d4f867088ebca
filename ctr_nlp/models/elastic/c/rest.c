/* Robots at rest without a history, several side by side; branch.c, margin.c, energy.c and fall.c come before this
   file. */

enum { NONE = -1 };

/* A robot on its way from where all tubes' tips bend alike, towards alpha_d: the row that it is, the way, the equilibrium that is
   looked for at a place, where it is predicted, and steps of Newton's method and falls until now. on_way: whether the aligned
   one is found. */
typedef struct {
    Way way;
    State to;
    double place[SIDE], ahead[SIDE];
    const double *goal;
    long row, steps, falls;
    int on_way;
} Turned;

static void aligned(const Elastic *e, Turned *robot, const double *q, long row) {
    long d = e->d, n = 2 * d + 2;
    memset(robot, 0, sizeof *robot);
    robot->row = row, robot->goal = q;
    memcpy(robot->place, q, n * sizeof *q);
    robot->to.x[d - 1] = q[d - 1], robot->to.stable = 1;
    memcpy(robot->to.x + d, q + d, (d + 2) * sizeof *q);
}

/* Look for the equilibrium after the next part of the way that is foreseen; whether there is one. */
static int looks_on(const Elastic *e, Turned *robot) {
    Way *way = &robot->way;
    while (way->part >= e->smallest && !foreseen(e, 0, way, robot->place, robot->ahead)) way->part /= 2;
    robot->to = way->at, robot->steps = 0;
    memcpy(robot->to.x, robot->ahead, e->d * sizeof *robot->ahead);
    return way->part >= e->smallest;
}

/* What becomes of a robot by a step of Newton's method from motors' angles alpha: whether it is on its way still. At
   its end way.done is 1. The aligned robot is one from the beginning, wherever its motors are. */
static int turned_on(const Elastic *e, Turned *robot, const double *alpha) {
    Way *way = &robot->way;
    if (!robot->on_way) memcpy(robot->place, alpha, e->d * sizeof *alpha);
    double size = improved(e, robot->place, alpha, &robot->to), most = 0;
    int found = size < (robot->on_way && !at_end(way) ? e->near : e->converged);
    if (!found && size <= 1 && ++robot->steps < e->iterations) return 1;
    memcpy(robot->to.q, robot->place, (2 * e->d + 2) * sizeof *robot->place);
    if (robot->on_way) {
        if (!found || !as_predicted(e, robot->ahead, &robot->to) || !alike(&way->at, &robot->to))
            way->part /= 2;
        else if (gone_on(way, &robot->to))
            return 0;
        return looks_on(e, robot);
    }
    if (!found) return 0;
    for (long i = 0; i < e->d; ++i) most = fmax(most, fabs(robot->goal[i] - robot->place[i]));
    robot->on_way = 1;
    set_off(e, way, &robot->to, robot->goal, e->stride / most);
    return looks_on(e, robot);
}

/* The same, with falls where a way ends early; whether the robot is on its way still. */
static int goes_on(const Elastic *e, const double *numbers, Turned *robot, const double *alpha) {
    Way *way = &robot->way;
    int on = turned_on(e, robot, alpha);
    while (!on && robot->on_way && way->done < 1 && robot->falls++ < MOST_FALLS &&
           fallen(e, numbers, &way->at, robot->goal)) {
        set_off(e, way, &way->at, robot->goal, 1);
        on = looks_on(e, robot);
    }
    return on;
}

/* Turn all tubes from alpha_d to where they are at every q, with steps in numbers from row to row; the states there,
   and whether each was found; one that was not is not stable. Where there are several rows, LANES of them are on their
   way at once. */
void settle(const Elastic *e, const double *numbers, long step, const double *q, long rows, State *states,
            long *found) {
    long d = e->d, n = 2 * d + 2, lanes = rows > 2 ? LANES : 1, next = 0, left = rows;
    Turned robots[LANES];
    double x[LANES * SIDE], alpha[LANES * MOST_TUBES], slopes[LANES * MOST_TUBES * MOST_TUBES];
    double own[LANES * MOST_TUBES * NUMBERS] = {0};
    const double *arg[] = {x, own};
    double *res[] = {alpha, slopes};
    for (long l = 0; l < LANES; ++l) robots[l].row = NONE;
    while (left > 0) {
        for (long l = 0; l < lanes; ++l) {
            if (robots[l].row == NONE && next < rows) {
                aligned(e, robots + l, q + n * next, next);
                memcpy(own + d * NUMBERS * l, numbers + step * next++, d * NUMBERS * sizeof *own);
            }
            memcpy(x + n * l, robots[robots[l].row == NONE ? 0 : l].to.x, n * sizeof *x);
        }
        (lanes > 1 ? e->motors_beside : e->motors)(arg, res, 0, 0, 0);
        for (long l = 0; l < lanes; ++l) {
            Turned *robot = robots + l;
            if (robot->row == NONE) continue;
            take_slopes(e, slopes, l, &robot->to);
            if (goes_on(e, own + d * NUMBERS * l, robot, alpha + d * l)) continue;
            states[robot->row] = robot->way.at, found[robot->row] = robot->way.done >= 1;
            states[robot->row].stable &= found[robot->row];
            robot->row = NONE, --left;
        }
    }
}
