/* x' = A x + B u, y = C x with arrays as variables, as FMI 3.0 model exchange and co-simulation. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "fmi3Functions.h"
#define N 2
#define SIZES 3 /* value references: sizes 1..3, then x, its derivative, u, A, B, C, y, start of x */
enum { X = SIZES + 1, DX, U, A, B, C, Y, X0, LAST };
static const size_t size_of[LAST] = {0, 0, 0, 0, N, N, 1, N * N, N, N * N, N, N};
typedef struct { double v[LAST][N * N], time; int initializing; } Model;
#define M ((Model *)c)

static void start(Model *m) {
    memset(m, 0, sizeof *m);
    static const double a[] = {0.0, 1.0, -4.0, -0.5}, b[] = {0.0, 1.0}, eye[] = {1.0, 0.0, 0.0, 1.0};
    memcpy(m->v[A], a, sizeof a);
    memcpy(m->v[B], b, sizeof b);
    memcpy(m->v[C], eye, sizeof eye);
    m->initializing = 1;
}
static void slope(const Model *m, const double *x, double *dx) {
    for (int i = 0; i < N; i++) {
        dx[i] = m->v[B][i] * m->v[U][0];
        for (int j = 0; j < N; j++) dx[i] += m->v[A][N * i + j] * x[j];
    }
}
static void outputs(Model *m) {
    slope(m, m->v[X], m->v[DX]);
    for (int i = 0; i < N; i++) {
        m->v[Y][i] = 0;
        for (int j = 0; j < N; j++) m->v[Y][i] += m->v[C][N * i + j] * m->v[X][j];
    }
}
static Model *made(fmi3String token) {
    if (strcmp(token, GUID)) return NULL;
    Model *m = malloc(sizeof(Model));
    start(m);
    return m;
}
#include "instances3.h"
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    M->initializing = 0;
    memcpy(M->v[X], M->v[X0], sizeof M->v[X]);
    return fmi3OK;
}
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { start(M); return fmi3OK; }
/* the number of values is that of all elements: one value too few or too many is refused */
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 v[], size_t count) {
    size_t at = 0;
    outputs(M);
    for (size_t i = 0; i < n; i++) {
        if (vr[i] < X || vr[i] >= LAST || at + size_of[vr[i]] > count) return fmi3Error;
        memcpy(v + at, M->v[vr[i]], size_of[vr[i]] * sizeof(double));
        at += size_of[vr[i]];
    }
    return at == count ? fmi3OK : fmi3Error;
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 v[], size_t count) {
    size_t at = 0;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] < X || vr[i] >= LAST || at + size_of[vr[i]] > count) return fmi3Error;
        if (vr[i] != U && !M->initializing) return fmi3Error;
        memcpy(M->v[vr[i]], v + at, size_of[vr[i]] * sizeof(double));
        at += size_of[vr[i]];
    }
    return at == count ? fmi3OK : fmi3Error;
}
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d, fmi3Boolean *e, fmi3Boolean *f, fmi3Float64 *t) {
    *a = *b = *d = *e = *f = fmi3False; *t = 0; return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean n, fmi3Boolean *e, fmi3Boolean *t) { *e = *t = fmi3False; return fmi3OK; }
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { M->time = t; return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) { if (n != N) return fmi3Error; memcpy(M->v[X], x, N * sizeof *x); return fmi3OK; }
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) { if (n != N) return fmi3Error; slope(M, M->v[X], dx); return fmi3OK; }
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { if (n != N) return fmi3Error; memcpy(x, M->v[X], N * sizeof *x); return fmi3OK; }
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { if (n != N) return fmi3Error; for (size_t i = 0; i < n; i++) x[i] = 1; return fmi3OK; }
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean n, fmi3Boolean *ev, fmi3Boolean *end, fmi3Boolean *early, fmi3Float64 *last) {
    int steps = (int)ceil(h / 1e-3 - 1e-9);
    for (int k = 0; k < steps; k++) {
        double s = h / steps, *x = M->v[X], r[4][N], at[N];
        for (int j = 0; j < 4; j++) {
            for (int i = 0; i < N; i++) at[i] = x[i] + (j ? (j == 3 ? s : s / 2) * r[j - 1][i] : 0);
            slope(M, at, r[j]);
        }
        for (int i = 0; i < N; i++) x[i] += s / 6 * (r[0][i] + 2 * r[1][i] + 2 * r[2][i] + r[3][i]);
    }
    M->time += h;
    *ev = *end = *early = fmi3False;
    *last = M->time;
    return fmi3OK;
}
