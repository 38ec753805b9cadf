/* Right-hand sides of the test models. Complex arithmetic gives exact directional derivatives (complex step). */
#include <complex.h>
#include <math.h>
typedef double complex cplx;

#if defined MODEL_VAN_DER_POL
#define NX 2
#define NU 0
#define NP 1
#define NY 2
static const double start_x[NX] = {2.0, 0.0}, start_p[NP] = {1.0};
static const double start_u[1] = {0.0};
static void model_f(const cplx *x, const cplx *u, const cplx *p, cplx *dx) {
    dx[0] = x[1];
    dx[1] = p[0] * (1 - x[0] * x[0]) * x[1] - x[0];
}
static void model_y(const cplx *x, const cplx *u, const cplx *p, cplx *y) { y[0] = x[0]; y[1] = x[1]; }

#elif defined MODEL_DAHLQUIST
#define NX 1
#define NU 0
#define NP 1
#define NY 1
static const double start_x[NX] = {1.0}, start_p[NP] = {1.0}, start_u[1] = {0.0};
static void model_f(const cplx *x, const cplx *u, const cplx *p, cplx *dx) { dx[0] = -p[0] * x[0]; }
static void model_y(const cplx *x, const cplx *u, const cplx *p, cplx *y) { y[0] = x[0]; }

#elif defined MODEL_ELASTIC /* motor, gear of ratio 100 as a spring with damping, hanging link; motor side on its own shaft */
#define NX 4
#define NU 1
#define NP 7
#define NY 5
#define GEAR 100.0
static const double start_x[NX] = {0, 0, 0, 0}, start_u[NU] = {0.0};
static const double start_p[NP] = {4.0e-4, 11.0, 2.0e4, 25.0, 2.0e-3, 0.15, 55.0};
static cplx spring(const cplx *x, const cplx *p) { return p[2] * (x[0] / GEAR - x[2]) + p[3] * (x[1] / GEAR - x[3]); }
static void model_f(const cplx *x, const cplx *u, const cplx *p, cplx *dx) {
    cplx t = spring(x, p);
    dx[0] = x[1];
    dx[1] = (u[0] - p[4] * x[1] - p[5] * ctanh(x[1] / (GEAR * 2e-3)) - t / GEAR) / p[0];
    dx[2] = x[3];
    dx[3] = (t - p[6] * csin(x[2])) / p[1];
}
static void model_y(const cplx *x, const cplx *u, const cplx *p, cplx *y) {
    for (int i = 0; i < 4; i++) y[i] = x[i];
    y[4] = spring(x, p);
}

#elif defined MODEL_BOUNCING_BALL /* height and speed, free fall; the bounce is a state event */
#define NX 2
#define NU 0
#define NP 2
#define NY 2
static const double start_x[NX] = {1.0, 0.0}, start_p[NP] = {9.81, 0.7}, start_u[1] = {0.0};
static void model_f(const cplx *x, const cplx *u, const cplx *p, cplx *dx) { dx[0] = x[1]; dx[1] = -p[0]; }
static void model_y(const cplx *x, const cplx *u, const cplx *p, cplx *y) { y[0] = x[0]; y[1] = x[1]; }
#define EVENT(m) if ((m)->x[0] < 0 && (m)->x[1] < 0) { (m)->x[0] = 0; (m)->x[1] *= -(m)->p[1]; }

#elif defined MODEL_SERVO /* the axis below in degrees, its states hidden: start values are parameters */
#define NX 2
#define NU 1
#define NP 6
#define NY 2
#define DEGREE 0.017453292519943295
static const double start_x[NX] = {0, 0}, start_u[NU] = {0.0};
static const double start_p[NP] = {2.0, 1.0, 1.0, 5.0, 0.0, 0.0};
static void model_f(const cplx *x, const cplx *u, const cplx *p, cplx *dx) {
    dx[0] = x[1];
    dx[1] = (u[0] - p[1] * x[1] - p[2] * ctanh(x[1] / 0.01) - p[3] * csin(x[0])) / p[0];
}
static void model_y(const cplx *x, const cplx *u, const cplx *p, cplx *y) { y[0] = x[0] / DEGREE; y[1] = x[1] / DEGREE; }
#define BEGIN(m) { (m)->x[0] = (m)->p[4] * DEGREE; (m)->x[1] = (m)->p[5] * DEGREE; }

#else /* an axis: inertia, viscous and Coulomb friction, gravity; and a parameter that acts on nothing */
#define NX 2
#define NU 1
#define NP 5
#define NY 2
static const double start_x[NX] = {0.0, 0.0}, start_p[NP] = {2.0, 1.0, 1.0, 5.0, 1.0}, start_u[NU] = {0.0};
static void model_f(const cplx *x, const cplx *u, const cplx *p, cplx *dx) {
    dx[0] = x[1];
    dx[1] = (u[0] - p[1] * x[1] - p[2] * ctanh(x[1] / 0.01) - p[3] * csin(x[0])) / p[0];
}
static void model_y(const cplx *x, const cplx *u, const cplx *p, cplx *y) { y[0] = x[0]; y[1] = x[1]; }
#endif

