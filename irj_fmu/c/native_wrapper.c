/* FMI 2.0 co-simulation of a native estimator: no Python in the host, no memory allocated in a step.
 *
 * native_config.h and native_model.c are written by irj_fmu.estimator.native_tables: sizes, tables, and CasADi's code of
 *   rls_step, rls_check   identification.recursive.ud_codegen     points, slopes   identification.online.rows
 *   sample_observer       identification.faults.core
 * Value references are the positions in the variable table of irj_fmu.estimator.slave, so that a host can exchange the two.
 */
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

#define CASADI_SYMBOL_EXPORT static
#include "native_model.c"
#include "native_config.h"
#include "native_shared.c"

static fmi2Status fail(Twin *m, const char *format, ...) {
    va_list values;
    va_start(values, format);
    write_log(m, fmi2Error, "logStatusError", format, values);
    va_end(values);
    return fmi2Error;
}

typedef Twin Instance;
#define GUID NATIVE_GUID
static void restored(Twin *m) { (void)m; }
#include "fmi2_common.c"

/* ---- life cycle --------------------------------------------------------------------------------------------------- */

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    Twin *m = instance(name, functions, logging);
    (void)resources; (void)visible;
    if (!m) return NULL;
    if (type != fmi2CoSimulation || !guid || strcmp(guid, NATIVE_GUID) != 0) {
        fail(m, "instantiate: %s", type != fmi2CoSimulation ? "co-simulation only" : "the GUID is not that of this library");
        fmi2FreeInstance(m);
        return NULL;
    }
    restart(&m->s);
    return m;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    LIVING("fmi2SetupExperiment");
    Twin *m = c;
    (void)has_tolerance; (void)tolerance; (void)has_stop; (void)stop;
    if (m->s.phase != INSTANTIATED) return fail(m, "setupExperiment: only before initialization");
    m->s.start = start;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    LIVING("fmi2ExitInitializationMode");
    Twin *m = c;
    if (m->s.phase != INITIALIZING) return fail(m, "exitInitializationMode: called out of order");
    m->s.phase = STEPPING;
    if (!configure(m)) m->s.whole[V_HEALTH] = INTERNAL_ERROR;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    LIVING("fmi2Reset");
    Twin *m = c;
    restart(&m->s);
    memset(m->told, 0, sizeof m->told);
    return fmi2OK;
}

/* ---- variables ---------------------------------------------------------------------------------------------------- */

static int is_kind(Twin *m, fmi2ValueReference v, int wanted) {
    if (v < N_VARIABLES && kind[v] == wanted) return 1;
    fail(m, v < N_VARIABLES ? "variable %u is of another type" : "there is no variable %u", v);
    return 0;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    LIVING("fmi2GetReal");
    GIVEN(n == 0 || (vr && value), "getReal");
    Twin *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (!is_kind(m, vr[i], REAL)) return fmi2Error;
        value[i] = m->s.real[vr[i]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    LIVING("fmi2SetReal");
    GIVEN(n == 0 || (vr && value), "setReal");
    Twin *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (!is_kind(m, vr[i], REAL)) return fmi2Error;
        if (!may_set(m, vr[i])) continue;
        if (access[vr[i]] & PARAMETER && m->s.real[vr[i]] != value[i]) m->s.changed = 1;
        m->s.real[vr[i]] = value[i];
    }
    return fmi2OK;
}

#define WHOLE(type, wanted) \
    fmi2Status fmi2Get##type(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##type value[]) { \
        LIVING("fmi2Get" #type); \
        GIVEN(n == 0 || (vr && value), "get" #type); \
        Twin *m = c; \
        size_t i; \
        for (i = 0; i < n; i++) { \
            if (!is_kind(m, vr[i], wanted)) return fmi2Error; \
            value[i] = m->s.whole[vr[i]]; \
        } \
        return fmi2OK; \
    } \
    fmi2Status fmi2Set##type(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##type value[]) { \
        LIVING("fmi2Set" #type); \
        GIVEN(n == 0 || (vr && value), "set" #type); \
        Twin *m = c; \
        size_t i; \
        for (i = 0; i < n; i++) { \
            const int new_value = wanted == BOOLEAN ? value[i] != 0 : value[i]; \
            if (!is_kind(m, vr[i], wanted)) return fmi2Error; \
            if (!may_set(m, vr[i])) continue; \
            if (access[vr[i]] & PARAMETER && m->s.whole[vr[i]] != new_value) m->s.changed = 1; \
            m->s.whole[vr[i]] = new_value; \
        } \
        return fmi2OK; \
    }
WHOLE(Integer, INTEGER)
WHOLE(Boolean, BOOLEAN)

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]) {
    LIVING("fmi2GetString");
    GIVEN(n == 0 || (vr && value), "getString");
    Twin *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (!is_kind(m, vr[i], STRING)) return fmi2Error;
        value[i] = m->s.text[text_of[vr[i]]];
    }
    return fmi2OK;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]) {
    LIVING("fmi2SetString");
    GIVEN(n == 0 || (vr && value), "setString");
    Twin *m = c;
    size_t i;
    for (i = 0; i < n; i++) {
        if (!is_kind(m, vr[i], STRING)) return fmi2Error;
        if (!may_set(m, vr[i])) continue;
        if (!take_text(&m->s, vr[i], value[i])) return fail(m, "setString: variable %u takes up to %d bytes", vr[i], MAX_TEXT - 1);
    }
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known, const fmi2Real seed[], fmi2Real out[]) {
    LIVING("fmi2GetDirectionalDerivative");
    (void)unknown; (void)n_unknown; (void)known; (void)n_known; (void)seed; (void)out;
    return fail(c, "getDirectionalDerivative: not provided");
}

/* ---- co-simulation ------------------------------------------------------------------------------------------------ */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real length, fmi2Boolean no_rollback) {
    LIVING("fmi2DoStep");
    Twin *m = c;
    (void)no_rollback;
    if (m->s.phase != STEPPING) return fail(m, "doStep: called out of order");
    sample(m, t, length);
    return fmi2OK;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]) {
    LIVING("fmi2SetRealInputDerivatives");
    (void)vr; (void)order; (void)value;
    return n ? fail(c, "setRealInputDerivatives: not provided") : fmi2OK;
}

NO_STATUS(fmi2GetRealStatus, fmi2Real)

