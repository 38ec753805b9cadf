/* FMI 2.0 wrapper, model exchange and co-simulation, round a plant in generated C.
 *
 * plant_config.h (written by irj_fmu.plant.library) gives sizes, start values and the GUID,
 * plant_model.c (written by CasADi) the functions
 *   model_f (x, u, p, z) -> dx           model_y (x, u, p, z) -> y
 *   model_df(x, u, p, z, sx, su, sp)     model_dy(...)   directional derivatives
 *   model_z (x, z, u, p, x_prev) -> z    with memory only
 * Value references run x, dx, u, p, y, z without gaps.
 * plant_integrator.c holds the integrator of fmi2DoStep.
 */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "plant_config.h"

#define CASADI_SYMBOL_EXPORT static
#include "plant_model.c"

#define DIM(n) ((n) > 0 ? (n) : 1)
#define MAX_ORDER 3      /* highest input derivative */
#define MAX_SUBSTEPS 2000000L

enum { VR_X = 0, VR_DX = NX, VR_U = 2 * NX, VR_P = VR_U + NU, VR_Y = VR_P + NP, VR_Z = VR_Y + NY, VR_END = VR_Z + NZ };

typedef enum { INSTANTIATED = 1, INITIALIZING, EVENTS, CONTINUOUS, STEPPING, TERMINATED } Phase;

typedef struct { /* everything that changes; one copy of it is one FMU state */
    char guid[40];
    Phase phase;
    int kind, input_is_polynomial;
    double t, step, rtol;
    double x[DIM(NX)], u[DIM(NU)], p[DIM(NP)], z[DIM(NZ)];
    double du[MAX_ORDER][DIM(NU)];
} State;

typedef struct {
    State s;
    fmi2CallbackFunctions host;
    char *name;
    int logging, f_is_fresh, y_is_fresh;
    double dx[DIM(NX)], y[DIM(NY)];
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double w[DIM(SZ_W)];
    casadi_int iw[DIM(SZ_IW)];
    double k[7][DIM(NX)], x_new[DIM(NX)], x_stage[DIM(NX)], u_stage[DIM(NU)], z_stage[DIM(NZ)], z_new[DIM(NZ)];
} Plant;

static fmi2Status fail(Plant *m, const char *format, ...) {
    char text[256];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    if (m->host.logger)
        m->host.logger(m->host.componentEnvironment, m->name, fmi2Error, "logStatusError", text); /* no % in it */
    return fmi2Error;
}

static void stale(Plant *m) { m->f_is_fresh = m->y_is_fresh = 0; }

static void restart(State *s) {
    const int kind = s->kind;
    memset(s, 0, sizeof *s);
    memcpy(s->guid, PLANT_GUID, strlen(PLANT_GUID));
    s->kind = kind;
    s->phase = INSTANTIATED;
    s->rtol = DEFAULT_TOLERANCE;
    memcpy(s->x, start_x, sizeof s->x);
    memcpy(s->u, start_u, sizeof s->u);
    memcpy(s->p, start_p, sizeof s->p);
    memcpy(s->z, start_z, sizeof s->z);
}

typedef fmi2Status Status;
#define OK fmi2OK
#include "plant_integrator.c"

typedef Plant Instance;
#define GUID PLANT_GUID
static void restored(Plant *m) { stale(m); }
#include "fmi2_common.c"

/* ---- life cycle ----------------------------------------------------------- */

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    Plant *m = instance(name, functions, logging);
    (void)resources; (void)visible;
    if (!m) return NULL;
    if (!guid || strcmp(guid, PLANT_GUID) != 0 || (kind != fmi2ModelExchange && kind != fmi2CoSimulation) || (kind == fmi2ModelExchange && NZ > 0)) {
        fail(m, "instantiate: %s", kind != fmi2ModelExchange && kind != fmi2CoSimulation ? "the type is neither model exchange nor co-simulation"
                                   : kind == fmi2ModelExchange && NZ > 0 ? "this plant has memory and runs in co-simulation only"
                                                                       : "the GUID is not that of this library");
        fmi2FreeInstance(m);
        return NULL;
    }
    m->s.kind = kind;
    restart(&m->s);
    return m;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    LIVING("fmi2SetupExperiment");
    Plant *m = c;
    (void)has_stop; (void)stop;
    if (m->s.phase != INSTANTIATED) return fail(m, "setupExperiment: only before initialization");
    if (has_tolerance && !(tolerance > 0 && tolerance < 1)) return fail(m, "setupExperiment: tolerance %g is not between 0 and 1", tolerance);
    if (has_tolerance) m->s.rtol = fmax(tolerance, 1e-13);
    m->s.t = start;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    LIVING("fmi2ExitInitializationMode");
    Plant *m = c;
    if (m->s.phase != INITIALIZING) return fail(m, "exitInitializationMode: called out of order");
    m->s.phase = m->s.kind == fmi2ModelExchange ? EVENTS : STEPPING;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    LIVING("fmi2Reset");
    restart(&((Plant *)c)->s);
    stale(c);
    return fmi2OK;
}

