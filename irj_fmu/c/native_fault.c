/* Fault detector: identification.faults.structured on the observer that CasADi has written.
 *
 * Bits, waits, limits and signatures come from native_config.h. A verdict on the joint itself is kept as an event.
 */
/* ---- replacement -------------------------------------------------------------------------------------------------- */

static void event(Fault *f, int verdict) {
    f->event = verdict;
    f->event_sample = f->k;
}

static void use_sensors(Fault *f) {
    int i, rows = 0;
    for (i = 0; i < SENSORS; i++) {
        const int used = !f->failed[i] && (i != TAU || HAS_TORQUE);
        f->used[i] = used;
        if (i) {
            f->gates[i - 1] = used ? gate[i - 1] : INFINITY;
            rows |= used << (i - 1);
        }
    }
    memcpy(f->gain, observer_gain[rows], sizeof f->gain);
    memcpy(f->gate, gate, sizeof f->gate);
}

static void open_gates(Fault *f) {
    int i;
    for (i = 0; i < 5; i++) f->gate[i] = FAULT_OPEN;
    f->gate_until = f->k + WAIT_SETTLE;
    f->cut = 0;
}

static void close_suspicion(Fault *f) {
    f->latched = 0;
    f->opened = -1;
}

/* The readings in use have changed; `changed` has a bit for each sensor. */
static void exchange(Fault *f, int changed) {
    int i, j;
    use_sensors(f);
    for (i = 0; i < 5; i++) {
        double widest = 0, all = 1;
        int wide = 0;
        if (changed & parity_sensors[i] || !HAS_TORQUE) invalidate(f, i, f->k + 1 + WAIT_SETTLE);
        for (j = 0; j < SENSORS; j++)
            if (f->failed[j]) {
                widest = fmax(widest, widening[j][i]);
                if (wide++) all *= FAULT_WIDER;
            }
        f->scale[i] = wide ? 1 / (widest * all) : 1;
    }
    for (j = 0; j < SENSORS; j++)
        if (f->failed[j] && parity_sensors[4] & 1 << j) f->scale[4] = 0; /* r1 compares the estimate with itself */
    open_gates(f);
    close_suspicion(f);
}

static void fail_sensors(Fault *f, int sensors, int verdict) {
    int i;
    event(f, verdict);
    for (i = 0; i < SENSORS; i++)
        if (sensors & 1 << i) {
            f->failed[i] = 1;
            f->lost[i] = verdict == DROPOUT;
            f->good[i] = 0;
            f->low[i] = INFINITY;
            f->high[i] = -INFINITY;
        }
    exchange(f, sensors);
}

static int any_failed(const Fault *f) {
    int i;
    for (i = 0; i < SENSORS; i++)
        if (f->failed[i]) return 1;
    return 0;
}

/* A failed sensor that agrees with the estimate over a moving stretch is used again. */
static void watch_recovery(Fault *f, const double reading[SENSORS], const double out[]) {
    int i, back = 0;
    for (i = 0; i < SENSORS; i++) {
        const double estimate = out[N_OBSERVER + i];
        if (!f->failed[i]) continue;
        if (fabs(reading[i] - estimate) <= recover_limit[i] && reading[i] != 0) {
            f->good[i]++;
            f->low[i] = fmin(f->low[i], estimate);
            f->high[i] = fmax(f->high[i], estimate);
            if (f->good[i] >= WAIT_RECOVER && f->high[i] - f->low[i] > moved[i]) back |= 1 << i;
        } else {
            f->good[i] = 0;
            f->low[i] = INFINITY;
            f->high[i] = -INFINITY;
        }
    }
    if (!back) return;
    for (i = 0; i < SENSORS; i++)
        if (back & 1 << i) f->failed[i] = f->lost[i] = 0;
    event(f, RECOVERED);
    exchange(f, back);
}

/* ---- isolation ---------------------------------------------------------------------------------------------------- */

static Count age_of(const Fault *f, int bit) { return f->latched & bit ? f->k - f->first[index_of(bit)] : -1; }
static Count since(const Fault *f, int bit) { return f->k - f->latest[index_of(bit)]; }

