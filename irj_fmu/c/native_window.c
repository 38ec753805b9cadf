/* Start of the recursion from the first window: identification.online.first_window, identification.recursive.prior_start, OnlineEstimator._begin. */

/* Weights of the balances' rows at a reversal, where friction may take any value between its limits. */
static void weight_of(Twin *m, const double shares[2], const double theta[N_THETA], const double size[N_BALANCES], double out[N_BALANCES]) {
    m->arg[0] = shares; m->arg[1] = theta; m->arg[2] = size;
    m->res[0] = out;
    row_weight(m->arg, m->res, m->iw, m->w, 0);
}

/* Mean square under which an entry of h does not count: RecursiveLeastSquares.set_entry_noise. */
static void tell_noise(State *s) {
    int k;
    entry_noise(s, s->rls.config + CONFIG_HIDES);
    for (k = 0; k < N_BALANCES * N_THETA; k++) s->rls.config[CONFIG_HIDES + k] *= SHOWN_OVER * (s->scale[k % N_THETA] * s->scale[k % N_THETA]);
}

/* The window without the entries of h that stand in their own noise, and the mean squares at its end: told_beside_noise. */
static void told_beside_noise(Twin *m, double square[N_BALANCES * N_THETA]) {
    State *s = &m->s;
    FirstWindow *f = &s->window;
    double noise[N_BALANCES * N_THETA];
    int k, b, i;
    entry_noise(s, noise);
    for (k = 0; k < f->count; k++)
        for (b = 0; b < N_BALANCES; b++) {
            double off = 0;
            for (i = 0; i < N_THETA; i++) {
                const int at = b * N_THETA + i;
                const double own = f->h[k][b][i] * f->h[k][b][i];
                square[at] = k ? square[at] + SHOWN_RATE * (own - square[at]) : own;
                if (square[at] >= SHOWN_OVER * noise[at]) continue;
                off += f->h[k][b][i] * s->theta[i];
                f->h[k][b][i] = 0;
            }
            f->y[k][b] -= off;
        }
}

static double error_of(const double y, const double h[N_THETA], const double theta[N_THETA]) {
    double sum = 0;
    int i;
    for (i = 0; i < N_THETA; i++) sum += h[i] * theta[i];
    return y - sum;
}

/* The rows of the window with their weights, each balance reduced to a triangle of [h | y]. */
static void reduce_window(Twin *m) {
    const FirstWindow *f = &m->s.window;
    int k, b, i;
    for (b = 0; b < N_BALANCES; b++) {
        for (k = 0; k < f->count; k++) {
            const double weight = m->weight[k][b];
            for (i = 0; i < N_THETA; i++) m->matrix[k][i] = f->h[k][b][i] * weight;
            m->matrix[k][N_THETA] = f->y[k][b] * weight;
        }
        triangularise(m->matrix, f->count);
        memcpy(m->triangle[b], m->matrix, sizeof m->triangle[b]);
    }
}

/* Sum of squares of a column of a balance: of a regressor, or of y. */
static double column_square(const Twin *m, int b, int column) {
    double sum = 0;
    int i;
    for (i = 0; i <= column; i++) sum += m->triangle[b][i][column] * m->triangle[b][i][column];
    return sum;
}

/* Sum of squares of a balance's residual. */
static double residual_square(const Twin *m, int b, const double theta[N_THETA]) {
    double sum = 0;
    int i, j;
    for (i = 0; i < COLUMNS; i++) {
        double left = m->triangle[b][i][N_THETA];
        for (j = i; j < N_THETA; j++) left -= m->triangle[b][i][j] * theta[j];
        sum += left * left;
    }
    return sum;
}

/* Triangle of all balances, columns times `scale`, rows times `weight`, y less what theta explains, and of rows `prior` x = 0. */
static void stack_balances(Twin *m, const double scale[N_THETA], const double weight[N_BALANCES], const double theta[N_THETA], double prior) {
    int b, i, j;
    for (b = 0; b < N_BALANCES; b++)
        for (i = 0; i < COLUMNS; i++) {
            const double *from = m->triangle[b][i];
            double *row = m->matrix[b * COLUMNS + i], left = from[N_THETA];
            for (j = 0; j < N_THETA; j++) {
                row[j] = from[j] * scale[j] * weight[b];
                left -= from[j] * theta[j];
            }
            row[N_THETA] = left * weight[b];
        }
    for (i = 0; i < N_THETA; i++) {
        double *row = m->matrix[N_BALANCES * COLUMNS + i];
        for (j = 0; j < COLUMNS; j++) row[j] = i == j ? prior : 0;
    }
    triangularise(m->matrix, N_BALANCES * COLUMNS + N_THETA);
}

