/* Rows of the balances from the last samples, as identification.online.rows.RowMaker makes them. */

static void clear_rows(Twin *m) {
    memset(&m->s.rows, 0, sizeof m->s.rows);
    align(m);
}

/* Signals at their true time, from the newest readings. */
static void take_aligned(Rows *r, const double reading[SOURCES], double sample[SOURCES]) {
    int i, k;
    if (!r->any)
        for (i = 0; i < TAPS; i++) memcpy(r->recent[i], reading, sizeof r->recent[i]);
    memmove(r->recent[0], r->recent[1], (TAPS - 1) * sizeof r->recent[0]);
    memcpy(r->recent[TAPS - 1], reading, sizeof r->recent[0]);
    for (k = 0; k < SOURCES; k++)
        for (i = 0, sample[k] = 0; i < TAPS; i++) sample[k] += r->tap[i][k] * r->recent[i][k];
}

static void append_sample(Rows *r, const double read[SOURCES]) {
    double reading[SOURCES], sample[SOURCES];
    int i;
    memcpy(reading, read, sizeof reading);
    reading[LINK_SOURCE] -= r->zero;
    take_aligned(r, reading, sample);
    if (!r->any) { /* before the first sample stands the first sample */
        for (i = 0; i < 2 * WINDOW; i++) memcpy(r->history[i], sample, sizeof r->history[i]);
        r->any = 1;
    }
    memcpy(r->history[r->end], sample, sizeof r->history[0]);
    memcpy(r->history[r->end + WINDOW], sample, sizeof r->history[0]);
    r->end = (r->end + 1) % WINDOW;
}

/* A signal or a derivative of it. The value in the middle is taken off before differences are formed, so that the
 * derivatives of a signal that stands still are zero and not rounding. */
static double correlate(const double weights[], int half, const double (*at)[SOURCES], int source, int order) {
    const double middle = order ? at[half][source] : 0;
    double sum = 0;
    int i;
    for (i = 0; i < 2 * half + 1; i++) sum += weights[i] * (at[i][source] - middle);
    return sum;
}

/* Signals at the new points, the laws there, and their place in the rings. */
static void evaluate_points(Twin *m, const double (*window)[SOURCES]) {
    Rows *r = &m->s.rows;
    int k, i;
    memset(m->smooth, 0, sizeof m->smooth);
    memset(m->raw, 0, sizeof m->raw);
    for (k = 0; k < NEW_POINTS; k++) {
        double *smooth = m->smooth + k * N_SIGNALS, *raw = m->raw + k * N_SIGNALS;
        for (i = 0; i < PLACES; i++)
            raw[place_signal[i]] = smooth[place_signal[i]] =
                correlate(smooth_kernel[i], SMOOTH_HALF, window + (point_at[k] - SMOOTH_HALF), place_source[i], place_order[i]);
        for (i = 0; i < SOURCES; i++) raw[source_signal[i]] = window[point_at[k]][i];
    }
    m->arg[0] = m->raw; m->arg[1] = m->smooth; m->arg[2] = r->before; m->arg[3] = r->held; m->arg[4] = &r->started;
    m->res[0] = m->laws; m->res[1] = m->before_next; m->res[2] = m->held_next;
    points(m->arg, m->res, m->iw, m->w, 0);
    memcpy(r->before, m->before_next, sizeof r->before);
    memcpy(r->held, m->held_next, sizeof r->held);
    r->started = 1;
    memmove(r->ring[0], r->ring[NEW_POINTS], (POINTS - NEW_POINTS) * sizeof r->ring[0]);
    memmove(r->speed[0], r->speed[NEW_POINTS], (POINTS - NEW_POINTS) * sizeof r->speed[0]);
    for (k = 0; k < NEW_POINTS; k++) {
        memcpy(r->ring[POINTS - NEW_POINTS + k], m->laws + k * N_NEEDED, N_NEEDED * sizeof(double));
        for (i = 0; i < 2; i++) r->speed[POINTS - NEW_POINTS + k][i] = m->raw[k * N_SIGNALS + speed_signal[i]];
    }
}

