/* Elastic geared joint, two inertias, by Moreau's midpoint time stepping (leapfrog with set-valued friction).
   Positions move half a step, velocities take the whole impulse at the midpoint, positions move the other half.
   Coulomb friction is either set-valued (the impulse that stops the body, if friction can give it), tanh-smoothed,
   or a bristle. All quantities are link-referred. The parameter indices P_xxx are prepended by _engine.py. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#define RING 4096


static double clip(double x, double a) { return x > a ? a : (x < -a ? -a : x); }

/* velocity-proportional and position-dependent torques of one side, without the switching friction */
static double smooth_torque(const double *p, int o, double v, double heat)
{
    double a = fabs(v);
    return heat * (p[o + S_B] * v) + p[o + S_B2] * v * a + p[o + S_B3] * v * v * v + p[o + S_BA] * a;
}

/* magnitude of the switching friction for one direction of motion (+1 or -1) */
static double friction_level(const double *p, int o, double v, double direction, double fixed, double heat)
{
    double f = fixed + heat * p[o + S_TC] + direction * p[o + S_TCA];
    if (p[o + S_TS] != 0.0) f += p[o + S_TS] * exp(-pow(fabs(v) / p[o + S_VS], p[o + S_DS]));
    return f > 0.0 ? f : 0.0;
}

/* new velocity of one body: inertia j, torque f without switching friction, midpoint velocity guess vm */
static double kick(const double *p, int o, double j, double v, double f, double vm, double fixed, double heat,
                   double h, double z, double *z_new)
{
    double up = friction_level(p, o, vm, 1.0, fixed, heat), down = friction_level(p, o, vm, -1.0, fixed, heat);
    if (p[o + S_ZS] > 0.0) {
        double zn = (z + h * vm) / (1.0 + h * fabs(vm) / p[o + S_ZS]), zm = 0.5 * (z + zn) / p[o + S_ZS];
        *z_new = zn;
        return v + h / j * (f - (zm >= 0.0 ? up : down) * zm);
    }
    if (p[o + S_V0] > 0.0) {
        double s = tanh(vm / p[o + S_V0]);
        return v + h / j * (f - (s >= 0.0 ? up : down) * s);
    }
    double need = f + j * v / h;                     /* friction torque that would stop the body in this step */
    if (need > up) return v + h / j * (f - up);
    if (need < -down) return v + h / j * (f + down);
    return 0.0;
}

/* static torque of the transmission at torsion x; returns the contact flag of a dead zone through in_contact */
static double spring(const double *p, double x, double *in_contact)
{
    double t, a;
    *in_contact = 1.0;
    if (p[P_GAP] > 0.0) {
        double y = x - clip(x, p[P_GAP]);
        *in_contact = y != 0.0;
        x = y;
    }
    if (p[P_WIND] != 0.0) x -= p[P_WIND] * tanh(x / p[P_WIND_X]);
    a = fabs(x);
    t = p[P_K] * x + p[P_K3] * x * x * x;
    if (p[P_PW_D1] != 0.0 || p[P_PW_D2] != 0.0) {
        double e = 0.0;
        if (a > p[P_PW_X1]) e += p[P_PW_D1] * (a - p[P_PW_X1]);
        if (a > p[P_PW_X2]) e += p[P_PW_D2] * (a - p[P_PW_X2]);
        t += x < 0.0 ? -e : e;
    }
    return t;
}

/* what the cubic through samples a and a + 1, with slopes from their neighbours, has over the line at a + f */
static double bulge(const double *y, int n, int a, double f)
{
    double rise = y[a + 1] - y[a];
    double begin = a > 0 ? 0.5 * (y[a + 1] - y[a - 1]) - rise : 0.0;
    double end = a < n - 2 ? 0.5 * (y[a + 2] - y[a]) - rise : 0.0;
    return f * (1.0 - f) * ((1.0 - f) * begin - f * end);
}

