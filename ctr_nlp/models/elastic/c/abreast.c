/* Robots that walk side by side, each on its own way; branch.c comes before this file. */

/* Newton's method for the robots that go on, at goals from to[l].x; goes: which of them end. */
static void newton_abreast(const Elastic *e, const double *numbers, const double *const *goals, State *to, int *goes) {
    long d = TUBES(e), n = 2 * d + 2, left = 0;
    int open[LANES];
    double x[LANES * SIDE], alpha[LANES * MOST_TUBES], slopes[LANES * MOST_TUBES * MOST_TUBES];
    const double *arg[] = {x, numbers};
    double *res[] = {alpha, slopes};
    for (long l = 0; l < LANES; ++l) left += open[l] = goes[l];
    for (long k = 0; k < e->iterations && left; ++k) {
        for (long l = 0; l < LANES; ++l) memcpy(x + n * l, to[l].x, n * sizeof *x);
        CALL(e, motors_beside)(arg, res, 0, 0, 0);
        for (long l = 0; l < LANES; ++l) {
            if (!open[l]) continue;
            take_slopes(e, slopes, l, to + l);
            double size = improved(e, goals[l], alpha + d * l, to + l);
            if (size > 1 || size < e->converged) --left, open[l] = 0, goes[l] = size < e->converged;
        }
    }
    for (long l = 0; l < LANES; ++l) goes[l] &= !open[l];
}

/* Whether a motion from `before` through a state goes straight on to goal, as far as it came. */
static int straight_on(const Elastic *e, const double *before, const State *at, const double *goal) {
    double bend[SIDE];
    for (long i = 0; i < 2 * TUBES(e) + 2; ++i) bend[i] = goal[i] - 2 * at->q[i] + before[i];
    return largest(bend, 2 * TUBES(e) + 2) < 1e-9;
}

/* Follow the branches of up to LANES robots, numbers (LANES, ..), side by side through as many goals each, `apart`
   doubles from robot to robot, in one step from goal to goal; x: the equilibria, as far apart; reached: how many of
   each. A robot that needs shorter steps stays behind, and those that are unstable. */
void walk_abreast(const Elastic *e, const double *numbers, State *states, long robots, const double *goals,
                  long apart, long count, double *x, long *reached) {
    long d = TUBES(e), n = 2 * d + 2, left = robots;
    int goes[LANES];
    State to[LANES];
    double at[LANES * SIDE], ahead[LANES * SIDE], alpha[LANES * MOST_TUBES];
    double slopes[LANES * MOST_TUBES * MOST_TUBES], from[LANES * SIDE], before[LANES * SIDE];
    const double *arg[] = {at, numbers}, *goal[LANES];
    double *res[] = {alpha, slopes};
    for (long l = 0; l < LANES; ++l) goes[l] = l < robots && states[l].stable, reached[l] = 0;
    for (long k = 0; k < count && left; ++k) {
        /* On a straight way what the last step turned tips by is a prediction, and costs nothing. */
        int straight = k > 0;
        for (long l = 0; l < LANES; ++l) {
            long own = l < robots ? l : 0;
            goal[l] = goals + own * apart + k * n;
            straight = straight && (!goes[l] || straight_on(e, from + SIDE * l, states + l, goal[l]));
            to[l] = states[own];
            memcpy(to[l].q, goal[l], n * sizeof *at);
            memcpy(to[l].x + d, goal[l] + d, (d + 2) * sizeof *at);
            memcpy(at + n * l, to[l].x, n * sizeof *at);
        }
        if (!straight) CALL(e, motors_beside)(arg, res, 0, 0, 0);
        for (long l = 0; l < robots; ++l) {
            double turn[MOST_TUBES];
            if (!goes[l]) continue;
            for (long i = 0; i < d; ++i)
                turn[i] = straight ? to[l].x[i] - before[SIDE * l + i] : goal[l][i] - alpha[i + d * l];
            if (straight || solved_for(d, states[l].slopes, turn) != 0)
                for (long i = 0; i < d; ++i) to[l].x[i] += turn[i];
            memcpy(ahead + SIDE * l, to[l].x, d * sizeof *ahead);
            goes[l] = near_enough(e, states + l, goal[l], ahead + SIDE * l);
        }
        newton_abreast(e, numbers, goal, to, goes);
        left = 0;
        for (long l = 0; l < robots; ++l) {
            goes[l] = goes[l] && as_predicted(e, ahead + SIDE * l, to + l) && alike(states + l, to + l);
            if (!goes[l]) continue;
            memcpy(from + SIDE * l, states[l].q, n * sizeof *from);
            memcpy(before + SIDE * l, states[l].x, d * sizeof *before);
            states[l] = to[l];
            memcpy(x + l * apart + k * n, to[l].x, n * sizeof *at);
            reached[l] = k + 1, ++left;
        }
    }
}