/* y and h of a row; 0 until the kernel is filled. */
static int make_row(Twin *m, double time) {
    Rows *r = &m->s.rows;
    const double(*window)[SOURCES] = (const double(*)[SOURCES])(r->history + r->end);
    double full[N_BALANCES * (1 + N_THETA)] = {0};
    int i, k, b;
    if (N_NEEDED) evaluate_points(m, window);
    r->made++;
    for (i = 0; i < PLACES; i++)
        r->signals[place_signal[i]] =
            correlate(average_kernel[place_order[i]], AVERAGE_HALF, window + (CENTRE - AVERAGE_HALF), place_source[i], place_order[i]);
    r->signals[0] = time - r->lead * SAMPLE_TIME - DELAY;
    for (i = 0; i < N_LINEAR; i++) full[linear_row[i]] += linear_value[i] * r->signals[linear_column[i]];
    for (i = 0; i < N_NEEDED; i++) {
        const double *weight = i < N_AVERAGED ? point_weight : rate_weight;
        double sum = 0;
        for (k = 0; k < POINTS; k++) sum += weight[k] * r->ring[k][i];
        full[needed[i]] += sum;
    }
    if (r->made <= ROWS_BEFORE_READY) return 0;
    for (b = 0; b < N_BALANCES; b++) {
        double freed = 0;
        for (i = 0; i < N_THETA; i++) {
            m->h[b * N_THETA + i] = -full[b * (1 + N_THETA) + 1 + i];
            freed += m->h[b * N_THETA + i] * m->s.off[i];
        }
        m->y[b] = full[b * (1 + N_THETA)] + freed;
    }
    return 1;
}

/* Shares of the kernel in which motor and link stand still or turn round, as far as their noise lets one see. */
static void standstill(Twin *m, double share[2]) {
    const double noise[2] = {m->s.watch.noise[Q_M], m->s.watch.noise[Q_L]};
    share[0] = share[1] = 0;
    if (!N_NEEDED) return;
    m->arg[0] = m->s.rows.speed[0]; m->arg[1] = noise; m->arg[2] = sharp;
    m->res[0] = share;
    still(m->arg, m->res, m->iw, m->w, 0);
}

static const int reading[SOURCES] = {Q_M, Q_L, TAU, DRIVE}; /* behind the sampled signals */

/* Variance that sensor noise gives each entry of h. */
static void entry_noise(const State *s, double out[N_BALANCES * N_THETA]) {
    int k, source;
    for (k = 0; k < N_BALANCES * N_THETA; k++) {
        out[k] = 0;
        for (source = 0; source < SOURCES; source++) {
            const double noise = s->watch.noise[reading[source]];
            out[k] += entry_gain[k * SOURCES + source] * (noise * noise);
        }
    }
}

/* RMS that sensor noise alone leaves in each balance. */
static void noise_floor(Twin *m, const double theta[N_THETA], double out[N_BALANCES]) {
    State *s = &m->s;
    double entering[N_BALANCES][N_SIGNALS] = {{0}}, values[N_VALUES], slope[3 * N_BALANCES];
    int i, j, b, source;
    for (i = 0; i < N_LINEAR; i++) {
        const int column = linear_row[i] % (1 + N_THETA);
        entering[linear_row[i] / (1 + N_THETA)][linear_column[i]] += linear_value[i] * (column ? theta[column - 1] : 1.0);
    }
    memcpy(values, fixed_value, sizeof values);
    for (i = 0; i < N_THETA; i++) values[theta_value[i]] = theta[i];
    m->arg[0] = s->rows.signals; m->arg[1] = s->rows.held; m->arg[2] = values;
    m->res[0] = slope;
    slopes(m->arg, m->res, m->iw, m->w, 0);
    for (b = 0; b < N_BALANCES; b++) {
        double variance = 0;
        for (source = 0; source < SOURCES; source++) {
            const double noise = s->watch.noise[reading[source]];
            double size = 0;
            for (j = 0; j < 2 * AVERAGE_HALF + 1; j++) {
                double combined = 0;
                for (i = 0; i < PLACES; i++) {
                    double coefficient;
                    if (place_source[i] != source) continue;
                    coefficient = entering[b][place_signal[i]];
                    if (place_order[i] == 0 && source < 3 && coefficient == 0) coefficient = slope[source * N_BALANCES + b];
                    combined += coefficient * average_kernel[place_order[i]][j];
                }
                size += combined * combined;
            }
            variance += noise * noise * size;
        }
        out[b] = sqrt(variance);
    }
}
