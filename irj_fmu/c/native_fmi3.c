/* FMI 3.0 co-simulation of a native estimator: the estimator of native_wrapper.c with arrays and enumerations.
 *
 * native_fmi3_config.h, written by irj_fmu.estimator.native_fmi3, says which positions of the variable table begin a variable
 * and how many they are (`elements`), and which integers are enumerations. Value references are these positions; the time
 * comes last.
 */
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2FunctionTypes.h" /* the estimator logs through FMI 2.0's callbacks */
#include "fmi3Functions.h"

#define CASADI_SYMBOL_EXPORT static
#include "native_model.c"
#include "native_config.h"
#include "native_fmi3_config.h"
#include "native_shared.c"

#include "fmi3_log.c"

typedef struct { /* an estimator and its host */
    Twin twin;
    Sink sink;
} Held;

static fmi3Status fail(Twin *m, const char *format, ...) {
    va_list values;
    va_start(values, format);
    write_log(m, fmi2Error, "logStatusError", format, values);
    va_end(values);
    return fmi3Error;
}

typedef Twin Instance;
#define TOKEN NATIVE_GUID
static void restored(Twin *m) { (void)m; }
static void discard(Twin *m) { free(m); } /* the first member of what was made */
#define COSIMULATION_ONLY
#include "fmi3_common.c"

/* ---- life cycle --------------------------------------------------------------------------------------------------- */

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    Held *h = calloc(1, sizeof *h);
    if (!h) return NULL;
    h->sink = (Sink){environment, log};
    h->twin.host.logger = relay;
    h->twin.host.componentEnvironment = &h->sink;
    h->twin.name = "estimator";
    h->twin.logging = logging;
    if (events || !token || strcmp(token, NATIVE_GUID) != 0) {
        fail(&h->twin, "instantiate: %s", events ? "there is no event mode" : "the token is not that of this library");
        free(h);
        return NULL;
    }
    restart(&h->twin.s);
    if (born(&instances, h)) return h;
    free(h);
    return NULL;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    LIVING("fmi3EnterInitializationMode");
    Twin *m = c;
    if (m->s.phase != INSTANTIATED) return fail(m, "enterInitializationMode: called out of order");
    if (has_tolerance && !(tolerance > 0)) return fail(m, "enterInitializationMode: a tolerance of %g", tolerance);
    m->s.start = start;
    m->s.phase = INITIALIZING;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    LIVING("fmi3ExitInitializationMode");
    Twin *m = c;
    if (m->s.phase != INITIALIZING) return fail(m, "exitInitializationMode: called out of order");
    m->s.phase = STEPPING;
    if (!configure(m)) m->s.whole[V_HEALTH] = INTERNAL_ERROR;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c) {
    LIVING("fmi3Terminate");
    Twin *m = c;
    if (m->s.phase != STEPPING) return fail(m, "terminate: called out of order");
    m->s.phase = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance c) {
    LIVING("fmi3Reset");
    Twin *m = c;
    restart(&m->s);
    memset(m->told, 0, sizeof m->told);
    return fmi3OK;
}

/* ---- variables ---------------------------------------------------------------------------------------------------- */

/* Elements of a variable of a kind, 0 where there is none of that kind there. */
static size_t size_of(Twin *m, fmi3ValueReference v, int wanted, int enumeration) {
    if (v < N_VARIABLES && elements[v] && kind[v] == wanted && is_enumeration[v] == enumeration) return elements[v];
    fail(m, v < N_VARIABLES ? "variable %u is of another type or inside an array" : "there is no variable %u", v);
    return 0;
}