/* True where a position error of the parity's size would have passed the limit of r1. */
static int would_show(const Fault *f, int parity) {
    const int at = parity == LINK_PARITY ? 0 : 4;
    double size = 0;
    int i;
    for (i = 0; i < 4; i++) size = fmax(size, fabs(f->values[at + i]));
    return HAS_TORQUE ? size * FAULT_STIFFNESS > FAULT_SHOWS * f->limits[16] : age_of(f, parity) >= WAIT_PAIR;
}

/* Position, velocity or both of one side, as bits of sensors. */
static int failed_side(const Twin *m, int parity, int jump, int position, int velocity) {
    const Fault *f = &m->s.detector;
    const int latched = f->latched, p = 1 << position, v = 1 << velocity;
    const int torsion = HAS_TORQUE ? (latched & TORSION) != 0 : latched & LINK && latched & MOTOR;
    const int jumped = latched & jump && !f->failed[velocity] && age_of(f, jump) >= WAIT_LINK;
    if (latched & parity && age_of(f, parity) >= WAIT_LINK) {
        if (f->failed[velocity]) return torsion && !f->failed[position] ? p : 0;
        if (f->failed[position]) return v;
        if (f->muted & TORSION) { /* r1 cannot decide: the one further from the observer */
            const double *out = m->observed + N_OBSERVER + 5;
            return fabs(out[position]) / fault_noise[position] > fabs(out[velocity]) / fault_noise[velocity] ? p : v;
        }
        if (torsion) return jumped && jump == LINK_JUMP ? p | v : p;
        return jumped || would_show(f, parity) || age_of(f, parity) >= WAIT_PLANT ? v : 0;
    }
    return jumped && jump == LINK_JUMP && !(latched & TORSION) ? v : 0;
}

/* An event that is no sensor failure; its residuals are not looked at while they stay over the limit. */
static void report(Fault *f, int verdict) {
    event(f, verdict);
    f->muted |= f->latched & (TORSION | LINK | MOTOR | LINK_JUMP | MOTOR_JUMP);
    f->plant_rest = f->k + WAIT_REST;
    close_suspicion(f);
}

/* What none of the sensors explains. */
static void decide_plant(Fault *f) {
    Count recent = -1;
    int i;
    for (i = 0; i < BITS; i++)
        if (f->latched & 1 << i && f->latest[i] > recent) recent = f->latest[i];
    if (f->k - recent > WAIT_QUIET) {
        close_suspicion(f);
    } else if (f->latched & (MOTOR | MOTOR_JUMP) && !(f->latched & ~(MOTOR | MOTOR_JUMP))) {
        if (age_of(f, MOTOR) >= WAIT_PAIR && since(f, MOTOR) < FAULT_FRESH) report(f, CURRENT_OR_FRICTION);
    } else if (f->k - f->opened >= WAIT_PLANT) {
        report(f, PLANT);
    }
}

static int torque_failed(const Fault *f) {
    const int moving = f->latched & (LINK | MOTOR | LINK_JUMP | MOTOR_JUMP);
    Count age = -1;
    int i;
    for (i = 0; i < BITS; i++)
        if (moving & 1 << i) {
            const Count own = age_of(f, 1 << i);
            if (age < 0 || own < age) age = own;
        }
    if (f->peak > FAULT_SHORT_PEAK && since(f, TORSION) >= fault_short[0] && since(f, TORSION) <= fault_short[1] && age_of(f, TORSION) < fault_short[2]) return 1;
    return moving && age >= WAIT_TORQUE && age_of(f, TORSION) >= WAIT_TORQUE;
}

static void decide(Twin *m) {
    Fault *f = &m->s.detector;
    const int parity = f->latched & (LINK_PARITY | MOTOR_PARITY);
    int found = failed_side(m, LINK_PARITY, LINK_JUMP, Q_L, W_L) | failed_side(m, MOTOR_PARITY, MOTOR_JUMP, Q_M, W_M);
    if (!found && !parity && f->latched & TORSION && !f->failed[TAU] && torque_failed(f)) found = 1 << TAU;
    if (found) {
        fail_sensors(f, found, SENSOR);
        return;
    }
    if (parity & LINK_PARITY && since(f, LINK_PARITY) <= WAIT_QUIET) return;
    if (parity & MOTOR_PARITY && since(f, MOTOR_PARITY) <= WAIT_QUIET) return;
    decide_plant(f);
}

