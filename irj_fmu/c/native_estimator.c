/* One sample of the estimator: identification.online.estimator.OnlineEstimator, and the sample grid and health of irj_fmu.fmi.slave_base. */

/* A message that a host may use as a format; hosts in other languages get no further arguments. */
static void write_log(Twin *m, fmi2Status status, const char *category, const char *format, va_list values) {
    char text[768], escaped[2 * sizeof text];
    int i, k = 0;
    if (!m->host.logger) return;
    vsnprintf(text, sizeof text, format, values);
    for (i = 0; text[i]; i++) {
        if (text[i] == '%') escaped[k++] = '%';
        escaped[k++] = text[i];
    }
    escaped[k] = 0;
    m->host.logger(m->host.componentEnvironment, m->name, status, category, escaped);
}

static void tell(Twin *m, int once, const char *format, ...) { /* a text once per instance */
    va_list values;
    if (!m->logging || m->told[once]) return;
    m->told[once] = 1;
    va_start(values, format);
    write_log(m, fmi2Warning, "logStatusWarning", format, values);
    va_end(values);
}

enum { HEALTH_OK, WARMING_UP, NUMERIC_TROUBLE, STEP_MISMATCH, INTERNAL_ERROR };
enum { TELL_STEP = N_VARIABLES, TELL_SETUP, TELL_WINDOW, TELL_SENSORS, TELL_UNEVEN, TELL_FAULT }; /* places in `told` after those of the variables */

/* ---- life --------------------------------------------------------------------------------------------------------- */

static void clear_estimator(Twin *m) {
    State *s = &m->s;
    int i;
    memset(s->off, 0, sizeof s->off);
    s->n_heard = s->deaf = 0;
    clear_rows(m);
    memset(&s->watch, 0, sizeof s->watch);
    memset(&s->grid, 0, sizeof s->grid);
    memset(&s->pulse, 0, sizeof s->pulse);
    clear_guard(&s->guard);
    memset(&s->window, 0, sizeof s->window);
    memset(s->last_good, 0, sizeof s->last_good);
    memset(s->readings, 0, sizeof s->readings);
    memset(s->lost, 0, sizeof s->lost);
    memset(s->sigma, 0, sizeof s->sigma);
    memset(s->score, 0, sizeof s->score);
    for (i = 0; i < N_BALANCES; i++)
        s->residual[i] = s->floor[i] = s->ratio[i] = s->square[i] = s->torque[i] = s->first_level[i] = 0;
    for (i = 0; i < N_THETA; i++) {
        s->theta[i] = fixed_theta[i];
        s->scale[i] = 1;
    }
    s->rls.running = s->fault = s->plant_alarm = s->reoptimise = 0;
    s->n_rows = s->strained = 0;
    clear_recursion(s);
    clear_detector(&s->detector);
}

static void publish(State *s) {
    int i;
    for (i = 0; i < N_THETA; i++) {
        s->real[V_THETA + i] = s->theta[i];
        s->real[V_SIGMA + i] = s->sigma[i];
    }
    for (i = 0; i < N_BALANCES; i++) {
        s->real[residual_at[i]] = s->residual[i];
        s->real[ratio_at[i]] = s->ratio[i];
    }
    for (i = 0; i < SENSORS; i++) s->real[V_SCORE + i] = s->score[i];
    s->whole[V_N_ROWS] = (int)s->n_rows;
    s->whole[V_ALARM] = s->rls.running && s->rls.fast[FAST_ALARM] > 0;
    s->whole[V_REOPTIMISE] = s->reoptimise;
}

static double least(const State *s, int b) { /* what counts as noise at least */
    return fmax(fmax(s->floor[b], s->floor_share * sqrt(s->torque[b])), LEAST);
}

static void ratios(State *s) {
    int b;
    for (b = 0; b < N_BALANCES; b++) s->ratio[b] = sqrt(s->square[b]) / least(s, b);
}

