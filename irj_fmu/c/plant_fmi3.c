/* FMI 3.0 wrapper, model exchange and co-simulation, round a plant in generated C.
 *
 * plant_config.h and plant_model.c are those of plant_wrapper.c. Value references run x, dx, u, p, y, z without gaps;
 * the time comes last. A plant with memory z runs in co-simulation only.
 */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "plant_config.h"

#define CASADI_SYMBOL_EXPORT static
#include "plant_model.c"

#define DIM(n) ((n) > 0 ? (n) : 1)

enum { VR_DX = NX, VR_U = 2 * NX, VR_P = VR_U + NU, VR_Y = VR_P + NP, VR_Z = VR_Y + NY, VR_TIME = VR_Z + NZ };

typedef enum { INSTANTIATED = 1, INITIALIZING, EVENTS, CONTINUOUS, STEPPING, TERMINATED } Phase;

#define MAX_SUBSTEPS 2000000L

typedef struct { /* everything that changes; one copy of it is one FMU state */
    char token[40];
    Phase phase;
    int steps; /* an instance for co-simulation */
    double t, step, rtol, x[DIM(NX)], u[DIM(NU)], p[DIM(NP)], z[DIM(NZ)];
} State;

typedef struct {
    State s;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    int f_is_fresh, y_is_fresh;
    double dx[DIM(NX)], y[DIM(NY)];
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double w[DIM(SZ_W)];
    casadi_int iw[DIM(SZ_IW)];
    double k[7][DIM(NX)], x_new[DIM(NX)], x_stage[DIM(NX)], z_stage[DIM(NZ)], z_new[DIM(NZ)];
} Plant;



