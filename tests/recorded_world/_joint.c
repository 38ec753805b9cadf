/* A geared axis as two bodies on one spring, in closed loop, link-referred.
   Positions drift half a step, velocities take the impulse of the whole step at the midpoint, positions drift
   the other half. Dry friction is set-valued: a body whose needed holding torque lies inside the friction band
   ends the step at rest. The reaction of a position error of the gear follows from virtual work, so that the
   frictionless axis keeps its energy. Indices P_xxx and F_xxx are prepended by _engine.py. */
#include <math.h>
#include <stdio.h>

static double bounded(double x, double a) { return x > a ? a : (x < -a ? -a : x); }

/* torques of velocity that vanish at rest */
static double fluid(const double *f, double v, double warm)
{
    double a = fabs(v), t = warm * f[F_B] * v + f[F_B2] * v * a + f[F_B3] * v * v * v + f[F_BA] * a;
    int i;
    for (i = 0; i < 3; i++)
        if (f[F_O1 + 2 * i] != 0.0) t += f[F_O1 + 2 * i] * tanh(v / f[F_O1 + 2 * i + 1]);
    return t;
}

/* level of dry friction in one direction (+1, -1); more: what load and place add */
static double band(const double *f, double v, double way, double more, double warm)
{
    double t = warm * f[F_TC] + way * f[F_TCA] + more;
    if (f[F_TS] != 0.0) t += f[F_TS] * exp(-pow(fabs(v) / f[F_VS], f[F_DS]));
    return t > 0.0 ? t : 0.0;
}

/* a rub at one place, in both directions (ONE 0) or in one of them (ONE +1, -1) */
static double rub(const double *f, double x, double way)
{
    double y = (x - f[F_BUMP_X]) / f[F_BUMP_W];
    if (f[F_BUMP] == 0.0 || f[F_ONE] * way < 0.0) return 0.0;
    y *= y;
    return f[F_BUMP] / (1.0 + y * y);
}

struct body { double inertia, v, force, guess, up, down; };

static double next_velocity(const double *f, const struct body *b, double h, double *bristle)
{
    double need = b->force + b->inertia * b->v / h, s;
    if (f[F_ZS] > 0.0) {                              /* bristle: a spring that slips at its end */
        double z0 = *bristle, z = (z0 + h * b->guess) / (1.0 + h * fabs(b->guess) / f[F_ZS]);
        s = 0.5 * (z0 + z) / f[F_ZS];
        *bristle = z;
        return h / b->inertia * (need - (s >= 0.0 ? b->up : b->down) * s);
    }
    if (f[F_V0] > 0.0) {
        s = tanh(b->guess / f[F_V0]);
        return h / b->inertia * (need - (s >= 0.0 ? b->up : b->down) * s);
    }
    if (need > b->up) return h / b->inertia * (need - b->up);
    if (need < -b->down) return h / b->inertia * (need + b->down);
    return 0.0;
}

/* static torque over the twist; touching is 0 inside a gap */
static double spring(const double *p, double x, double *touching)
{
    double t, a, e;
    *touching = 1.0;
    if (p[P_GAP] > 0.0) {
        double y = x - bounded(x, p[P_GAP]);
        *touching = y != 0.0;
        x = y;
    }
    if (p[P_WIND] != 0.0) x -= p[P_WIND] * tanh(x / p[P_WIND_X]);
    t = p[P_K] * x + p[P_K3] * x * x * x;
    a = fabs(x);
    e = (a > p[P_X1] ? p[P_D1] * (a - p[P_X1]) : 0.0) + (a > p[P_X2] ? p[P_D2] * (a - p[P_X2]) : 0.0);
    return t + (x < 0.0 ? -e : e);
}

/* ref: rows of position and velocity, one per output row; count: rows, steps per row, steps before the
   record, pushes; push: rows of start, length, torque, side (0 motor, 1 link); out: rows of drive torque as
   commanded, q, v, th, w, torque of the transmission, energy */