/* ---- variables ------------------------------------------------------------ */

static double *setting(Plant *m, fmi2ValueReference vr) { /* NULL: may not be set now */
    const Phase phase = m->s.phase;
    if (vr < VR_DX) return phase == STEPPING || phase == TERMINATED ? NULL : &m->s.x[vr - VR_X];
    if (vr >= VR_U && vr < VR_P) return &m->s.u[vr - VR_U];
    if (vr >= VR_P && vr < VR_Y) return tunable_p[vr - VR_P] || phase <= INITIALIZING ? &m->s.p[vr - VR_P] : NULL;
    if (vr >= VR_Z && vr < VR_END) return phase <= INITIALIZING ? &m->s.z[vr - VR_Z] : NULL;
    return NULL;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    LIVING("fmi2SetReal");
    GIVEN(n == 0 || (vr && value), "setReal");
    Plant *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        double *place = setting(m, vr[i]);
        if (!place) return fail(m, "setReal: variable %u cannot be set in this phase", vr[i]);
        *place = value[i];
    }
    stale(m);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    LIVING("fmi2GetReal");
    GIVEN(n == 0 || (vr && value), "getReal");
    Plant *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        const fmi2ValueReference v = vr[i];
        if (v < VR_DX) value[i] = m->s.x[v];
        else if (v < VR_U) { refresh_f(m); value[i] = m->dx[v - VR_DX]; }
        else if (v < VR_P) value[i] = m->s.u[v - VR_U];
        else if (v < VR_Y) value[i] = m->s.p[v - VR_P];
        else if (v < VR_Z) { refresh_y(m); value[i] = m->y[v - VR_Y]; }
        else if (v < VR_END) value[i] = m->s.z[v - VR_Z];
        else return fail(m, "getReal: there is no variable %u", v);
    }
    return fmi2OK;
}

#define NO_VARIABLES(function, type) \
    fmi2Status function(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[]) { \
        LIVING(#function); \
        (void)vr; (void)value; \
        return n ? fail(c, #function ": all variables are Real") : fmi2OK; \
    }
NO_VARIABLES(fmi2GetInteger, fmi2Integer)
NO_VARIABLES(fmi2GetBoolean, fmi2Boolean)
NO_VARIABLES(fmi2GetString, fmi2String)
NO_VARIABLES(fmi2SetInteger, const fmi2Integer)
NO_VARIABLES(fmi2SetBoolean, const fmi2Boolean)
NO_VARIABLES(fmi2SetString, const fmi2String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known, const fmi2Real seed[], fmi2Real out[]) {
    LIVING("fmi2GetDirectionalDerivative");
    GIVEN((n_unknown == 0 || (unknown && out)) && (n_known == 0 || (known && seed)), "getDirectionalDerivative");
    Plant *m = c;
    double sx[DIM(NX)] = {0}, su[DIM(NU)] = {0}, sp[DIM(NP)] = {0}, dy[DIM(NY)] = {0}, ddx[DIM(NX)] = {0};
    int need_f = 0, need_y = 0;
    size_t i;
    for (i = 0; i < n_known; i++) {
        const fmi2ValueReference v = known[i];
        if (v < VR_DX) sx[v] += seed[i];
        else if (v >= VR_U && v < VR_P) su[v - VR_U] += seed[i];
        else if (v >= VR_P && v < VR_Y) sp[v - VR_P] += seed[i];
        else return fail(m, "getDirectionalDerivative: variable %u is neither state, input nor parameter", v);
    }
    for (i = 0; i < n_unknown; i++) {
        need_f |= unknown[i] >= VR_DX && unknown[i] < VR_U;
        need_y |= unknown[i] >= VR_Y && unknown[i] < VR_Z;
    }
    m->arg[4] = sx; m->arg[5] = su; m->arg[6] = sp;
    if (need_f) call4(m, model_df, m->s.x, m->s.u, m->s.z, ddx);
    m->arg[4] = sx; m->arg[5] = su; m->arg[6] = sp;
    if (need_y) call4(m, model_dy, m->s.x, m->s.u, m->s.z, dy);
    for (i = 0; i < n_unknown; i++) {
        const fmi2ValueReference v = unknown[i];
        if (v >= VR_DX && v < VR_U) out[i] = ddx[v - VR_DX];
        else if (v >= VR_Y && v < VR_Z) out[i] = dy[v - VR_Y];
        else return fail(m, "getDirectionalDerivative: variable %u is neither derivative nor output", v);
    }
    return fmi2OK;
}

/* ---- co-simulation --------------------------------------------------------- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real length, fmi2Boolean no_rollback) {
    LIVING("fmi2DoStep");
    Plant *m = c;
    State *s = &m->s;
    fmi2Status status;
    (void)no_rollback;
    if (s->phase != STEPPING) return fail(m, "doStep: called out of order");
    if (!(length >= 0) || length > 1e12) return fail(m, "doStep: step size %g is not usable", length);
    s->t = t;
    status = integrate(m, length);
    if (status == fmi2OK) {
        if (s->input_is_polynomial) {
            memcpy(s->u, input_at(m, length), sizeof s->u);
            memset(s->du, 0, sizeof s->du);
            s->input_is_polynomial = 0;
        }
        s->t = t + length;
    }
    stale(m);
    return status;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]) {
    LIVING("fmi2SetRealInputDerivatives");
    GIVEN(n == 0 || (vr && order && value), "setRealInputDerivatives");
    Plant *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (vr[i] < VR_U || vr[i] >= VR_P) return fail(m, "setRealInputDerivatives: variable %u is not an input", vr[i]);
        if (order[i] < 1 || order[i] > MAX_ORDER) return fail(m, "setRealInputDerivatives: order %d is not between 1 and %d", order[i], MAX_ORDER);
        m->s.du[order[i] - 1][vr[i] - VR_U] = value[i];
        m->s.input_is_polynomial = 1;
    }
    return fmi2OK;
}


fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    LIVING("fmi2GetRealStatus");
    if (kind != fmi2LastSuccessfulTime) return fail(c, "getRealStatus: only the last successful time is known");
    GIVEN(value, "getRealStatus");
    *value = ((Plant *)c)->s.t;
    return fmi2OK;
}

/* ---- model exchange --------------------------------------------------------- */

/* between initialization and termination, of an instance that was made for it */
#define EXCHANGING(call) do { \
    LIVING(call); \
    if (((Plant *)c)->s.phase != EVENTS && ((Plant *)c)->s.phase != CONTINUOUS) return fail(c, "%s: called out of order", call); \
} while (0)
#define FOR_EXCHANGE(call) do { \
    LIVING(call); \
    if (((Plant *)c)->s.kind != fmi2ModelExchange) return fail(c, "%s: this instance is for co-simulation", call); \
} while (0)