/* ref, dref: n_ref samples at dt_ref; out: n_out rows of 7 (time, current, q, v, th, w, torque); snag: rows t0, length, torque */
int simulate(const double *p, const double *ref, const double *dref, int n_ref, double dt_ref, const double *state,
             double h, int stride, int n_pre, int n_out, const double *snag, int n_snag, double *out)
{
    static double ring_i[RING], ring_t[RING];
    double q = state[0], v = state[1], th = state[2], w = state[3], x = state[2], u = state[3];
    double zm = 0.0, zl = 0.0, zh[3] = {0.0, 0.0, 0.0};
    double d_old, held[5] = {0};
    int i, k, j, pending = -1, total = n_pre + (n_out - 1) * stride + 1, first = 1;
    int lag_i = (int)p[P_LAG_I], lag_t = (int)p[P_LAG_T];
    double jm = p[P_JM], jx = p[P_JL] * p[P_FLEX], jl = p[P_JL] - jx, wf = 6.283185307179586 * p[P_FLEX_F];
    if (lag_i > RING - 2 || lag_t > RING - 2 || n_out < 1) return 1;
    memset(ring_i, 0, sizeof ring_i);
    memset(ring_t, 0, sizeof ring_t);
    d_old = q - th;
    for (i = 0; i < total; i++) {
        double t0 = (i - n_pre) * h, t = t0 + 0.5 * h, r, dr, e = 0.0, contact, ts, hyst = 0.0, pos_m, pos_l, fx_m, fx_l;
        double qm, tm, xm, vm = v, wm = w, um = u, vn = v, wn = w, un = u, znm = zm, znl = zl, cur = 0.0, tor = 0.0, heat = 1.0;
        if (i >= n_pre && (i - n_pre) % stride == 0) {
            pending = (i - n_pre) / stride;
            held[0] = t0; held[1] = q; held[2] = v; held[3] = th; held[4] = w;
        }
        if (t <= 0.0) { r = ref[0]; dr = 0.0; }
        else {
            double s = t / dt_ref; int a = (int)s; double f;
            if (a > n_ref - 2) a = n_ref - 2;
            f = s - a;
            r = ref[a] + f * (ref[a + 1] - ref[a]);
            dr = dref[a] + f * (dref[a + 1] - dref[a]);
            if (p[P_CURVE] != 0.0) {
                r += bulge(ref, n_ref, a, f);
                dr += bulge(dref, n_ref, a, f);
            }
        }
        if (p[P_HEAT] != 0.0 && t > 0.0) heat = 1.0 - p[P_HEAT] * (1.0 - exp(-t / p[P_HEAT_TAU]));
        qm = q + 0.5 * h * v; tm = th + 0.5 * h * w; xm = x + 0.5 * h * u;
        if (p[P_KE1] != 0.0) e += p[P_KE1] * sin(p[P_KE1_O] * p[P_N] * qm + p[P_KE1_P]);
        if (p[P_KE2] != 0.0) e += p[P_KE2] * sin(p[P_KE2_O] * p[P_N] * qm + p[P_KE2_P]);
        ts = spring(p, qm - tm + e, &contact);
        for (k = 0; k < 3; k++) if (p[P_HK1 + k] != 0.0) {
            zh[k] = clip(zh[k] + (qm - tm) - d_old, p[P_HS1 + k]);
            hyst += p[P_HK1 + k] * zh[k];
        }
        d_old = qm - tm;
        ts += hyst;
        pos_m = p[P_M + S_KA] * qm;
        pos_l = p[P_L + S_KA] * tm;
        if (p[P_M + S_SIN] != 0.0 || p[P_M + S_COS] != 0.0) pos_m += p[P_M + S_SIN] * sin(tm) + p[P_M + S_COS] * cos(tm);
        if (p[P_L + S_SIN] != 0.0 || p[P_L + S_COS] != 0.0) pos_l += p[P_L + S_SIN] * sin(tm) + p[P_L + S_COS] * cos(tm);
        if (p[P_COG] != 0.0) pos_m += p[P_COG] * sin(p[P_COG_O] * p[P_N] * qm + p[P_COG_P]);
        if (p[P_STOP] != 0.0 && tm > p[P_STOP_X]) pos_l += p[P_STOP] * (tm - p[P_STOP_X]);
        if (p[P_TG] != 0.0) pos_l -= p[P_TG] * sin(tm);
        fx_m = p[P_M + S_CYC] != 0.0 ? p[P_M + S_CYC] * sin(tm + p[P_M + S_CYC_P]) : 0.0;
        fx_l = p[P_L + S_CYC] != 0.0 ? p[P_L + S_CYC] * sin(tm + p[P_L + S_CYC_P]) : 0.0;
        if (p[P_BUMP] != 0.0) {
            double y = (tm - p[P_BUMP_X]) / p[P_BUMP_W]; y *= y; y *= y;
            fx_m += p[P_BUMP] / (1.0 + y * y);
        }
        for (k = 0; k < n_snag; k++) {
            double y = (t - snag[3 * k]) / snag[3 * k + 1];
            if (y > 0.0 && y < 1.0) fx_m += snag[3 * k + 2] * sin(3.141592653589793 * y);
        }
        for (j = 0; j < 3; j++) {
            double drive = p[P_KP] * (r - qm) + p[P_KD] * (dr - vm), back = 0.0;
            tor = ts + contact * p[P_C] * (vm - wm);
            cur = drive / p[P_NKM];
            if (jx > 0.0) {
                back = jx * (wf * wf * (xm - tm) + 2.0 * p[P_FLEX_Z] * wf * (um - wm));
                un = u - h * back / jx;
            }
            vn = kick(p, P_M, jm, v, p[P_KM] * drive - tor - pos_m - smooth_torque(p, P_M, vm, heat), vm,
                      fx_m + p[P_M + S_MU] * fabs(tor), heat, h, zm, &znm);
            wn = kick(p, P_L, jl, w, tor + back - pos_l - smooth_torque(p, P_L, wm, 1.0), wm,
                      fx_l + p[P_L + S_MU] * fabs(tor), 1.0, h, zl, &znl);
            vm = 0.5 * (v + vn); wm = 0.5 * (w + wn); um = 0.5 * (u + un);
        }
        v = vn; w = wn; u = un; zm = znm; zl = znl;
        q = qm + 0.5 * h * v; th = tm + 0.5 * h * w;
        x = jx > 0.0 ? xm + 0.5 * h * u : th;
        if (jx <= 0.0) u = w;
        if (first) { for (k = 0; k < RING; k++) { ring_i[k] = cur; ring_t[k] = tor; } first = 0; }
        ring_i[i % RING] = cur; ring_t[i % RING] = tor;
        if (pending >= 0) {
            double *o = out + 7 * pending;
            int a = (i - lag_i + RING) % RING, b = (i - lag_t + RING) % RING;
            o[0] = held[0];
            o[1] = 0.5 * (ring_i[a] + ring_i[(a + RING - 1) % RING]);
            o[2] = held[1]; o[3] = held[2]; o[4] = held[3]; o[5] = held[4];
            o[6] = 0.5 * (ring_t[b] + ring_t[(b + RING - 1) % RING]);
            pending = -1;
        }
        if (!(fabs(q) < 1e3) || !(fabs(th) < 1e3)) return 2;
    }
    return 0;
}

int write_table(const char *path, const char *header, const double *data, int rows, int columns)
{
    FILE *f = fopen(path, "wb");
    int i, j;
    if (!f) return 1;
    fputs(header, f);
    fputc('\n', f);
    for (i = 0; i < rows; i++)
        for (j = 0; j < columns; j++)
            fprintf(f, j + 1 < columns ? "%.9g," : "%.9g\n", data[i * columns + j]);
    return fclose(f) != 0;
}