#define VARIABLES(type, wanted, enumeration, place, converted) \
    fmi3Status fmi3Get##type(fmi3Instance c, References vr, size_t n, fmi3##type value[], size_t length) { \
        LIVING("fmi3Get" #type); \
        GIVEN(n == 0 || (vr && value), "get" #type); \
        Twin *m = c; \
        size_t i, j, k = 0; \
        for (i = 0; i < n; i++) { \
            size_t size; \
            if (wanted == REAL && vr[i] == N_VARIABLES) { \
                if (k >= length) return fail(m, "get" #type ": room for %lu values", (unsigned long)length); \
                value[k++] = (fmi3##type)now_of(m); \
                continue; \
            } \
            if (!(size = size_of(m, vr[i], wanted, enumeration))) return fmi3Error; \
            if (k + size > length) return fail(m, "get" #type ": room for %lu values", (unsigned long)length); \
            for (j = 0; j < size; j++) value[k++] = (fmi3##type)m->s.place[vr[i] + j]; \
        } \
        return k == length ? fmi3OK : fail(m, "get" #type ": %lu values, room for %lu", (unsigned long)k, (unsigned long)length); \
    } \
    fmi3Status fmi3Set##type(fmi3Instance c, References vr, size_t n, const fmi3##type value[], size_t length) { \
        LIVING("fmi3Set" #type); \
        GIVEN(n == 0 || (vr && value), "set" #type); \
        Twin *m = c; \
        size_t i, j, k = 0; \
        for (i = 0; i < n; i++) { \
            const size_t size = size_of(m, vr[i], wanted, enumeration); \
            if (!size) return fmi3Error; \
            if (k + size > length) return fail(m, "set" #type ": %lu values are too few", (unsigned long)length); \
            if (!may_set(m, vr[i])) { k += size; continue; } \
            for (j = 0; j < size; j++, k++) { \
                if (access[vr[i]] & PARAMETER && m->s.place[vr[i] + j] != (converted)) m->s.changed = 1; \
                m->s.place[vr[i] + j] = (converted); \
            } \
        } \
        return k == length ? fmi3OK : fail(m, "set" #type ": %lu values, %lu given", (unsigned long)k, (unsigned long)length); \
    }

static double now_of(const Twin *m) { return isfinite(m->s.last) ? m->s.last : m->s.start; }

VARIABLES(Float64, REAL, 0, real, value[k])
VARIABLES(Int32, INTEGER, 0, whole, value[k])
VARIABLES(Int64, INTEGER, 1, whole, (int)value[k])
VARIABLES(Boolean, BOOLEAN, 0, whole, value[k] != 0)

fmi3Status fmi3GetString(fmi3Instance c, References vr, size_t n, fmi3String value[], size_t length) {
    LIVING("fmi3GetString");
    GIVEN(n == 0 || (vr && value), "getString");
    Twin *m = c;
    size_t i;
    if (length != n) return fail(m, "getString: all texts are scalars");
    for (i = 0; i < n; i++) {
        if (!size_of(m, vr[i], STRING, 0)) return fmi3Error;
        value[i] = m->s.text[text_of[vr[i]]];
    }
    return fmi3OK;
}

fmi3Status fmi3SetString(fmi3Instance c, References vr, size_t n, const fmi3String value[], size_t length) {
    LIVING("fmi3SetString");
    GIVEN(n == 0 || (vr && value), "setString");
    Twin *m = c;
    size_t i;
    if (length != n) return fail(m, "setString: all texts are scalars");
    for (i = 0; i < n; i++) {
        if (!size_of(m, vr[i], STRING, 0)) return fmi3Error;
        if (!may_set(m, vr[i])) continue;
        if (!take_text(&m->s, vr[i], value[i])) return fail(m, "setString: variable %u takes up to %d bytes", vr[i], MAX_TEXT - 1);
    }
    return fmi3OK;
}

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(UInt32)
NO_VARIABLES(UInt64)

/* ---- co-simulation ------------------------------------------------------------------------------------------------ */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 length, fmi3Boolean no_rollback, fmi3Boolean *events, fmi3Boolean *stop,
                      fmi3Boolean *early, fmi3Float64 *last) {
    LIVING("fmi3DoStep");
    GIVEN(events && stop && early && last, "doStep");
    Twin *m = c;
    *events = *stop = *early = fmi3False;
    if (m->s.phase != STEPPING) return fail(m, "doStep: called out of order");
    sample(m, t, length);
    *last = t + length;
    return fmi3OK;
}