/* Each size the largest of those that are of one size: control values of one curve. */
static void share(double size[N_THETA]) {
    double most[N_THETA] = {0};
    int i;
    for (i = 0; i < N_THETA; i++) most[like[i]] = fmax(most[like[i]], size[i]);
    for (i = 0; i < N_THETA; i++) size[i] = most[like[i]];
}

/* Least squares of the weighted window with columns of equal size and balances of equal residual. */
static void least_squares(Twin *m, const double least[N_BALANCES], double theta[N_THETA]) {
    const double none[N_THETA] = {0};
    const int count = m->s.window.count;
    double weight[N_BALANCES], size[N_THETA];
    int pass, b, i;
    reduce_window(m);
    for (b = 0; b < N_BALANCES; b++) weight[b] = 1 / fmax(sqrt(column_square(m, b, N_THETA) / count), least[b]);
    for (pass = 0; pass < 2; pass++) {
        for (i = 0; i < N_THETA; i++) {
            size[i] = 0;
            for (b = 0; b < N_BALANCES; b++) size[i] += weight[b] * weight[b] * column_square(m, b, i);
            size[i] = sqrt(size[i]);
        }
        share(size);
        for (i = 0; i < N_THETA; i++) size[i] = size[i] > ABSENT ? 1 / size[i] : 0;
        stack_balances(m, size, weight, none, RIDGE);
        back_substitute(m->matrix, theta);
        for (i = 0; i < N_THETA; i++) theta[i] *= size[i];
        for (b = 0; b < N_BALANCES; b++) weight[b] = 1 / fmax(sqrt(residual_square(m, b, theta) / count), least[b]);
    }
}

static double median(double v[], int n) {
    const double upper = select_value(v, n, n / 2);
    double lower = upper;
    int i;
    if (n % 2) return upper;
    for (i = 0, lower = v[0]; i < n / 2; i++) lower = fmax(lower, v[i]);
    return (lower + upper) / 2;
}

/* First parameters, with rows at reversals weighted down; leaves the triangles of the weighted window. */
static void robust_fit(Twin *m, const double least[N_BALANCES], double first[N_THETA]) {
    const FirstWindow *f = &m->s.window;
    double size[N_BALANCES];
    int pass, k, b;
    for (k = 0; k < f->count; k++)
        for (b = 0; b < N_BALANCES; b++) m->weight[k][b] = 1;
    for (pass = 0; pass < FIRST_PASSES; pass++) {
        least_squares(m, least, first);
        for (b = 0; b < N_BALANCES; b++) {
            for (k = 0; k < f->count; k++) m->sorted[k] = fabs(error_of(f->y[k][b], f->h[k][b], first));
            size[b] = fmax(FIRST_DEVIATION * median(m->sorted, f->count), least[b]);
        }
        for (k = 0; k < f->count; k++) weight_of(m, f->shares[k], first, size, m->weight[k]);
    }
    reduce_window(m);
}

/* Smallest prior range of each parameter: what moves the balances by a hundredth of their torque. */
static void least_range(const Twin *m, double out[N_THETA]) {
    const double rows = (double)m->s.window.count * N_BALANCES;
    double level = 0;
    int b, i;
    for (b = 0; b < N_BALANCES; b++) level += column_square(m, b, N_THETA);
    level = sqrt(level / rows);
    if (level == 0) level = 1;
    for (i = 0; i < N_THETA; i++) {
        double size = 0;
        for (b = 0; b < N_BALANCES; b++) size += column_square(m, b, i);
        out[i] = sqrt(size / rows);
    }
    share(out);
    for (i = 0; i < N_THETA; i++) out[i] = out[i] > ABSENT ? FIRST_RANGE * level / out[i] : 1;
}

