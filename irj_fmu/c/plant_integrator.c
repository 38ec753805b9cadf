/* Model evaluation and the integrator of a plant; included by plant_wrapper.c and plant_fmi3.c, which say what Status and OK
 * are, and MAX_ORDER where inputs have derivatives.
 *
 * Dormand-Prince 5(4), J. Comput. Appl. Math. 6 (1980) 19-26, with the step-size control of
 * Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.4.
 */

/* ---- the model ---------------------------------------------------------- */

typedef int (*Generated)(const casadi_real **, casadi_real **, casadi_int *, casadi_real *, int);

static void call4(Plant *m, Generated f, const double *x, const double *u, const double *z, double *out) {
    m->arg[0] = x; m->arg[1] = u; m->arg[2] = m->s.p; m->arg[3] = z;
    m->res[0] = out;
    f(m->arg, m->res, m->iw, m->w, 0);
}

static void refresh_f(Plant *m) {
    if (!m->f_is_fresh) call4(m, model_f, m->s.x, m->s.u, m->s.z, m->dx);
    m->f_is_fresh = 1;
}

static void refresh_y(Plant *m) {
    if (!m->y_is_fresh) call4(m, model_y, m->s.x, m->s.u, m->s.z, m->y);
    m->y_is_fresh = 1;
}

#if NZ > 0
static void remember(Plant *m, const double *x, const double *u, double *out) { /* x_prev = last accepted state */
    m->arg[0] = x; m->arg[1] = m->s.z; m->arg[2] = u; m->arg[3] = m->s.p; m->arg[4] = m->s.x;
    m->res[0] = out;
    model_z(m->arg, m->res, m->iw, m->w, 0);
}
#endif

static const double *input_at(Plant *m, double tau) {
#ifdef MAX_ORDER
    int i;
    if (!m->s.input_is_polynomial) return m->s.u;
    for (i = 0; i < NU; i++) /* Taylor series, FMI 2.0.4 section 4.2.1 */
        m->u_stage[i] = m->s.u[i] + tau * (m->s.du[0][i] + tau / 2 * (m->s.du[1][i] + tau / 3 * m->s.du[2][i]));
    return m->u_stage;
#else
    (void)tau;
    return m->s.u;
#endif
}

static void slope(Plant *m, double tau, const double *x, double *out) {
    const double *u = input_at(m, tau);
    const double *z = m->s.z;
#if NZ > 0
    remember(m, x, u, m->z_stage);
    z = m->z_stage;
#endif
    call4(m, model_f, x, u, z, out);
}

/* ---- Dormand-Prince 5(4) ------------------------------------------------- */

static const double C[7] = {0, 1. / 5, 3. / 10, 4. / 5, 8. / 9, 1, 1};
static const double A[7][6] = {
    {0},
    {1. / 5},
    {3. / 40, 9. / 40},
    {44. / 45, -56. / 15, 32. / 9},
    {19372. / 6561, -25360. / 2187, 64448. / 6561, -212. / 729},
    {9017. / 3168, -355. / 33, 46732. / 5247, 49. / 176, -5103. / 18656},
    {35. / 384, 0, 500. / 1113, 125. / 192, -2187. / 6784, 11. / 84}};
static const double E[7] = {71. / 57600, 0, -71. / 16695, 71. / 1920, -17253. / 339200, 22. / 525, -1. / 40};

static double error_norm(const Plant *m, double h) { /* 1 = exactly at the tolerance; NaN where something is not finite */
    double sum = 0;
    int i, j;
    for (i = 0; i < NX; i++) {
        double e = 0;
        const double size = fmax(fabs(m->s.x[i]), fabs(m->x_new[i]));
        for (j = 0; j < 7; j++) e += E[j] * m->k[j][i];
        e *= h / (m->s.rtol * (0.1 * nominal_x[i] + size));
        sum += e * e;
    }
    return sqrt(sum / DIM(NX));
}

static double first_step(const Plant *m, double length) {
    double size = 0, rate = 0;
    int i;
    for (i = 0; i < NX; i++) {
        const double scale = m->s.rtol * (0.1 * nominal_x[i] + fabs(m->s.x[i]));
        size = fmax(size, fabs(m->s.x[i]) / scale);
        rate = fmax(rate, fabs(m->k[0][i]) / scale);
    }
    return rate > 1e-5 && size > 1e-5 ? fmin(length, 0.01 * size / rate) : fmin(length, 1e-6);
}

static void trial(Plant *m, double tau, double h) {
    int stage, i, j;
    for (stage = 1; stage < 7; stage++) {
        for (i = 0; i < NX; i++) {
            double sum = 0;
            for (j = 0; j < stage; j++) sum += A[stage][j] * m->k[j][i];
            m->x_stage[i] = m->s.x[i] + h * sum;
        }
        slope(m, tau + C[stage] * h, m->x_stage, m->k[stage]);
    }
    memcpy(m->x_new, m->x_stage, sizeof m->x_new); /* the seventh stage is the fifth-order result */
}

static Status integrate(Plant *m, double length) {
    State *s = &m->s;
    double tau = 0;
    long count = 0;
    if (length <= 0) return OK;
    slope(m, 0, s->x, m->k[0]);
    if (!(s->step > 0)) s->step = first_step(m, length);
    while (tau < length) {
        const int last = tau + 1.01 * s->step >= length;
        const double h = last ? length - tau : s->step;
        double e, factor;
        if (++count > MAX_SUBSTEPS) return fail(m, "doStep: %ld inner steps at t = %g; the plant is too stiff for these parameters", count, s->t + tau);
        trial(m, tau, h);
        e = NX > 0 ? error_norm(m, h) : 0;
        if (!(e <= 1)) { /* rejected, NaN included */
            s->step = h * (e > 1 && e < 1e10 ? fmax(0.2, 0.9 * pow(e, -0.2)) : 0.1);
            if (s->step < 1e-14 * (1 + fabs(s->t))) {
                s->step = 0;
                return fail(m, "doStep: the derivative is not finite or not smooth at t = %g; check inputs and parameters", s->t + tau);
            }
            continue;
        }
        factor = e > 1e-10 ? fmin(5, fmax(0.2, 0.9 * pow(e, -0.2))) : 5;
        if (!last || factor < 1) s->step = h * factor;
        else s->step = fmax(s->step, h * factor);
        tau += h;
#if NZ > 0
        remember(m, m->x_new, input_at(m, tau), m->z_new);
        memcpy(s->z, m->z_new, sizeof s->z);
        s->step = fmin(s->step, MEMORY_STEP);
#endif
        memcpy(s->x, m->x_new, sizeof s->x);
        memcpy(m->k[0], m->k[6], sizeof m->k[0]);
        if (last) break;
    }
    return OK;
}