static void suspect(Twin *m, int bits, int raw) {
    Fault *f = &m->s.detector;
    int i;
    if (f->muted && !(raw & f->muted) && f->k > f->plant_rest) f->muted = 0;
    if (bits) {
        if (!f->latched) {
            f->opened = f->k;
            f->peak = 0;
        }
        for (i = 0; i < BITS; i++)
            if (bits & 1 << i) {
                f->latest[i] = f->k;
                if (!(f->latched & 1 << i)) f->first[i] = f->k;
            }
        f->latched |= bits;
    }
    if (bits & TORSION) f->peak = fmax(f->peak, fabs(f->values[16]) / f->limits[16]);
    if (f->latched) decide(m);
}

/* ---- a sample ----------------------------------------------------------------------------------------------------- */

static void clear_detector(Fault *f) { /* limits and margin stay */
    Fault fresh;
    int i;
    memset(&fresh, 0, sizeof fresh);
    memcpy(fresh.limits, f->limits, sizeof fresh.limits);
    fresh.margin = f->margin;
    fresh.k = fresh.opened = fresh.plant_rest = fresh.gate_until = -1;
    for (i = 0; i < BITS; i++) fresh.first[i] = fresh.latest[i] = -1;
    for (i = 0; i < 5; i++) fresh.scale[i] = 1;
    for (i = 0; i < SENSORS; i++) { fresh.low[i] = INFINITY; fresh.high[i] = -INFINITY; }
    use_sensors(&fresh);
    memcpy(f, &fresh, sizeof fresh);
}

static void set_margin(Fault *f, double margin) {
    const double factor = margin / f->margin;
    int i;
    if (margin == f->margin) return;
    for (i = 0; i < RESIDUALS; i++) f->limits[i] *= factor;
    f->margin = margin;
}

/* Cut innovations must not hold the estimate off for long without a suspicion. */
static void unlock(Fault *f, const double out[]) {
    int i;
    for (i = 0; i < 5; i++)
        if (outside(out[N_OBSERVER + SENSORS + i], f->gates[i])) {
            if (++f->cut > WAIT_SETTLE) open_gates(f);
            return;
        }
    f->cut = 0;
}

static void start_observer(Fault *f, const double readings[SENSORS]) {
    int i;
    memset(f->observer, 0, sizeof f->observer);
    for (i = 0; i < 4; i++) f->observer[i] = readings[i + 1];
}

/* Observer at the readings, residuals without a past; their scales stay. */
static void start_anew(Fault *f, const double readings[SENSORS]) {
    int i;
    start_observer(f, readings);
    memset(f->ring, 0, sizeof f->ring);
    memset(f->sums, 0, sizeof f->sums);
    memset(f->last, 0, sizeof f->last);
    memset(f->values, 0, sizeof f->values);
    for (i = 0; i < 5; i++) invalidate(f, i, f->k + 1 + WAIT_SETTLE);
}

static double usable(double reading) { return reading > -FAULT_LARGEST && reading < FAULT_LARGEST ? reading : 0; }

/* Absurd readings have driven the estimate out of all bounds: start it and the residuals again. */
static void begin_anew(Fault *f, const double reading[SENSORS], double used[SENSORS]) {
    double start[SENSORS];
    int i;
    for (i = 0; i < SENSORS; i++) {
        start[i] = usable(reading[i]);
        used[i] = f->failed[i] ? start[i] : reading[i];
    }
    start_anew(f, start);
    open_gates(f);
    close_suspicion(f);
}

/* Use readings again that were missing, where no position is in use; StructuredRule.take_back. */
static void take_back(Fault *f, const double reading[SENSORS], int gone) {
    static const int others[4][2] = {{Q_M, Q_L}, {Q_L, Q_M}, {W_M, W_L}, {W_L, W_M}};
    const int here = (f->lost[Q_M] && !(gone & 1 << Q_M)) || (f->lost[Q_L] && !(gone & 1 << Q_L));
    double start[SENSORS], kept[SENSORS];
    int i, back = 0;
    if (!here || !f->failed[Q_M] || !f->failed[Q_L]) {
        f->there = 0;
        return;
    }
    if (++f->there < WAIT_SETTLE) return;
    for (i = 0; i < SENSORS; i++)
        if (f->lost[i] && !(gone & 1 << i)) {
            back |= 1 << i;
            f->failed[i] = f->lost[i] = 0;
        }
    for (i = 0; i < SENSORS; i++) {
        start[i] = usable(reading[i]);
        kept[i] = f->failed[i] ? 0 : start[i];
    }
    for (i = 0; i < 4; i++)
        if (f->failed[others[i][0]]) start[others[i][0]] = kept[others[i][1]];
    start_anew(f, start);
    event(f, RECOVERED);
    f->there = 0;
    exchange(f, back);
}