static int configure(Twin *m) { /* take the parameters over; 0 where they ask for another build */
    State *s = &m->s;
    const double dt = s->real[V_SAMPLE_TIME], warm_up = s->real[V_WARM_UP];
    double rows;
    s->changed = 0;
    if (!(fabs(dt - SAMPLE_TIME) <= GRID_SLACK * SAMPLE_TIME)) {
        tell(m, TELL_SETUP, "sample_time %g s: this native estimator was built for %g s; build it again with --sample-time", dt, SAMPLE_TIME);
        return 0;
    }
    if (s->text[TEXT_JOINT_FILE][0]) {
        tell(m, TELL_SETUP, "joint_file %s: a native estimator holds its joint in compiled form; build it again with this file", s->text[TEXT_JOINT_FILE]);
        return 0;
    }
    rows = rint(warm_up / ROW_PERIOD);
    if (!(rows <= COLLECT)) {
        tell(m, TELL_SETUP, "warm_up %g s: this native estimator has room for %g s", warm_up, COLLECT * ROW_PERIOD);
        return 0;
    }
    if (s->whole[V_OPTIMISE]) tell(m, V_OPTIMISE, "optimise: a native estimator has no optimiser; its output reoptimise says when one is wanted");
    if (!s->configured) {
        s->warm_up = warm_up;
        s->collect = (int)fmax(2 * N_THETA, rows);
        s->room = STRIDE * (s->collect + s->collect / 4 + ROWS_BEFORE_READY);
        s->detect = HAS_DETECTOR && s->whole[V_DETECT];
        s->drift = s->real[V_DRIFT];
        s->alarm_drift = s->real[V_ALARM_DRIFT];
        s->floor_share = s->real[V_FLOOR_SHARE];
        clear_estimator(m);
        s->configured = 1;
    }
    if (s->drift != s->real[V_DRIFT] || s->alarm_drift != s->real[V_ALARM_DRIFT] || s->floor_share != s->real[V_FLOOR_SHARE]) {
        s->floor_share = s->real[V_FLOOR_SHARE];
        s->drift = s->real[V_DRIFT];
        s->alarm_drift = s->real[V_ALARM_DRIFT];
        tune_recursion(s);
        if (s->rls.running) guard_start(s);
    }
    set_margin(&s->detector, s->real[V_FAULT_MARGIN]);
    if (s->whole[V_RESET] && !s->reset_before) clear_estimator(m);
    s->reset_before = s->whole[V_RESET];
    publish(s);
    return 1;
}

/* ---- a row -------------------------------------------------------------------------------------------------------- */

static void floors(Twin *m) {
    if (!m->s.rls.running) return;
    noise_floor(m, m->s.theta, m->s.floor);
    tell_noise(&m->s);
    deviations(&m->s, m->s.sigma);
    ratios(&m->s);
}

static void collect_row(Twin *m, double time) {
    State *s = &m->s;
    int b;
    keep_row(m);
    if (s->window.count < s->collect) return;
    if (begin_recursion(m, time)) tell(m, TELL_WINDOW, "the first window does not determine every parameter");
    for (b = 0; b < N_THETA; b++)
        if (s->off[b] != 0) tell(m, TELL_SENSORS, "the sensors have a zero or skews: they are taken off the readings");
    floors(m);
    for (b = 0; b < N_BALANCES; b++) s->first_level[b] = sqrt(s->square[b]);
}

/* Residuals, weights and mean squares of the row: identification.online.row_check.RowCheck. Gives 1 where one is over its limit. */
static int check_row(Twin *m, const int on[N_BALANCES]) {
    State *s = &m->s;
    Checked *c = &m->checked;
    double share[2], use[N_BALANCES], reference[N_BALANCES], over[N_BALANCES];
    const double *const into[] = {m->y, m->h, s->theta, s->guard.kept[0].fast, s->guard.kept[1].fast, s->rls.fast, s->scale, share, use, s->floor, s->first_level, reference, s->square, s->torque, &s->floor_share};
    double *const out[] = {c->error, c->weighted, c->square, c->torque, c->least, s->ratio, over, c->y, c->h, c->signals};
    int b, any = 0;
    standstill(m, share);
    for (b = 0; b < N_BALANCES; b++) {
        use[b] = on[b];
        reference[b] = s->rows.signals[reference_signal[b]];
    }
    memcpy(m->arg, into, sizeof into);
    memcpy(m->res, out, sizeof out);
    row_check(m->arg, m->res, m->iw, m->w, 0);
    memcpy(s->residual, c->error, sizeof s->residual);
    memcpy(s->square, c->square, sizeof s->square);
    memcpy(s->torque, c->torque, sizeof s->torque);
    for (b = 0; b < N_BALANCES; b++) any |= over[b] != 0;
    return any;
}

