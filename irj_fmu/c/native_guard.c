/* What holds the estimate: identification.online.pulse.Pulse for failures of all readings at once, identification.online.guard.Guard for those that
 * nothing else has told. */

enum { NOTHING, HELD_NOW, BACK, ACCEPTED };

/* Take a sample; 0 where it does not count. */
static int pulse_sample(State *s, double time, const double readings[SENSORS]) {
    Pulse *p = &s->pulse;
    const int stopped = p->any && !(time > p->time);
    int equal = p->any, dead, i;
    double pace = 0;
    p->jumped = p->any && time - p->time > PULSE_GAP;
    for (i = 0; i < SENSORS; i++)
        if (present[i] && readings[i] != p->before[i]) equal = 0;
    if (p->any && !p->still) {
        if (present[Q_M]) pace = fmax(pace, fabs(readings[Q_M] - p->before[Q_M]));
        if (present[Q_L]) pace = fmax(pace, fabs(readings[Q_L] - p->before[Q_L]));
        p->speed += (pace - p->speed) / PULSE_PACE;
        p->share += (equal - p->share) / PULSE_MEMORY;
    }
    p->same = equal || stopped ? p->same + 1 : 0;
    dead = p->same >= PULSE_REPEATS && p->same * log(fmax(p->share, PULSE_CHANCE)) < log(PULSE_CHANCE);
    p->still = dead || stopped;
    p->failed = p->still && (stopped || p->speed > PULSE_STEP);
    p->any = 1;
    p->time = time;
    memcpy(p->before, readings, sizeof p->before);
    return !(p->still || p->jumped);
}

static void clear_guard(Guard *g) {
    int b;
    memset(g, 0, sizeof *g);
    for (b = 0; b < N_BALANCES; b++) { g->over[b] = GUARD_LONG_AGO; g->on[b] = 1; }
}

static void estimate_of(const State *s, const Recursion *r, double theta[N_THETA]) {
    int i;
    for (i = 0; i < N_THETA; i++) theta[i] = r->fast[FAST_THETA + i] * s->scale[i];
}

static void guard_start(State *s) { /* a new recursion, trusted */
    clear_guard(&s->guard);
    estimate_of(s, &s->rls, s->guard.theta);
    s->guard.kept[0] = s->guard.kept[1] = s->guard.kept[2] = s->rls;
}

/* True where the residuals are no longer those of an estimate that explains them. */
static int guard_doubtful(const Guard *g, const double limits[N_BALANCES]) {
    int b;
    for (b = 0; b < N_BALANCES; b++)
        if (fmax(g->quick[b], g->own[b]) > (GUARD_EXPLAINED * limits[b]) * (GUARD_EXPLAINED * limits[b])) return 1;
    return 0;
}

/* True where the newer estimate explains the readings, or as well as the older one. */
static int guard_proven(const Guard *g, const double limits[N_BALANCES]) {
    int b;
    for (b = 0; b < N_BALANCES; b++)
        if (g->trial[b] > fmax(g->quick[b], (GUARD_EXPLAINED * limits[b]) * (GUARD_EXPLAINED * limits[b]))) return 0;
    return 1;
}

static void guard_restore(State *s) {
    Guard *g = &s->guard;
    s->rls = g->kept[0];
    estimate_of(s, &s->rls, g->theta);
    g->kept[1] = g->kept[2] = g->kept[0];
    memset(g->own, 0, sizeof g->own);
    g->next = g->until = 0;
}

/* Mean squares of errors, in place; what is far over the limit is cut, not to be remembered for long. Tells where they are over. */
static int guard_follow(Guard *g, double squares[N_BALANCES], const double errors[N_BALANCES], const double limits[N_BALANCES], double share, int over[N_BALANCES]) {
    int b, any = 0;
    for (b = 0; b < N_BALANCES; b++) {
        const double most = GUARD_CAP * limits[b];
        const double cut = g->on[b] ? fmin(fmax(errors[b], -most), most) : 0;
        squares[b] += GUARD_RATE * (cut * cut - squares[b]);
        over[b] = squares[b] > (share * limits[b]) * (share * limits[b]);
        any |= over[b];
    }
    return any;
}

/* sensor_explains: gain and offset of the torque or of the motion leave less of the residuals than the limit. */
static int sensor_explains(const double sums[GUARD_SUMS], double limit) {
    const double rows = sums[0], ee = sums[1], we = sums[2], ww = sums[3];
    double least;
    int i;
    if (!(ww > 0)) return 1;
    least = ee - we * we / ww;
    for (i = 4; i < GUARD_SUMS; i += 3) {
        const double square = sums[i], mean = sums[i + 1], product = sums[i + 2], own = square - mean * mean / ww;
        if (own > GUARD_SINGULAR * square) {
            const double shared = product - mean * we / ww;
            least = fmin(least, ee - we * we / ww - shared * shared / own);
        }
    }
    return least <= limit * limit * rows;
}