#ifndef EVENT
#define EVENT(m)
#endif
#ifndef BEGIN
#define BEGIN(m)
#endif

/* value references: states, derivatives, inputs, parameters, outputs */
#define VR_X 1
#define VR_DX 11
#define VR_U 21
#define VR_P 31
#define VR_Y 41

typedef struct {
    double time, x[NX], u[NU + 1], p[NP];
    int initializing; /* 1 until initialization is left */
    void *log;
} Model;

static void model_start(Model *m) {
    for (int i = 0; i < NX; i++) m->x[i] = start_x[i];
    for (int i = 0; i < NU; i++) m->u[i] = start_u[i];
    for (int i = 0; i < NP; i++) m->p[i] = start_p[i];
    m->initializing = 1;
}

static void model_eval(const double *xr, const double *ur, const double *pr, double *dx, double *y) {
    cplx x[NX], u[NU + 1], p[NP], d[NX], out[NY];
    for (int i = 0; i < NX; i++) x[i] = xr[i];
    for (int i = 0; i < NU; i++) u[i] = ur[i];
    for (int i = 0; i < NP; i++) p[i] = pr[i];
    if (dx) { model_f(x, u, p, d); for (int i = 0; i < NX; i++) dx[i] = creal(d[i]); }
    if (y) { model_y(x, u, p, out); for (int i = 0; i < NY; i++) y[i] = creal(out[i]); }
}

/* Runge-Kutta of fourth order, at most 1 ms a step. */
static void model_advance(Model *m, double h) {
    int n = (int)ceil(h / 1e-3 - 1e-9);
    double s = h / n, k[4][NX], x[NX];
    for (int step = 0; step < n; step++) {
        for (int stage = 0; stage < 4; stage++) {
            double c = stage == 0 ? 0 : stage == 3 ? s : s / 2;
            for (int i = 0; i < NX; i++) x[i] = m->x[i] + (stage ? c * k[stage - 1][i] : 0);
            model_eval(x, m->u, m->p, k[stage], 0);
        }
        for (int i = 0; i < NX; i++) m->x[i] += s / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
        EVENT(m)
    }
    m->time += h;
}

/* 0 where the value can be set; strict: states and parameters during initialization only */
static int model_set(Model *m, unsigned vr, double value) {
    if (vr >= VR_U && vr < VR_U + NU) { m->u[vr - VR_U] = value; return 0; }
#ifdef STRICT
    if (!m->initializing) return 3;
#endif
    if (vr >= VR_P && vr < VR_P + NP) { m->p[vr - VR_P] = value; return 0; }
    if (vr >= VR_X && vr < VR_X + NX) { m->x[vr - VR_X] = value; return 0; }
    if (vr == 0) { m->time = value; return 0; }
    return 3;
}

static int model_get(Model *m, unsigned vr, double *value) {
    double dx[NX], y[NY];
    model_eval(m->x, m->u, m->p, dx, y);
    if (vr == 0) *value = m->time;
    else if (vr >= VR_X && vr < VR_X + NX) *value = m->x[vr - VR_X];
    else if (vr >= VR_DX && vr < VR_DX + NX) *value = dx[vr - VR_DX];
    else if (vr >= VR_U && vr < VR_U + NU) *value = m->u[vr - VR_U];
    else if (vr >= VR_P && vr < VR_P + NP) *value = m->p[vr - VR_P];
    else if (vr >= VR_Y && vr < VR_Y + NY) *value = y[vr - VR_Y];
    else return 3;
    return 0;
}

static int model_directional(Model *m, const unsigned *unknown, size_t n, const unsigned *known, size_t k, const double *seed, double *out) {
    const double h = 1e-30;
    cplx x[NX], u[NU + 1], p[NP], d[NX], y[NY];
    for (int i = 0; i < NX; i++) x[i] = m->x[i];
    for (int i = 0; i < NU; i++) u[i] = m->u[i];
    for (int i = 0; i < NP; i++) p[i] = m->p[i];
    for (size_t j = 0; j < k; j++) {
        unsigned vr = known[j];
        if (vr >= VR_X && vr < VR_X + NX) x[vr - VR_X] += I * h * seed[j];
        else if (vr >= VR_U && vr < VR_U + NU) u[vr - VR_U] += I * h * seed[j];
        else if (vr >= VR_P && vr < VR_P + NP) p[vr - VR_P] += I * h * seed[j];
        else return 3;
    }
    model_f(x, u, p, d);
    model_y(x, u, p, y);
    for (size_t j = 0; j < n; j++) {
        unsigned vr = unknown[j];
        if (vr >= VR_DX && vr < VR_DX + NX) out[j] = cimag(d[vr - VR_DX]) / h;
        else if (vr >= VR_Y && vr < VR_Y + NY) out[j] = cimag(y[vr - VR_Y]) / h;
        else return 3;
#ifdef WRONG
        out[j] *= 1.01;
#endif
    }
    return 0;
}