static void recursive_step(Twin *m, const int on[N_BALANCES], double theta[N_THETA]) {
    State *s = &m->s;
    Recursion *r = &s->rls;
    int b;
    for (b = 0; b < N_BALANCES; b++) r->config[CONFIG_ENABLED + b] = on[b];
    m->arg[0] = r->fast; m->arg[1] = r->slow; m->arg[2] = r->config; m->arg[3] = m->checked.y; m->arg[4] = m->checked.h;
    m->res[0] = m->fast_next; m->res[1] = m->theta_next; m->res[2] = NULL; m->res[3] = NULL;
    rls_step(m->arg, m->res, m->iw, m->w, 0);
    if (m->fast_next[FAST_DUE] != 0) {
        m->arg[0] = m->fast_next; m->arg[1] = r->slow; m->arg[2] = r->config;
        m->res[0] = r->fast; m->res[1] = m->slow_next;
        rls_check(m->arg, m->res, m->iw, m->w, 0);
        memcpy(r->slow, m->slow_next, sizeof r->slow);
    } else {
        memcpy(r->fast, m->fast_next, sizeof r->fast);
    }
    memcpy(theta, m->theta_next, sizeof s->theta);
    for (b = 0; b < N_BALANCES; b++) r->fast[FAST_NOISE + b] = fmax(r->fast[FAST_NOISE + b], m->checked.least[b] * m->checked.least[b]);
}

/* Take a row; 0 until there is one. */
static int take_row(Twin *m, double time, int enable) {
    State *s = &m->s;
    double size[N_BALANCES], theta[N_THETA];
    int on[N_BALANCES], any = 0, all = 1, over, b, k;
    const int made = make_row(m, time);
    for (b = 0; b < N_BALANCES; b++) {
        on[b] = 1;
        for (k = 0; k < SOURCES; k++)
            if (uses[b][k] && s->lost[k]) on[b] = 0;
        any |= on[b];
        all &= on[b];
    }
    if (s->n_heard) s->told[s->n_heard / STRIDE - 1] = (unsigned char)(enable && all);
    if (!made) return 0;
    s->n_rows++;
    if (!s->rls.running) {
        if (enable && all) collect_row(m, time);
        return 1;
    }
    over = check_row(m, on);
    if (!enable) return 1;
    if (!any) {
        guard_blind(s);
        show(s, s->guard.theta);
        return 1;
    }
    recursive_step(m, on, theta);
    s->strained = over ? s->strained + 1 : 0;
    s->reoptimise = s->strained >= CONFIRM_ROWS;
    for (b = 0; b < N_BALANCES; b++) size[b] = fmax(m->checked.least[b], s->first_level[b]);
    if (guard_step(s, theta, &m->checked, size, on) == BACK) {
        for (b = 0; b < N_BALANCES; b++) s->square[b] = s->first_level[b] * s->first_level[b];
        s->strained = 0;
    }
    show(s, s->guard.theta);
    return 1;
}

/* ---- judgement ---------------------------------------------------------------------------------------------------- */

static int plant_verdict(const Fault *f) {
    if (f->k - f->event_sample >= RECENT_SAMPLES) return 0;
    return f->event == CURRENT_OR_FRICTION ? CODE_CURRENT_OR_FRICTION : f->event == PLANT ? CODE_PLANT : 0;
}

static int implausible(const State *s) { /* an inertia far from that of the fitted joint: a wrong scale of torque or current */
    int i;
    for (i = 0; i < N_INERTIAS; i++) {
        const double before = inertia_before[i], now = s->theta[inertia_theta[i]], spread = s->sigma[inertia_theta[i]];
        if (!(before / WRONG_SCALE < now && now < WRONG_SCALE * before) && fabs(now - before) > WRONG_SIGMAS * spread) return inertia_code[i];
    }
    return 0;
}