static int any_lost(const Fault *f) {
    int i;
    for (i = 0; i < SENSORS; i++)
        if (f->lost[i]) return 1;
    return 0;
}

/* The six readings with failed ones replaced go to `used`. */
static void detect_faults(Twin *m, const double readings[SENSORS], const int good[SENSORS], double used[SENSORS]) {
    Fault *f = &m->s.detector;
    const double *out = m->observed, *motion = out + N_OBSERVER + 11;
    double reading[SENSORS], positions[4], rates[4];
    double total = 0;
    int i, bits, gone = 0, fresh = 0;
    for (i = 0; i < SENSORS; i++) {
        reading[i] = good[i] ? readings[i] : 0;
        if (good[i] && reading[i] > -ABSURD && reading[i] < ABSURD) continue;
        gone |= 1 << i;
        if (!f->failed[i] && (i != TAU || HAS_TORQUE)) fresh |= 1 << i;
    }
    if (f->k < 0 && gone == (1 << SENSORS) - 1) { /* nothing has been read yet */
        memset(used, 0, SENSORS * sizeof *used);
        return;
    }
    for (i = 0; i < SENSORS; i++)
        if (gone & 1 << i) reading[i] = 0;
    if (++f->k == 0) start_observer(f, reading);
    if (fresh) fail_sensors(f, fresh, DROPOUT);
    for (i = 0; i < SENSORS; i++)
        if (gone & 1 << i) f->good[i] = 0;
    if (any_lost(f)) take_back(f, reading, gone);
    m->arg[0] = f->observer; m->arg[1] = reading; m->arg[2] = f->used; m->arg[3] = f->gain; m->arg[4] = f->gate;
    m->res[0] = m->observed;
#if HAS_DETECTOR
    sample_observer(m->arg, m->res, m->iw, m->w, 0);
#endif
    for (i = 0; i < N_OBSERVED; i++) total += out[i];
    if (!isfinite(total)) {
        begin_anew(f, reading, used);
        return;
    }
    memcpy(f->observer, out, N_OBSERVER * sizeof *out);
    if (f->k == f->gate_until) {
        memcpy(f->gate, gate, sizeof f->gate);
        f->gate_until = -1;
    } else if (f->gate_until < 0 && !f->latched) {
        unlock(f, out);
    }
    memcpy(used, out + N_OBSERVER, SENSORS * sizeof *used);
    positions[0] = used[Q_L]; positions[1] = used[Q_M]; positions[2] = used[W_L]; positions[3] = used[W_M];
    rates[0] = used[W_L]; rates[1] = used[W_M]; rates[2] = motion[1]; rates[3] = motion[0];
    bits = residuals(f, positions, rates, used[TAU] - motion[2]);
    if (f->k < WAIT_ARM) return;
    if (f->k == WAIT_ARM) event(f, ARMED);
    if (bits || f->latched) suspect(m, bits & ~f->muted, bits);
    if (any_failed(f)) watch_recovery(f, reading, out);
    if (f->latched || any_failed(f))
        for (i = 1; i < SENSORS; i++)
            if (f->failed[i] || (f->latched && outside(out[N_OBSERVER + 5 + i], f->gates[i - 1]))) used[i] = out[N_OBSERVER + 13 + i];
}

/* For each reading, the largest residual that holds it over its limit; at least 1 where it has failed. */
static void scores(const Fault *f, double out[SENSORS]) {
    int parity, i, j;
    memset(out, 0, SENSORS * sizeof *out);
    for (parity = 0; parity < 5; parity++) {
        double worst = 0;
        for (j = 4 * parity; j < (parity < 4 ? 4 * parity + 4 : RESIDUALS); j++)
            if (f->limits[j] > 0) worst = fmax(worst, fabs(f->values[j]) / f->limits[j]);
        for (i = 0; i < SENSORS; i++)
            if (parity_sensors[parity] & 1 << i) out[i] = fmax(out[i], worst);
    }
    for (i = 0; i < SENSORS; i++)
        if (f->failed[i]) out[i] = fmax(1, out[i]);
}
