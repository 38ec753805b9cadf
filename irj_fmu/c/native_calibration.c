/* What the sensors of a run are off by, taken off their readings: identification.online.calibration.Calibration, identification.online.timing.Alignment. */

static int newest(double late) { /* samples after a point that its value needs */
    return (int)ceil(late) + (late != floor(late));
}

/* Weights of the last readings, whose sum is each signal at its true time. */
static void align(Twin *m) {
    Rows *r = &m->s.rows;
    double late[SOURCES], part, weight[4];
    int i, k;
    memcpy(late, delay_samples, sizeof late);
    for (i = 0; i < N_SKEWS; i++) late[skew_source[i]] += m->s.off[skew_theta[i]] / SAMPLE_TIME;
    memset(r->tap, 0, sizeof r->tap);
    r->lead = 0;
    for (k = 0; k < SOURCES; k++)
        if (newest(late[k]) > r->lead) r->lead = newest(late[k]);
    for (k = 0; k < SOURCES; k++) {
        const double age = r->lead - late[k];
        const int whole = (int)floor(age);
        part = age - whole;
        if (part == 0) {
            r->tap[TAPS - 1 - whole][k] = 1;
            continue;
        }
        m->arg[0] = &part;
        m->res[0] = weight;
        cubic(m->arg, m->res, m->iw, m->w, 0);
        for (i = 0; i < 4; i++) r->tap[TAPS - whole - i][k] = weight[i];
    }
    r->zero = 0;
    for (i = 0; i < N_ZEROS; i++) r->zero += m->s.off[zero_theta[i]];
}

/* All parameters with the unknowns of the sensors as they are where the joint is as in its file; from the triangles of the weighted
 * window. */
static void held_unknowns(const Twin *m, double theta[N_THETA], double sigma[N_THETA]) {
    const int count = N_UNKNOWNS;
    double a[DIM(N_UNKNOWNS)][2 * DIM(N_UNKNOWNS)] = {{0}}, target[DIM(N_UNKNOWNS)] = {0}, size[DIM(N_UNKNOWNS)], beside[N_THETA];
    int i, j, k, b, p, q;
    for (i = 0; i < N_THETA; i++) {
        beside[i] = theta[i] = m->s.theta[i];
        sigma[i] = 0;
    }
    for (p = 0; p < count; p++) beside[unknown_theta[p]] = 0;
    for (b = 0; b < N_BALANCES; b++) {
        const double noise = OVERLAP * m->s.rls.fast[FAST_NOISE + b];
        for (i = 0; i < COLUMNS; i++) {
            const double *row = m->triangle[b][i];
            double left = row[N_THETA];
            for (j = 0; j < N_THETA; j++) left -= row[j] * beside[j];
            for (p = 0; p < count; p++) {
                target[p] += row[unknown_theta[p]] * left / noise;
                for (q = 0; q < count; q++) a[p][q] += row[unknown_theta[p]] * row[unknown_theta[q]] / noise;
            }
        }
    }
    for (p = 0; p < count; p++) {
        const double usual = usual_range[unknown_theta[p]];
        size[p] = a[p][p] > 0; /* no row says anything of one without */
        if (size[p] > 0 && usual > 0) a[p][p] += 1 / (usual * usual);
        if (size[p] > 0) size[p] = sqrt(a[p][p]);
    }
    for (p = 0; p < count; p++) {
        for (q = 0; q < count; q++) a[p][q] = size[p] > 0 && size[q] > 0 ? a[p][q] / (size[p] * size[q]) : p == q;
        a[p][count + p] = 1;
    }
    for (k = 0; k < count; k++) { /* inverse of a positive definite matrix: no pivoting */
        const double head = a[k][k];
        for (q = 0; q < 2 * count; q++) a[k][q] /= head;
        for (p = 0; p < count; p++) {
            const double factor = a[p][k];
            for (q = 0; p != k && q < 2 * count; q++) a[p][q] -= factor * a[k][q];
        }
    }
    for (p = 0; p < count; p++) {
        double sum = 0;
        if (!(size[p] > 0)) continue;
        for (q = 0; q < count; q++)
            if (size[q] > 0) sum += a[p][count + q] * target[q] / size[q];
        theta[unknown_theta[p]] = sum / size[p];
        sigma[unknown_theta[p]] = sqrt(a[p][count + p]) / size[p];
    }
}

/* A zero whose whole torque is less than what counts as noise is too little to begin anew. */
static double small_zero(const Twin *m, int at, const double least[N_BALANCES]) {
    double size = 0;
    int i, b;
    for (b = 0; b < N_BALANCES; b++) {
        double own = 0;
        for (i = 0; i <= at; i++) own += m->triangle[b][i][at] * m->triangle[b][i][at];
        size = fmax(size, sqrt(own / m->s.window.count) / least[b]);
    }
    return size > 0 ? 1 / size : INFINITY;
}

/* Take off what rows have told; 0 where that is too little. */
static int take_calibration(Twin *m, const double theta[N_THETA], const double sigma[N_THETA], const double least[N_BALANCES]) {
    State *s = &m->s;
    double part = 1;
    int i, moved = 0;
    for (i = 0; i < N_THETA; i++)
        if (s->off[i] != 0) part = CALIBRATION_FURTHER;
    for (i = 0; i < N_SKEWS; i++) {
        const int at = skew_theta[i];
        const double value = fmin(fmax(theta[at], -MOST_LATE), MOST_LATE);
        if (!(fabs(value - s->off[at]) > fmax(part * NEAR_LATE, CALIBRATION_SURE * sigma[at]))) continue;
        s->off[at] = rint(value / LATE_PART) * LATE_PART;
        moved = 1;
    }
    for (i = 0; i < N_ZEROS; i++) {
        const int at = zero_theta[i];
        if (fabs(theta[at] - s->off[at]) > fmax(part * small_zero(m, at, least), CALIBRATION_SURE * sigma[at])) moved = 1;
    }
    for (i = 0; moved && i < N_ZEROS; i++) {
        const double small = small_zero(m, zero_theta[i], least);
        const double step = small < INFINITY ? exp2(floor(log2(CALIBRATION_FURTHER * small))) : 1;
        s->off[zero_theta[i]] = rint(theta[zero_theta[i]] / step) * step;
    }
    return moved;
}

/* Keep the readings of the first window, as far as there is room: to make its rows again where the sensors are off. */
static void hear(State *s, const double reading[SOURCES]) {
    if (s->rls.running || !(N_SKEWS + N_ZEROS) || s->deaf) return;
    if (s->n_heard >= s->room) {
        s->deaf = 1;
        s->n_heard = 0;
        return;
    }
    memcpy(s->heard[s->n_heard++], reading, sizeof s->heard[0]);
}