static void judge(State *s, const int good[SENSORS]) {
    int found = s->pulse.failed && s->rls.running ? CODE_HELD : 0, i;
    for (i = 0; i < SENSORS && !found; i++)
        if (!good[i] && (needs[i] || (s->detect && present[i]))) found = CODE_MISSING + 1 + i;
    if (s->detect) {
        for (i = 0; i < SENSORS && !found; i++)
            if (s->detector.failed[i]) found = 1 + i;
        s->plant_alarm = plant_verdict(&s->detector);
        scores(&s->detector, s->score);
    }
    for (i = 0; i < SENSORS && !found; i++)
        if (s->watch.constant[i]) found = CODE_CONSTANT + 1 + i;
    for (i = 0; i < SENSORS && !found; i++)
        if (s->watch.scaled[i]) found = CODE_SCALED + 1 + i;
    if (!found && s->rls.running) found = implausible(s);
    if (!found) found = s->plant_alarm;
    if (!found && s->guard.on_probation) found = CODE_HELD;
    s->fault = found;
}

/* ---- a sample ----------------------------------------------------------------------------------------------------- */

/* Link position and velocity from the motor, torsion taken off. */
static void link_from_motor(State *s) {
    const double stiffness = STIFFNESS_THETA < 0 ? HELD_STIFFNESS : s->theta[STIFFNESS_THETA < 0 ? 0 : STIFFNESS_THETA];
    s->readings[Q_L] = s->last_good[Q_M];
    s->readings[W_L] = s->last_good[W_M];
    if (LINK_FROM_TORSION && stiffness > 0) s->readings[Q_L] -= s->last_good[TAU] / stiffness;
}

static void push(State *s, const int good[SENSORS], int counts) {
    static const int reading[SOURCES] = {Q_M, Q_L, TAU, DRIVE};
    const double *q = s->last_good;
    const double sample[SOURCES] = {q[Q_M], present[Q_L] ? q[Q_L] : q[Q_M], q[TAU], q[DRIVE]};
    int k;
    append_sample(&s->rows, sample);
    hear(s, sample);
    for (k = 0; k < SOURCES; k++) {
        const int i = reading[k], bad = (!(good[i] && counts) && needs[i]) || (s->detect && s->detector.failed[i]);
        if (bad || s->watch.constant[i] || s->watch.scaled[i]) s->lost[k] = LOST_SAMPLES;
        else if (s->lost[k]) s->lost[k]--;
    }
}

/* Take a sample on the grid; 1 where a row was made. */
static int take_sample(Twin *m, double time, const double readings[SENSORS], const int given[SENSORS], int enable) {
    State *s = &m->s;
    const int failed_before = s->pulse.failed, counts = pulse_sample(s, time, readings);
    int good[SENSORS], made = 0, looked, i;
    for (i = 0; i < SENSORS; i++) good[i] = given[i] && !s->pulse.failed && !s->pulse.jumped;
    if (failed_before && !s->pulse.failed) clear_detector(&s->detector); /* its observers have followed readings that were none */
    looked = watch_sample(m, readings, good);
    for (i = 0; i < SENSORS; i++)
        if (good[i]) s->last_good[i] = readings[i];
    if (s->detect) {
        detect_faults(m, readings, good, s->readings);
    } else {
        memcpy(s->readings, s->last_good, sizeof s->readings);
        if (!good[Q_L]) link_from_motor(s);
    }
    push(s, good, counts);
    if (++s->rows.since >= STRIDE) {
        s->rows.since = 0;
        made = take_row(m, time, enable);
        judge(s, s->pulse.jumped ? good : given);
    }
    if (looked) floors(m);
    return made;
}