int simulate(const double *p, const double *state, const double *ref, const long *count, const double *push,
             double *out)
{
    const double *fm = p + P_M, *fl = p + P_L, h = p[P_STEP];
    long rows = count[0], stride = count[1], before = count[2], pushes = count[3], i, n, k;
    double q = state[0], v = state[1], th = state[2], w = state[3], zm = 0.0, zl = 0.0, z[3] = {0, 0, 0};
    double old = 0.0, sum = 0.0, u_before = 0.0, torque_before = 0.0;
    int j, started = 0;
    for (n = 0; n < before + (rows - 1) * stride + 1; n++) {
        double t = (n - before + 0.5) * h, r, dr, qm, tm, err = 0.0, slope = 0.0, touching, stat, hys = 0.0;
        double vm = v, wm = w, vn = v, wn = w, znm = zm, znl = zl, u = 0.0, torque = 0.0, warm = 1.0, pm, pl;
        double em = 0.0, el = 0.0, cm = 0.0, cl = 0.0, x;
        double *o = n >= before && (n - before) % stride == 0 ? out + 7 * ((n - before) / stride) : 0;
        if (t <= 0.0) { r = ref[0]; dr = 0.0; }
        else {
            double s = t / (h * stride), f;
            i = (long)s;
            if (i > rows - 2) i = rows - 2;
            f = s - i;
            r = ref[2 * i] + f * (ref[2 * i + 2] - ref[2 * i]);
            dr = ref[2 * i + 1] + f * (ref[2 * i + 3] - ref[2 * i + 1]);
            if (p[P_HEAT] != 0.0) warm = 1.0 - p[P_HEAT] * (1.0 - exp(-t / p[P_HEAT_T]));
        }
        if (o) { o[1] = q; o[2] = v; o[3] = th; o[4] = w; }
        qm = q + 0.5 * h * v;
        tm = th + 0.5 * h * w;
        for (k = 0; k < 2; k++) if (p[P_KE1 + 3 * k] != 0.0) {
            double rate = p[P_KE1 + 3 * k + 1] * p[P_N], a = rate * qm + p[P_KE1 + 3 * k + 2];
            err += p[P_KE1 + 3 * k] * sin(a);
            slope += p[P_KE1 + 3 * k] * rate * cos(a);
        }
        x = qm - tm + err;
        stat = spring(p, x, &touching);
        if (!started) { old = x; started = 1; }
        for (k = 0; k < 3; k++) if (p[P_HK1 + k] != 0.0) {
            z[k] = bounded(z[k] + x - old, p[P_HS1 + k]);
            hys += p[P_HK1 + k] * z[k];
        }
        old = x;
        pm = fm[F_KA] * (qm - fm[F_KA_Q]) + fm[F_SIN] * sin(tm) + fm[F_COS] * cos(tm);
        pl = fl[F_KA] * (tm - fl[F_KA_Q]) - p[P_TG] * sin(tm + p[P_TG_P]);
        if (fl[F_SIN] != 0.0 || fl[F_COS] != 0.0) pl += fl[F_SIN] * sin(tm) + fl[F_COS] * cos(tm);
        if (p[P_COG] != 0.0) pm += p[P_COG] * sin(p[P_COG_O] * p[P_N] * qm + p[P_COG_P]);
        if (fm[F_CYC] != 0.0) cm = fm[F_CYC] * sin(tm + fm[F_CYC_P]);
        if (fl[F_CYC] != 0.0) cl = fl[F_CYC] * sin(tm + fl[F_CYC_P]);
        for (k = 0; k < pushes; k++) {
            double y = (t - push[4 * k]) / push[4 * k + 1];
            if (y > 0.0 && y < 1.0) *(push[4 * k + 3] > 0.5 ? &el : &em) += push[4 * k + 2] * sin(M_PI * y);
        }
        for (j = 0; j < 3; j++) {
            struct body m, l;
            double drive;
            u = bounded(p[P_KP] * (r - qm) + p[P_KD] * (dr - vm) + p[P_KI] * sum, p[P_LIMIT]);
            drive = p[P_KM] * u;
            if (p[P_SAT] > 0.0) drive = p[P_SAT] * tanh(drive / p[P_SAT]);
            torque = stat + hys + touching * p[P_C] * (vm - wm + slope * vm);
            m.inertia = p[P_JM]; m.v = v; m.guess = vm;
            m.force = drive - torque * (1.0 + slope) - pm - em - fluid(fm, vm, warm);
            m.up = band(fm, vm, 1.0, cm + rub(fm, tm, 1.0) + fm[F_MU] * fabs(torque), warm);
            m.down = band(fm, vm, -1.0, cm + rub(fm, tm, -1.0) + fm[F_MU] * fabs(torque), warm);
            l.inertia = p[P_JL]; l.v = w; l.guess = wm;
            l.force = torque - pl - el - fluid(fl, wm, 1.0);
            l.up = band(fl, wm, 1.0, cl + rub(fl, tm, 1.0) + fl[F_MU] * fabs(torque), 1.0);
            l.down = band(fl, wm, -1.0, cl + rub(fl, tm, -1.0) + fl[F_MU] * fabs(torque), 1.0);
            znm = zm; znl = zl;
            vn = next_velocity(fm, &m, h, &znm);
            wn = next_velocity(fl, &l, h, &znl);
            vm = 0.5 * (v + vn);
            wm = 0.5 * (w + wn);
        }
        if (o) {
            /* torques belong to the midpoint of a step, the row to its beginning */
            o[0] = n ? 0.5 * (u + u_before) : u;
            o[5] = n ? 0.5 * (torque + torque_before) : torque;
            o[6] = 0.5 * p[P_JM] * vm * vm + 0.5 * p[P_JL] * wm * wm + 0.5 * p[P_K] * x * x
                 + 0.25 * p[P_K3] * x * x * x * x + p[P_TG] * cos(tm + p[P_TG_P]);
        }
        u_before = u;
        torque_before = torque;
        /* no drive goes on integrating at its limit: the joint would swing ever farther */
        if (fabs(u) < p[P_LIMIT]) sum += h * (r - qm);
        v = vn; w = wn; zm = znm; zl = znl;
        q = qm + 0.5 * h * v;
        th = tm + 0.5 * h * w;
        if (!(fabs(q) < 1e4) || !(fabs(th) < 1e4)) return 2;
    }
    return 0;
}

int write_table(const char *path, const char *header, const double *data, const long *shape)
{
    FILE *f = fopen(path, "wb");
    long i, j;
    if (!f) return 1;
    fprintf(f, "%s\n", header);
    for (i = 0; i < shape[0]; i++)
        for (j = 0; j < shape[1]; j++)
            fprintf(f, j + 1 < shape[1] ? "%.9g," : "%.9g\n", data[i * shape[1] + j]);
    return fclose(f) != 0;
}