static fmi3Status fail(Plant *m, const char *format, ...) {
    char text[256];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    if (m->log) m->log(m->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

static void restart(State *s) {
    const int steps = s->steps;
    memset(s, 0, sizeof *s);
    s->steps = steps;
    s->rtol = DEFAULT_TOLERANCE;
    memcpy(s->token, PLANT_GUID, strlen(PLANT_GUID));
    s->phase = INSTANTIATED;
    memcpy(s->x, start_x, sizeof s->x);
    memcpy(s->u, start_u, sizeof s->u);
    memcpy(s->p, start_p, sizeof s->p);
    memcpy(s->z, start_z, sizeof s->z);
}

static void stale(Plant *m) { m->f_is_fresh = m->y_is_fresh = 0; }

typedef Plant Instance;
#define TOKEN PLANT_GUID
static void restored(Plant *m) { stale(m); }
static void discard(Plant *m) { free(m); }
#include "fmi3_common.c"

typedef fmi3Status Status;
#define OK fmi3OK
#include "plant_integrator.c"

/* ---- life cycle ----------------------------------------------------------- */

static Plant *instance(int steps, fmi3String token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    Plant *m = calloc(1, sizeof *m);
    if (!m) return NULL;
    m->s.steps = steps;
    m->environment = environment;
    m->log = log;
    if (!token || strcmp(token, PLANT_GUID) != 0) {
        fail(m, "instantiate: the token is not that of this library");
        free(m);
        return NULL;
    }
    if (!steps && NZ > 0) {
        fail(m, "instantiate: this plant has memory and runs in co-simulation only");
        free(m);
        return NULL;
    }
    restart(&m->s);
    if (born(&instances, m)) return m;
    free(m);
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    (void)name; (void)resources; (void)visible; (void)logging;
    return instance(0, token, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name; (void)resources; (void)visible; (void)logging; (void)early; (void)required; (void)n; (void)update;
    if (events) {
        if (log) log(environment, fmi3Error, "logStatusError", "instantiate: this FMU has no event mode in co-simulation");
        return NULL;
    }
    return instance(1, token, environment, log);
}

/* between initialization and termination */
#define EXCHANGING(call) do { \
    LIVING(call); \
    if (((Plant *)c)->s.phase != EVENTS && ((Plant *)c)->s.phase != CONTINUOUS) return fail(c, "%s: called out of order", call); \
} while (0)

static fmi3Status change(Plant *m, Phase from, Phase to, const char *name) {
    if (m->s.phase != from) return fail(m, "%s: called out of order", name);
    m->s.phase = to;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    LIVING("fmi3EnterInitializationMode");
    if (has_tolerance && !(tolerance > 0 && tolerance < 1)) return fail(c, "enterInitializationMode: tolerance %g is not between 0 and 1", tolerance);
    if (has_tolerance) ((Plant *)c)->s.rtol = fmax(tolerance, 1e-13);
    ((Plant *)c)->s.t = start;
    return change(c, INSTANTIATED, INITIALIZING, "enterInitializationMode");
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    LIVING("fmi3ExitInitializationMode");
    return change(c, INITIALIZING, ((Plant *)c)->s.steps ? STEPPING : EVENTS, "exitInitializationMode");
}
fmi3Status fmi3EnterEventMode(fmi3Instance c) { EXCHANGING("fmi3EnterEventMode"); ((Plant *)c)->s.phase = EVENTS; return fmi3OK; }
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { EXCHANGING("fmi3EnterContinuousTimeMode"); ((Plant *)c)->s.phase = CONTINUOUS; return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) {
    LIVING("fmi3Terminate");
    if (((Plant *)c)->s.phase <= INITIALIZING || ((Plant *)c)->s.phase == TERMINATED) return fail(c, "fmi3Terminate: called out of order");
    ((Plant *)c)->s.phase = TERMINATED;
    return fmi3OK;
}
fmi3Status fmi3Reset(fmi3Instance c) {
    LIVING("fmi3Reset");
    restart(&((Plant *)c)->s);
    stale(c);
    return fmi3OK;
}

/* ---- variables ------------------------------------------------------------ */

fmi3Status fmi3SetFloat64(fmi3Instance c, References vr, size_t n, const fmi3Float64 value[], size_t length) {
    LIVING("fmi3SetFloat64");
    GIVEN(n == 0 || (vr && value), "setFloat64");
    Plant *m = c;
    size_t i;
    if (length != n) return fail(m, "setFloat64: all variables are scalars");
    for (i = 0; i < n; i++) {
        const fmi3ValueReference v = vr[i];
        if (v < VR_DX && m->s.phase < STEPPING) m->s.x[v] = value[i];
        else if (v >= VR_U && v < VR_P) m->s.u[v - VR_U] = value[i];
        else if (v >= VR_Z && v < VR_TIME && m->s.phase <= INITIALIZING) m->s.z[v - VR_Z] = value[i];
        else if (v >= VR_P && v < VR_Y && (tunable_p[v - VR_P] || m->s.phase <= INITIALIZING)) m->s.p[v - VR_P] = value[i];
        else return fail(m, "setFloat64: variable %u cannot be set in this mode", v);
    }
    stale(m);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, References vr, size_t n, fmi3Float64 value[], size_t length) {
    LIVING("fmi3GetFloat64");
    GIVEN(n == 0 || (vr && value), "getFloat64");
    Plant *m = c;
    size_t i;
    if (length != n) return fail(m, "getFloat64: all variables are scalars");
    for (i = 0; i < n; i++) {
        const fmi3ValueReference v = vr[i];
        if (v < VR_DX) value[i] = m->s.x[v];
        else if (v < VR_U) { refresh_f(m); value[i] = m->dx[v - VR_DX]; }
        else if (v < VR_P) value[i] = m->s.u[v - VR_U];
        else if (v < VR_Y) value[i] = m->s.p[v - VR_P];
        else if (v < VR_Z) { refresh_y(m); value[i] = m->y[v - VR_Y]; }
        else if (v < VR_TIME) value[i] = m->s.z[v - VR_Z];
        else if (v == VR_TIME) value[i] = m->s.t;
        else return fail(m, "getFloat64: there is no variable %u", v);
    }
    return fmi3OK;
}

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)
static void forward(Plant *m, const double *sx, const double *su, const double *sp, double *ddx, double *dy) {
    m->arg[4] = sx; m->arg[5] = su; m->arg[6] = sp;
    call4(m, model_df, m->s.x, m->s.u, m->s.z, ddx);
    m->arg[4] = sx; m->arg[5] = su; m->arg[6] = sp;
    call4(m, model_dy, m->s.x, m->s.u, m->s.z, dy);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, References unknown, size_t n, References known, size_t k, const fmi3Float64 seed[], size_t seeds,
                                        fmi3Float64 out[], size_t outs) {
    LIVING("fmi3GetDirectionalDerivative");
    GIVEN((n == 0 || (unknown && out)) && (k == 0 || (known && seed)), "getDirectionalDerivative");
    Plant *m = c;
    double sx[DIM(NX)] = {0}, su[DIM(NU)] = {0}, sp[DIM(NP)] = {0}, dy[DIM(NY)], ddx[DIM(NX)];
    size_t i;
    if (seeds != k || outs != n) return fail(m, "getDirectionalDerivative: all variables are scalars");
    for (i = 0; i < k; i++) {
        const fmi3ValueReference v = known[i];
        if (v < VR_DX) sx[v] += seed[i];
        else if (v >= VR_U && v < VR_P) su[v - VR_U] += seed[i];
        else if (v >= VR_P && v < VR_Y) sp[v - VR_P] += seed[i];
        else if (v != VR_TIME) return fail(m, "getDirectionalDerivative: variable %u is neither state, input nor parameter", v);
    }
    forward(m, sx, su, sp, ddx, dy);
    for (i = 0; i < n; i++) {
        const fmi3ValueReference v = unknown[i];
        if (v >= VR_DX && v < VR_U) out[i] = ddx[v - VR_DX];
        else if (v >= VR_Y && v < VR_Z) out[i] = dy[v - VR_Y];
        else return fail(m, "getDirectionalDerivative: variable %u is neither derivative nor output", v);
    }
    return fmi3OK;
}

/* By columns: a plant has few knowns, and the code for the forward ones is there. */
fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, References unknown, size_t n, References known, size_t k, const fmi3Float64 seed[], size_t seeds,
                                    fmi3Float64 out[], size_t outs) {
    LIVING("fmi3GetAdjointDerivative");
    GIVEN((n == 0 || (unknown && seed)) && (k == 0 || (known && out)), "getAdjointDerivative");
    Plant *m = c;
    size_t i, j;
    if (seeds != n || outs != k) return fail(m, "getAdjointDerivative: all variables are scalars");
    for (i = 0; i < n; i++)
        if (!(unknown[i] >= VR_DX && unknown[i] < VR_U) && !(unknown[i] >= VR_Y && unknown[i] < VR_Z))
            return fail(m, "getAdjointDerivative: variable %u is neither derivative nor output", unknown[i]);
    for (j = 0; j < k; j++) {
        double sx[DIM(NX)] = {0}, su[DIM(NU)] = {0}, sp[DIM(NP)] = {0}, dy[DIM(NY)], ddx[DIM(NX)];
        const fmi3ValueReference v = known[j];
        if (v < VR_DX) sx[v] = 1;
        else if (v >= VR_U && v < VR_P) su[v - VR_U] = 1;
        else if (v >= VR_P && v < VR_Y) sp[v - VR_P] = 1;
        else if (v != VR_TIME) return fail(m, "getAdjointDerivative: variable %u is neither state, input nor parameter", v);
        forward(m, sx, su, sp, ddx, dy);
        out[j] = 0;
        for (i = 0; i < n; i++) out[j] += seed[i] * (unknown[i] < VR_U ? ddx[unknown[i] - VR_DX] : dy[unknown[i] - VR_Y]);
    }
    return fmi3OK;
}