/* Take a sample, which need not lie on the grid: identification.online.grid.Grid. */
static int update(Twin *m, double time, const double readings[SENSORS], const int good[SENSORS], int enable) {
    Grid *g = &m->s.grid;
    const double slack = ON_GRID * SAMPLE_TIME, before = g->time, apart = time - g->time;
    const int fresh = g->count == 0 || apart > GRID_GAP || !(apart > 0);
    double point;
    int made = 0, i;
    if (fresh) { g->start = time; g->count = 0; }
    point = g->start + g->count * SAMPLE_TIME;
    if (fresh || fabs(time - point) <= slack) {
        g->count++;
        made = take_sample(m, time, readings, good, enable);
    } else {
        while (point <= time + slack) {
            const double share = (point - before) / apart;
            double line[SENSORS];
            int both[SENSORS];
            for (i = 0; i < SENSORS; i++) {
                line[i] = g->readings[i] + share * (readings[i] - g->readings[i]);
                both[i] = g->valid[i] && good[i];
            }
            made |= take_sample(m, point, line, both, enable);
            g->count++;
            point = g->start + g->count * SAMPLE_TIME;
        }
    }
    g->time = time;
    memcpy(g->readings, readings, sizeof g->readings);
    memcpy(g->valid, good, sizeof g->valid);
    return made;
}

static int process(Twin *m, double time) { /* gives the health */
    State *s = &m->s;
    double readings[SENSORS];
    int good[SENSORS], lost = 0, i;
    for (i = 0; i < SENSORS; i++) {
        const double value = s->real[input_at[i]] * input_gain[i];
        const int is_lost = !(value > -ABSURD && value < ABSURD);
        if (is_lost) tell(m, input_at[i], "input not finite or beyond %g in SI units: %s; it counts as missing", ABSURD, input_name[i]);
        lost |= is_lost;
        readings[i] = is_lost ? 0 : value;
        good[i] = s->whole[valid_at[i]] && !is_lost && present[i];
    }
    if (s->whole[V_REQUEST]) tell(m, V_REQUEST, "reoptimise_request: a native estimator has no optimiser");
    if (update(m, time, readings, good, s->whole[V_ENABLE])) publish(s);
    s->real[V_LINK_POSITION] = s->readings[Q_L];
    s->real[V_LINK_POSITION + 1] = s->readings[W_L];
    if (s->fault != s->whole[V_FAULT]) {
        s->whole[V_FAULT] = s->fault;
        if (s->fault) tell(m, TELL_FAULT + s->fault, "fault %d at t = %g s (%s)", s->fault, time, FAULT_TEXT);
    }
    if (lost || s->fault > CODE_PLANT || is_held(s)) return NUMERIC_TROUBLE;
    return s->rls.running ? HEALTH_OK : WARMING_UP;
}

/* A sample where the grid of sample_time has come; in smaller host steps between, the outputs hold. */
static void sample(Twin *m, double time, double length) {
    State *s = &m->s;
    int too_long, health;
    double apart;
    if (isnan(s->start)) s->start = time;
    too_long = length > GRID_GAP * (1 + GRID_SLACK);
    if (length <= SAMPLE_TIME * (1 + GRID_SLACK) && time < s->start + s->samples * SAMPLE_TIME - SAMPLE_TIME * GRID_EARLY) return;
    if ((s->changed || !s->configured) && !configure(m)) {
        s->whole[V_HEALTH] = INTERNAL_ERROR;
        return;
    }
    if (!isfinite(time) || !isfinite(length)) {
        s->whole[V_HEALTH] = INTERNAL_ERROR;
        return;
    }
    s->samples = (Count)floor((time - s->start) / SAMPLE_TIME + GRID_ROUNDED) + 1;
    apart = time - s->last;
    s->last = time;
    if (too_long) {
        tell(m, TELL_STEP, "the host's step %g s is too long for sample_time %g s; steps up to %g s are followed", length, SAMPLE_TIME, GRID_GAP);
    } else if (s->expected > 0 && apart > GRID_GAP * (1 + GRID_SLACK)) {
        s->uneven = time;
        tell(m, TELL_UNEVEN, "the host's steps of %g s put samples %g s apart, sample_time is %g s; use steps that divide it", length, apart, SAMPLE_TIME);
    }
    s->expected = fmax(SAMPLE_TIME, length);
    too_long |= time < s->uneven + GRID_HOLD * SAMPLE_TIME;
    health = process(m, time);
    s->whole[V_HEALTH] = too_long && health < STEP_MISMATCH ? STEP_MISMATCH : health;
    s->whole[V_N_SAMPLES]++;
}