/* True where the joint itself may have changed: one balance only, and no failed sensor explains its residuals. */
static int guard_plausible(const Guard *g, const double limits[N_BALANCES]) {
    int b, several = 0;
    for (b = 0; b < N_BALANCES; b++) several += g->held_for - g->over[b] < GUARD_ACCEPT;
    if (g->on_probation && several > 1) return 0;
    for (b = 0; b < N_BALANCES; b++)
        if (g->held_for - g->over[b] < GUARD_ACCEPT && sensor_explains(g->sums[b], GUARD_EXPLAINED * limits[b])) return 0;
    return 1;
}

static void guard_remember(Guard *g, const Checked *c) {
    int b, i;
    for (b = 0; b < N_BALANCES; b++) {
        const double e = c->weighted[b], x = c->signals[b], m = c->signals[N_BALANCES + b], w = c->signals[2 * N_BALANCES + b];
        const double more[GUARD_SUMS] = {1, e * e, w * e, w * w, x * x, x * w, x * e, m * m, m * w, m * e};
        if (!g->on[b]) continue;
        for (i = 0; i < GUARD_SUMS; i++) g->sums[b][i] = GUARD_FORGET * g->sums[b][i] + more[i];
    }
}

/* Judge the recursion after a row; it may be put back. */
static int guard_step(State *s, const double theta[N_THETA], const Checked *checked, const double level[N_BALANCES], const int on[N_BALANCES]) {
    Guard *g = &s->guard;
    double limits[N_BALANCES];
    int over[N_BALANCES], unexplained[N_BALANCES], lost = 0, any, b;
    for (b = 0; b < N_BALANCES; b++) {
        limits[b] = GUARD_LIMIT * level[b];
        lost |= g->on[b] && !on[b];
    }
    memcpy(g->on, on, sizeof g->on);
    any = guard_follow(g, g->quick, checked->weighted, limits, 1.0, over);
    if (!g->on_probation) {
        guard_follow(g, g->trial, checked->weighted + N_BALANCES, limits, 1.0, unexplained);
        if (guard_follow(g, g->own, checked->weighted + 2 * N_BALANCES, limits, 1.0, unexplained) && !any) {
            any = 1; /* the older estimate was unsure of the row, the rows since were not */
            memcpy(over, unexplained, sizeof over);
            memcpy(g->quick, g->own, sizeof g->quick);
            g->kept[0] = g->kept[1] = g->kept[2];
        }
        if (any) {
            g->on_probation = 1;
            for (b = 0; b < N_BALANCES; b++) g->over[b] = over[b] ? 0 : GUARD_LONG_AGO;
            memcpy(g->fresh, g->quick, sizeof g->fresh);
            g->back = g->explained = g->held_for = 0;
            memset(g->sums, 0, sizeof g->sums);
            estimate_of(s, &g->kept[0], g->theta);
            return HELD_NOW;
        }
        if (lost) { /* rows before a failure was noticed may hold it */
            guard_restore(s);
            return NOTHING;
        }
        g->doubt = guard_doubtful(g, limits) ? g->doubt + 1 : 0;
        if (0 < g->doubt && g->doubt <= GUARD_AGE) return NOTHING;
        memcpy(g->theta, theta, sizeof g->theta);
        if (++g->until >= GUARD_OFTEN) {
            g->until = 0;
            g->kept[2] = s->rls;
        }
        if (++g->next >= GUARD_AGE) {
            g->next = 0;
            if (guard_proven(g, limits)) g->kept[0] = g->kept[1];
            g->kept[1] = s->rls;
        }
        return NOTHING;
    }
    g->held_for++;
    for (b = 0; b < N_BALANCES; b++)
        if (over[b]) g->over[b] = g->held_for;
    g->back = any ? 0 : g->back + 1;
    guard_remember(g, checked);
    any = guard_follow(g, g->fresh, s->rls.fast + FAST_ERROR, limits, GUARD_EXPLAINED, unexplained);
    g->explained = any ? 0 : g->explained + 1;
    if (g->back >= GUARD_BACK) {
        guard_restore(s);
        g->on_probation = 0;
        return BACK;
    }
    if (g->explained >= GUARD_ACCEPT && guard_plausible(g, limits)) {
        guard_start(s);
        return ACCEPTED;
    }
    return NOTHING;
}

/* No balance has its readings. */
static void guard_blind(State *s) {
    Guard *g = &s->guard;
    int b, any = 0;
    for (b = 0; b < N_BALANCES; b++) any |= g->on[b];
    if (any && !g->on_probation) guard_restore(s);
    memset(g->on, 0, sizeof g->on);
}

static void show(State *s, const double theta[N_THETA]) { /* never outside what the parameters can be */
    int i;
    for (i = 0; i < N_THETA; i++) s->theta[i] = fmin(fmax(theta[i], lowest[i]), highest[i]);
}

static int is_held(const State *s) {
    return s->rls.running && (s->pulse.failed || s->guard.on_probation);
}
