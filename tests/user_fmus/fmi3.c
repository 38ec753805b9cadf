/* A test model as FMI 3.0 model exchange and co-simulation; functions of other interfaces are left out. */
#include <stdlib.h>
#include <string.h>
#include "fmi3Functions.h"
#include "models.h"
#define M ((Model *)c)

static Model *made(fmi3String token) {
    Model *m = calloc(1, sizeof(Model));
    if (strcmp(token, GUID)) { free(m); return NULL; }
    model_start(m);
    return m;
}
#include "instances3.h"
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { M->initializing = 0; BEGIN(M) return fmi3OK; }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { model_start(M); return fmi3OK; }
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 v[], size_t k) {
    for (size_t i = 0; i < n; i++) if (model_get(M, vr[i], v + i)) return fmi3Error;
    return fmi3OK;
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 v[], size_t k) {
    for (size_t i = 0; i < n; i++) if (model_set(M, vr[i], v[i])) return fmi3Error;
    return fmi3OK;
}
#define NONE(type, name) \
    fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, type v[], size_t k) { return n ? fmi3Error : fmi3OK; } \
    fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const type v[], size_t k) { return n ? fmi3Error : fmi3OK; }
NONE(fmi3Int32, Int32)
NONE(fmi3Boolean, Boolean)
NONE(fmi3String, String)
fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *s) { return fmi3Error; }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState s) { return fmi3Error; }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *s) { return fmi3Error; }
fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[], size_t nk,
    const fmi3Float64 seed[], size_t ns, fmi3Float64 out[], size_t no) { return model_directional(M, u, nu, k, nk, seed, out) ? fmi3Error : fmi3OK; }
fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[], size_t nk,
    const fmi3Float64 seed[], size_t ns, fmi3Float64 out[], size_t no) { return fmi3Error; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d, fmi3Boolean *e, fmi3Boolean *f, fmi3Float64 *t) {
    *a = *b = *d = *e = *f = fmi3False; *t = 0; return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean n, fmi3Boolean *e, fmi3Boolean *t) { *e = *t = fmi3False; return fmi3OK; }
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { M->time = t; return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) { memcpy(M->x, x, sizeof M->x); return fmi3OK; }
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) { model_eval(M->x, M->u, M->p, dx, 0); return fmi3OK; }
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 e[], size_t n) { return fmi3OK; }
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { memcpy(x, M->x, sizeof M->x); return fmi3OK; }
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { for (size_t i = 0; i < n; i++) x[i] = 1; return fmi3OK; }
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { *n = 0; return fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { *n = NX; return fmi3OK; }
fmi3Status fmi3EnterStepMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean n, fmi3Boolean *ev, fmi3Boolean *end, fmi3Boolean *early, fmi3Float64 *last) {
    model_advance(M, h);
    *ev = *end = *early = fmi3False;
    *last = M->time;
    return fmi3OK;
}