/* P in scaled parameters as U diag(d) U'. */
static void factorise(double p[N_THETA][N_THETA], double d[N_THETA], double u[]) {
    int i, j, k;
    for (j = N_THETA - 1; j >= 0; j--) {
        for (i = j; i >= 0; i--) {
            double sum = p[i][j];
            for (k = j + 1; k < N_THETA; k++) sum -= p[i][k] * p[j][k] * d[k];
            if (i == j) { d[j] = fmax(sum, TINY); p[j][j] = 1; }
            else { p[i][j] = sum / d[j]; u[j * (j - 1) / 2 + i] = p[i][j]; }
        }
    }
}

/* Start values and covariance from the window and the prior theta0 +- scale. Gives the number of parameters that they do not
 * determine. */
static int start_values(Twin *m, const double theta0[N_THETA], const double scale[N_THETA], const double least[N_BALANCES], double theta[N_THETA]) {
    State *s = &m->s;
    Recursion *r = &s->rls;
    const int count = s->window.count;
    const double degrees = fmax(1, count - (double)N_THETA / N_BALANCES);
    double noise[N_BALANCES], weight[N_BALANCES], step[N_THETA], inverse[N_THETA][N_THETA] = {{0}}, p[N_THETA][N_THETA];
    int pass, i, j, k, b, undetermined = 0;
    for (b = 0; b < N_BALANCES; b++) noise[b] = fmax(residual_square(m, b, theta0) / count, fmax(least[b] * least[b], DBL_MIN));
    for (pass = 0; pass <= PRIOR_PASSES; pass++) {
        for (b = 0; b < N_BALANCES; b++) weight[b] = 1 / sqrt(OVERLAP * noise[b]);
        stack_balances(m, scale, weight, theta0, 1);
        back_substitute(m->matrix, step);
        for (i = 0; i < N_THETA; i++) theta[i] = theta0[i] + scale[i] * step[i];
        for (b = 0; b < N_BALANCES; b++) noise[b] = fmax(residual_square(m, b, theta) / degrees, fmax(least[b] * least[b], DBL_MIN));
    }
    for (j = 0; j < N_THETA; j++) /* inverse of the triangle, column by column */
        for (i = j; i >= 0; i--) {
            double sum = i == j;
            for (k = i + 1; k <= j; k++) sum -= m->matrix[i][k] * inverse[k][j];
            inverse[i][j] = sum / m->matrix[i][i];
        }
    for (i = 0; i < N_THETA; i++)
        for (j = 0; j < N_THETA; j++) {
            double sum = 0;
            for (k = i > j ? i : j; k < N_THETA; k++) sum += inverse[i][k] * inverse[j][k];
            undetermined += i == j && sum > UNDETERMINED;
            p[i][j] = sum * start_config[CONFIG_START];
        }
    for (i = 0; i < N_THETA; i++) r->fast[FAST_THETA + i] = theta[i] / scale[i];
    factorise(p, r->fast + FAST_D, r->fast + FAST_U);
    memcpy(r->fast + FAST_NOISE, noise, sizeof noise);
    r->fast[FAST_LEARNED] = count;
    return undetermined;
}

/* Forgetting as the options say. */
static void tune_recursion(State *s) {
    int i;
    for (i = 0; i < N_THETA; i++) {
        const double calm = s->drift * s->drift * ROW_PERIOD, raised = s->alarm_drift * s->alarm_drift * ROW_PERIOD;
        s->rls.config[CONFIG_WALK + i] = calm;
        s->rls.config[CONFIG_WALK_ALARM + i] = fmax(calm, raised);
    }
}

static void clear_recursion(State *s) {
    int i;
    memcpy(s->rls.config, start_config, sizeof start_config);
    memcpy(s->rls.fast, start_fast, sizeof start_fast);
    memcpy(s->rls.slow, start_slow, sizeof start_slow);
    for (i = 0; i < N_THETA; i++) {
        s->rls.config[CONFIG_SCALE + i] = s->scale[i];
        s->rls.config[CONFIG_THETA0 + i] = s->theta[i];
    }
    tune_recursion(s);
}