fmi2Status fmi2EnterEventMode(fmi2Component c) { EXCHANGING("fmi2EnterEventMode"); ((Plant *)c)->s.phase = EVENTS; return fmi2OK; }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { EXCHANGING("fmi2EnterContinuousTimeMode"); ((Plant *)c)->s.phase = CONTINUOUS; return fmi2OK; }

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    EXCHANGING("fmi2NewDiscreteStates");
    GIVEN(info, "newDiscreteStates");
    info->newDiscreteStatesNeeded = fmi2False;
    info->terminateSimulation = fmi2False;
    info->nominalsOfContinuousStatesChanged = fmi2False;
    info->valuesOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = fmi2False;
    info->nextEventTime = 0;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_rollback, fmi2Boolean *enter_event_mode, fmi2Boolean *terminate) {
    EXCHANGING("fmi2CompletedIntegratorStep");
    (void)no_rollback;
    GIVEN(enter_event_mode && terminate, "completedIntegratorStep");
    *enter_event_mode = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) { FOR_EXCHANGE("fmi2SetTime"); ((Plant *)c)->s.t = t; return fmi2OK; }

static fmi2Status check_length(Plant *m, size_t n) {
    return n == NX ? fmi2OK : fail(m, "the plant has %d states, not %lu", NX, (unsigned long)n);
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    EXCHANGING("fmi2SetContinuousStates");
    Plant *m = c;
    if (check_length(m, n) != fmi2OK) return fmi2Error;
    GIVEN(n == 0 || x, "states");
    memcpy(m->s.x, x, n * sizeof *x);
    stale(m);
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    FOR_EXCHANGE("fmi2GetContinuousStates");
    Plant *m = c;
    if (check_length(m, n) != fmi2OK) return fmi2Error;
    GIVEN(n == 0 || x, "states");
    memcpy(x, m->s.x, n * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    FOR_EXCHANGE("fmi2GetDerivatives");
    Plant *m = c;
    if (check_length(m, n) != fmi2OK) return fmi2Error;
    GIVEN(n == 0 || dx, "states");
    refresh_f(m);
    memcpy(dx, m->dx, n * sizeof *dx);
    return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    FOR_EXCHANGE("fmi2GetNominalsOfContinuousStates");
    if (check_length(c, n) != fmi2OK) return fmi2Error;
    GIVEN(n == 0 || x, "states");
    memcpy(x, nominal_x, n * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t n) {
    FOR_EXCHANGE("fmi2GetEventIndicators");
    (void)indicators;
    return n ? fail(c, "the plant has no event indicators") : fmi2OK;
}
