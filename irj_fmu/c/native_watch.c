/* Checks of the readings that need no filter, as identification.online.watch.Watch makes them. */

/* The k-th smallest of n values goes to its place, smaller ones before it. */
static double select_value(double v[], int n, int k) {
    int low = 0, high = n - 1;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        const double a = v[low], b = v[middle], c = v[high];
        const double pivot = fmax(fmin(a, b), fmin(fmax(a, b), c));
        int i = low, j = high;
        while (i <= j) {
            while (v[i] < pivot) i++;
            while (v[j] > pivot) j--;
            if (i <= j) {
                const double swap = v[i];
                v[i++] = v[j];
                v[j--] = swap;
            }
        }
        if (k <= j) high = j;
        else if (k >= i) low = i;
        else break;
    }
    return v[k];
}

/* White noise from the smallest fourth differences; identification.balance.noise.noise_level. Kept by number and not by
 * value: equal ones are told apart by rounding only. */
static double noise_level(Twin *m, int sensor) {
    const int n = WATCH - 4, last = (int)(NOISE_KEPT * (n - 1));
    double *d = m->sorted, square = 0;
    int i, pass;
    for (i = 0; i < WATCH; i++) d[i] = m->s.watch.rows[i][sensor];
    for (pass = 1; pass <= 4; pass++)
        for (i = 0; i < WATCH - pass; i++) d[i] = d[i + 1] - d[i];
    for (i = 0; i < n; i++) d[i] = fabs(d[i]);
    select_value(d, n, last);
    for (i = 0; i <= last; i++) square += d[i] * d[i];
    return sqrt(square / (last + 1) / NOISE_GAIN) / NOISE_CUT_DEVIATION;
}

/* Least-squares slope of x against y about their means. */
static double slope_of(const double x[], const double y[], int n) {
    double mx = 0, my = 0, xy = 0, yy = 0;
    int i;
    for (i = 0; i < n; i++) { mx += x[i]; my += y[i]; }
    mx /= n; my /= n;
    for (i = 0; i < n; i++) { xy += (x[i] - mx) * (y[i] - my); yy += (y[i] - my) * (y[i] - my); }
    return xy / fmax(yy, TINY);
}

/* Largest change of the twist of a healthy joint in the last second, as it is read. */
static double apart_of(const Watch *w, const int good[SENSORS], const double spread[SENSORS]) {
    double step = 0;
    int i;
    for (i = 0; i < WATCH - 1; i++) step = fmax(step, fabs(w->rows[i + 1][Q_M] - w->rows[i][Q_M]));
    return 2 * TWIST_PLAY + TWIST_COMPLIANCE * spread[good[TAU] ? TAU : DRIVE] + MOST_SKEW * step;
}

/* Ratio of velocity reading to position reading, and of the two positions. */
static void check_scales(Twin *m, const int good[SENSORS], const double spread[SENSORS]) {
    Watch *w = &m->s.watch;
    static const int pair[2][2] = {{Q_M, W_M}, {Q_L, W_L}};
    double own[2] = {1, 1}, *travelled = m->sorted, *change = m->fourth;
    int p, i;
    for (p = 0; p < 2; p++) {
        const int q = pair[p][0], v = pair[p][1];
        double a = 0, b = 0;
        if (!good[q] || !good[v] || !(spread[q] > SCALE_MOTION)) continue;
        for (i = 0; i < WATCH - 1; i++) {
            travelled[i] = a += 0.5 * SAMPLE_TIME * (w->rows[i + 1][v] + w->rows[i][v]);
            change[i] = b += w->rows[i + 1][q] - w->rows[i][q];
        }
        own[p] = slope_of(travelled, change, WATCH - 1);
        w->scaled[v] = fabs(own[p] - 1) > SCALE_ERROR;
    }
    if (good[Q_M] && good[Q_L] && fmax(spread[Q_M], spread[Q_L]) > SCALE_MOTION) {
        int wrong, off_m = fabs(own[0] - 1) > SCALE_ERROR, off_l = fabs(own[1] - 1) > SCALE_ERROR;
        for (i = 0; i < WATCH; i++) { travelled[i] = w->rows[i][Q_L]; change[i] = w->rows[i][Q_M]; }
        wrong = (fabs(slope_of(travelled, change, WATCH) - 1) - SCALE_ERROR) * spread[Q_M] > apart_of(w, good, spread);
        w->scaled[Q_L] = wrong && off_l && !off_m;
        w->scaled[Q_M] = wrong && !w->scaled[Q_L];
        if (wrong) {
            w->scaled[W_M] = w->scaled[W_M] && !w->scaled[Q_M];
            w->scaled[W_L] = w->scaled[W_L] && !w->scaled[Q_L];
        }
    }
}

static void look(Twin *m) {
    Watch *w = &m->s.watch;
    double spread[SENSORS];
    int good[SENSORS], moves, i, k;
    for (i = 0; i < SENSORS; i++) {
        double low = w->rows[0][i], high = low;
        for (k = 1; k < WATCH; k++) { low = fmin(low, w->rows[k][i]); high = fmax(high, w->rows[k][i]); }
        spread[i] = high - low;
        good[i] = present[i] && !w->bad[i];
    }
    moves = fmax(good[Q_M] ? spread[Q_M] : 0, good[Q_L] ? spread[Q_L] : 0) > MOVED;
    for (i = 0; i < SENSORS; i++) {
        if (!good[i]) continue;
        if (spread[i] > 0 || moves) w->constant[i] = spread[i] == 0;
        if (spread[i] > 0) {
            const double level = noise_level(m, i), square = w->noise[i] * w->noise[i];
            if (w->looks[i] < NOISE_MEMORY) w->looks[i]++;
            w->noise[i] = sqrt(square + (level * level - square) / w->looks[i]);
        }
    }
    for (i = 0; i < SENSORS; i++) good[i] = good[i] && !w->constant[i];
    check_scales(m, good, spread);
}

/* Take a sample; 1 where the second is full and has been looked at. */
static int watch_sample(Twin *m, const double readings[SENSORS], const int good[SENSORS]) {
    Watch *w = &m->s.watch;
    int i;
    memcpy(w->rows[w->count], readings, sizeof w->rows[0]);
    for (i = 0; i < SENSORS; i++) w->bad[i] += !good[i];
    if (++w->count < WATCH) return 0;
    look(m);
    w->count = 0;
    memset(w->bad, 0, sizeof w->bad);
    return 1;
}