/* ---- model exchange ------------------------------------------------------- */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *stop, fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *planned, fmi3Float64 *next) {
    EXCHANGING("fmi3UpdateDiscreteStates");
    GIVEN(again && stop && nominals && values && planned && next, "updateDiscreteStates");
    *again = *stop = *nominals = *values = *planned = fmi3False;
    *next = 0;
    return fmi3OK;
}
fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) { EXCHANGING("fmi3EvaluateDiscreteStates"); return fmi3OK; }
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_rollback, fmi3Boolean *event, fmi3Boolean *stop) {
    EXCHANGING("fmi3CompletedIntegratorStep");
    GIVEN(event && stop, "completedIntegratorStep");
    *event = *stop = fmi3False;
    return fmi3OK;
}
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { LIVING("fmi3SetTime"); ((Plant *)c)->s.t = t; return fmi3OK; }

static fmi3Status check_length(Plant *m, size_t n) { return n == NX ? fmi3OK : fail(m, "the plant has %d states, not %lu", NX, (unsigned long)n); }

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) {
    EXCHANGING("fmi3SetContinuousStates");
    Plant *m = c;
    if (check_length(m, n) != fmi3OK) return fmi3Error;
    GIVEN(n == 0 || x, "states");
    memcpy(m->s.x, x, n * sizeof *x);
    stale(m);
    return fmi3OK;
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    LIVING("fmi3GetContinuousStates");
    if (check_length(c, n) != fmi3OK) return fmi3Error;
    GIVEN(n == 0 || x, "states");
    memcpy(x, ((Plant *)c)->s.x, n * sizeof *x);
    return fmi3OK;
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) {
    LIVING("fmi3GetContinuousStateDerivatives");
    if (check_length(c, n) != fmi3OK) return fmi3Error;
    GIVEN(n == 0 || dx, "states");
    refresh_f(c);
    memcpy(dx, ((Plant *)c)->dx, n * sizeof *dx);
    return fmi3OK;
}
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    LIVING("fmi3GetNominalsOfContinuousStates");
    if (check_length(c, n) != fmi3OK) return fmi3Error;
    GIVEN(n == 0 || x, "states");
    memcpy(x, nominal_x, n * sizeof *x);
    return fmi3OK;
}
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) { LIVING("fmi3GetEventIndicators"); return n ? fail(c, "the plant has no event indicators") : fmi3OK; }
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { LIVING("fmi3GetNumberOfEventIndicators"); GIVEN(n, "getNumberOfEventIndicators"); *n = 0; return fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { LIVING("fmi3GetNumberOfContinuousStates"); GIVEN(n, "getNumberOfContinuousStates"); *n = NX; return fmi3OK; }

/* ---- co-simulation -------------------------------------------------------- */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 length, fmi3Boolean no_rollback, fmi3Boolean *events, fmi3Boolean *stop,
                      fmi3Boolean *early, fmi3Float64 *last) {
    LIVING("fmi3DoStep");
    GIVEN(events && stop && early && last, "doStep");
    Plant *m = c;
    fmi3Status status;
    (void)no_rollback;
    *events = *stop = *early = fmi3False;
    *last = m->s.t;
    if (m->s.phase != STEPPING) return fail(m, "doStep: called out of order");
    if (!(length >= 0) || length > 1e12) return fail(m, "doStep: step size %g is not usable", length);
    m->s.t = t;
    status = integrate(m, length);
    if (status == fmi3OK) *last = m->s.t = t + length;
    stale(m);
    return status;
}