/* Standard deviations of the estimate. */
static void deviations(const State *s, double sigma[N_THETA]) {
    int i, j;
    for (i = 0; i < N_THETA; i++) {
        double sum = s->rls.fast[FAST_D + i];
        for (j = i + 1; j < N_THETA; j++) {
            const double u = s->rls.fast[FAST_U + j * (j - 1) / 2 + i];
            sum += u * s->rls.fast[FAST_D + j] * u;
        }
        sigma[i] = sqrt(sum * (s->scale[i] * s->scale[i]));
    }
}

/* Keep a row of the first window. */
static void keep_row(Twin *m) {
    State *s = &m->s;
    FirstWindow *f = &s->window;
    int b;
    memcpy(f->y[f->count], m->y, sizeof m->y);
    memcpy(f->h[f->count], m->h, sizeof m->h);
    standstill(m, f->shares[f->count]);
    for (b = 0; b < N_BALANCES; b++) s->torque[b] += s->rows.signals[reference_signal[b]] * s->rows.signals[reference_signal[b]];
    f->count++;
}

/* Make the collected rows again, the readings freed of what the sensors are off by. */
static void make_again(Twin *m, double time) {
    State *s = &m->s;
    int k;
    clear_rows(m);
    memset(&s->window, 0, sizeof s->window);
    memset(s->torque, 0, sizeof s->torque);
    for (k = 0; k < s->n_heard; k++) {
        append_sample(&s->rows, s->heard[k]);
        if (k % STRIDE == STRIDE - 1 && make_row(m, time - (s->n_heard - 1 - k) * SAMPLE_TIME) && s->told[k / STRIDE]) keep_row(m);
    }
}

/* A recursion from the collected rows; gives the number of parameters that they do not determine. */
static int start_recursion(Twin *m, double least[N_BALANCES]) {
    State *s = &m->s;
    double first[N_THETA], range[N_THETA], known[N_THETA], floor[N_BALANCES];
    double square[N_BALANCES * N_THETA];
    int i, b, k, undetermined;
    told_beside_noise(m, square);
    for (b = 0; b < N_BALANCES; b++) least[b] = fmax(s->floor_share * sqrt(s->torque[b] / s->window.count), LEAST);
    robust_fit(m, least, first);
    noise_floor(m, first, floor);
    for (b = 0; b < N_BALANCES; b++) least[b] = fmax(least[b], floor[b]);
    least_range(m, range);
    for (i = 0; i < N_THETA; i++) known[i] = fmax(fabs(first[i]), fabs(s->theta[i]));
    share(known);
    for (i = 0; i < N_THETA; i++) s->scale[i] = usual_range[i] > 0 ? usual_range[i] : fmax(known[i], range[i]);
    clear_recursion(s);
    undetermined = start_values(m, s->rls.config + CONFIG_THETA0, s->scale, least, first);
    for (k = 0; k < N_BALANCES * N_THETA; k++) s->rls.fast[FAST_SIZE + k] = square[k] * (s->scale[k % N_THETA] * s->scale[k % N_THETA]);
    tell_noise(s);
    return undetermined;
}

/* Start the recursion from the collected rows; gives the number of parameters that they do not determine. */
static int begin_recursion(Twin *m, double time) {
    State *s = &m->s;
    double theta[N_THETA], sigma[N_THETA], least[N_BALANCES];
    int undetermined = start_recursion(m, least), free, round, b;
    for (free = !(N_ZEROS && HAS_VALUES); free < 2 && s->n_heard; free++)
        for (round = 0; round < CALIBRATION_ROUNDS; round++) {
            estimate_of(s, &s->rls, theta);
            deviations(s, sigma);
            if (!free) held_unknowns(m, theta, sigma);
            if (!take_calibration(m, theta, sigma, least)) break;
            make_again(m, time);
            undetermined = start_recursion(m, least);
        }
    estimate_of(s, &s->rls, theta);
    for (b = 0; b < N_BALANCES; b++) s->torque[b] /= s->window.count;
    show(s, theta);
    deviations(s, s->sigma);
    for (b = 0; b < N_BALANCES; b++) s->square[b] = residual_square(m, b, s->theta) / s->window.count;
    memset(&s->window, 0, sizeof s->window);
    s->n_heard = 0;
    s->rls.running = 1;
    guard_start(s);
    return undetermined;
}
