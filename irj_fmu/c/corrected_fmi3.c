/* FMI 3.0 co-simulation library round another FMU, whose drive it corrects by a law in generated C; see corrected_wrapper.c.
 *
 * corrected_config.h has beside what is said there length_real, the number of values of each Float64 variable, and known_ and start_
 * tables of all other types.
 */
#include "fmi3Functions.h"
#include "corrected_config.h"
#include "corrected_state.h"

typedef struct {
    State s;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    int loaded, dead, ended; /* dead: after fmi3Fatal nothing may be called any more; ended: the inner FMU asks for an end */
    unsigned long serial;
    fmi3Instance inner;
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double w[DIM(SZ_W)];
    casadi_int iw[DIM(SZ_IW)];
} Corrected;

static fmi3Status fail(Corrected *m, const char *format, ...) {
    char text[1024];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    if (m->log) m->log(m->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

typedef Corrected Instance;
#define PASSES_ON
#define TOKEN CORRECTED_GUID
#define COSIMULATION_ONLY
#include "fmi3_common.c"

/* ---- the inner FMU -------------------------------------------------------- */

#define FMI(name) fmi3##name
#define VERSION "fmi3"
#define NEEDED(X) \
    X(InstantiateCoSimulation) X(FreeInstance) X(EnterInitializationMode) X(ExitInitializationMode) \
    X(Terminate) X(Reset) X(GetFloat64) X(SetFloat64) X(DoStep)
#define USEFUL(X) \
    X(SetDebugLogging) X(GetFloat32) X(GetInt8) X(GetUInt8) X(GetInt16) X(GetUInt16) X(GetInt32) X(GetUInt32) X(GetInt64) \
    X(GetUInt64) X(GetBoolean) X(GetString) X(GetBinary) X(SetFloat32) X(SetInt8) X(SetUInt8) X(SetInt16) X(SetUInt16) \
    X(SetInt32) X(SetUInt32) X(SetInt64) X(SetUInt64) X(SetBoolean) X(SetString) X(SetBinary) \
    X(GetFMUState) X(SetFMUState) X(FreeFMUState) X(SerializedFMUStateSize) X(SerializeFMUState) X(DeserializeFMUState)
#define PASS_GET(m, vr, n, values, length) inner_GetFloat64((m)->inner, vr, n, values, length)
#define PASS_SET(m, vr, n, values, length) inner_SetFloat64((m)->inner, vr, n, values, length)
#define ENDED(m) (m)->ended
#define inner_GetFMUstate inner_GetFMUState
#define inner_SetFMUstate inner_SetFMUState
#define inner_FreeFMUstate inner_FreeFMUState
#define inner_SerializedFMUstateSize inner_SerializedFMUStateSize
#define inner_SerializeFMUstate inner_SerializeFMUState
#define inner_DeSerializeFMUstate inner_DeserializeFMUState
typedef fmi3Byte Byte;
#include "corrected_inner.c"

/* a path that ends with a separator */
static void note_place(const char *folder) { sprintf(place, "%s/resources/", folder); }

/* alive, and the inner FMU may be called */
#define USABLE(call) \
    LIVING("fmi3" call); \
    Corrected *m = c; \
    if (m->dead) return fail(m, call ": the inner FMU has met a fatal error; free the instance")

static fmi3Status set_starts(Corrected *m) {
    fmi3Status status = fmi3OK;
    start_anew(&m->s);
    m->ended = 0;
#define STARTS(kind, KIND, name) \
    if (status <= fmi3Warning && N_START_##KIND) \
        status = inner_Set##name ? answered(m, inner_Set##name(m->inner, start_##kind, N_START_##KIND, start_##kind##_to, N_START_##KIND), "start values") \
                                 : fail(m, "the inner FMU lacks fmi3Set" #name);
    STARTS(real, REAL, Float64)
    STARTS(float32, FLOAT32, Float32)
    STARTS(int8, INT8, Int8)
    STARTS(uint8, UINT8, UInt8)
    STARTS(int16, INT16, Int16)
    STARTS(uint16, UINT16, UInt16)
    STARTS(int32, INT32, Int32)
    STARTS(uint32, UINT32, UInt32)
    STARTS(int64, INT64, Int64)
    STARTS(uint64, UINT64, UInt64)
    STARTS(boolean, BOOLEAN, Boolean)
    return status;
}

/* ---- life cycle ----------------------------------------------------------- */

static void silent(fmi3InstanceEnvironment e, fmi3Status status, fmi3String category, fmi3String message) {
    (void)e; (void)status; (void)category; (void)message;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    static unsigned long made;
    Corrected *m = calloc(1, sizeof *m);
    (void)resources; /* where this library lies is surer */
    (void)early; (void)required; (void)n; (void)update; /* it never returns early, and has nothing to update in between */
    if (!m) return NULL;
    if (!born(&instances, m)) {
        free(m);
        return NULL;
    }
    m->environment = environment;
    m->log = log ? log : silent;
    m->serial = __atomic_add_fetch(&made, 1, __ATOMIC_RELAXED);
    if (events) fail(m, "instantiate: this FMU has no event mode in co-simulation");
    else if (!token || strcmp(token, TOKEN) != 0) fail(m, "instantiate: the token is not that of this library");
    else if (!(m->loaded = enter())) fail(m, "instantiate: the inner FMU cannot be loaded from resources/inner: %s", problem);
    else if (!(m->inner = inner_InstantiateCoSimulation(name ? name : "inner", INNER_GUID, place, visible, logging, fmi3False, fmi3False, NULL, 0,
                                                        environment, m->log, NULL)))
        fail(m, "instantiate: the inner FMU refuses to be instantiated");
    else if (set_starts(m) <= fmi3Warning) return m;
    fmi3FreeInstance(m);
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c) {
    Corrected *m = c;
    if (!c) return;
    if (!dies(&instances, c)) {
        tell_stranger("fmi3FreeInstance");
        return;
    }
    if (m->inner && !m->dead) inner_FreeInstance(m->inner);
    if (m->loaded) leave();
    free(m);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    USABLE("SetDebugLogging");
    return inner_SetDebugLogging ? answered(m, inner_SetDebugLogging(m->inner, on, n, categories), "setDebugLogging") : fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    fmi3Status status;
    USABLE("EnterInitializationMode");
    if (m->s.phase != INSTANTIATED) return fail(m, "enterInitializationMode: called out of order");
    m->s.t = start;
    status = answered(m, inner_EnterInitializationMode(m->inner, has_tolerance, tolerance, start, has_stop, stop), "enterInitializationMode");
    if (status <= fmi3Warning) m->s.phase = INITIALIZING;
    return status;
}

#define CHANGE(function, call, allowed, next) \
    fmi3Status fmi3##function(fmi3Instance c) { \
        fmi3Status status; \
        USABLE(#function); \
        if (!(allowed)) return fail(m, call ": called out of order"); \
        status = answered(m, inner_##function(m->inner), call); \
        if (status <= fmi3Warning) m->s.phase = next; \
        return status; \
    }
CHANGE(ExitInitializationMode, "exitInitializationMode", m->s.phase == INITIALIZING, STEPPING)
CHANGE(Terminate, "terminate", m->s.phase == STEPPING, TERMINATED)

fmi3Status fmi3Reset(fmi3Instance c) {
    fmi3Status status, later;
    USABLE("Reset");
    status = answered(m, inner_Reset(m->inner), "reset");
    if (status > fmi3Warning) return status;
    later = set_starts(m);
    return later > status ? later : status;
}

/* ---- variables ------------------------------------------------------------ */

/* Values of a variable: an array has more than one. */
static size_t length_of(fmi3ValueReference vr) {
    const size_t at = place_of(known_real, N_KNOWN_REAL, vr);
    return at < N_KNOWN_REAL ? length_real[at] : 1;
}

/* All variables together have as many values as the host gives. */
#define FITTING(call) do { \
    size_t sum = 0; \
    for (i = 0; i < n; i++) sum += length_of(vr[i]); \
    if (sum != length) return fail(m, call ": these variables have %lu values, not %lu", (unsigned long)sum, (unsigned long)length); \
} while (0)

fmi3Status fmi3SetFloat64(fmi3Instance c, References vr, size_t n, const fmi3Float64 value[], size_t length) {
    fmi3Status status = fmi3OK, one;
    size_t i;
    USABLE("SetFloat64");
    GIVEN(n == 0 || (vr && value), "setFloat64");
    FITTING("setFloat64");
    if (count_passed_on(vr, n) == n) return n ? answered(m, inner_SetFloat64(m->inner, vr, n, value, length), "setFloat64") : fmi3OK;
    for (i = 0; i < n; i++) {
        const size_t own = length_of(vr[i]);
        one = is_passed_on(vr[i]) ? answered(m, inner_SetFloat64(m->inner, vr + i, 1, value, own), "setFloat64") : set_own(m, vr[i], *value, "setFloat64");
        if (one > fmi3Warning) return one;
        if (one > status) status = one;
        value += own;
    }
    return status;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, References vr, size_t n, fmi3Float64 value[], size_t length) {
    fmi3Status status = fmi3OK, one;
    size_t i;
    USABLE("GetFloat64");
    GIVEN(n == 0 || (vr && value), "getFloat64");
    FITTING("getFloat64");
    if (count_passed_on(vr, n) == n) return n ? answered(m, inner_GetFloat64(m->inner, vr, n, value, length), "getFloat64") : fmi3OK;
    for (i = 0; i < n; i++) {
        const size_t own = length_of(vr[i]);
        one = is_passed_on(vr[i]) ? answered(m, inner_GetFloat64(m->inner, vr + i, 1, value, own), "getFloat64") : get_own(m, vr[i], value, "getFloat64");
        if (one > fmi3Warning) return one;
        if (one > status) status = one;
        value += own;
    }
    return status;
}

#define WHOLE(function, type, kind, KIND, given) \
    fmi3Status fmi3##function(fmi3Instance c, References vr, size_t n, type value[], size_t length) { \
        size_t i; \
        USABLE(#function); \
        GIVEN(n == 0 || (vr && value), #function); \
        for (i = 0; i < n; i++) \
            if (!is_known(known_##kind, N_KNOWN_##KIND, vr[i])) return fail(m, #function ": there is no variable %u of this type", vr[i]); \
        for (i = 0; i < (n ? length : 0); i++) \
            if (!(given)) return fail(m, #function ": a pointer is NULL"); \
        HAS(function, #function); \
        return n ? answered(m, inner_##function(m->inner, vr, n, value, length), #function) : fmi3OK; \
    }
#define NUMBERS(name, kind, KIND) \
    WHOLE(Get##name, fmi3##name, kind, KIND, 1) \
    WHOLE(Set##name, const fmi3##name, kind, KIND, 1)
NUMBERS(Float32, float32, FLOAT32)
NUMBERS(Int8, int8, INT8)
NUMBERS(UInt8, uint8, UINT8)
NUMBERS(Int16, int16, INT16)
NUMBERS(UInt16, uint16, UINT16)
NUMBERS(Int32, int32, INT32)
NUMBERS(UInt32, uint32, UINT32)
NUMBERS(Int64, int64, INT64)
NUMBERS(UInt64, uint64, UINT64)
NUMBERS(Boolean, boolean, BOOLEAN)
WHOLE(GetString, fmi3String, string, STRING, 1)
WHOLE(SetString, const fmi3String, string, STRING, value[i] != NULL)

#define BINARY(function, sizes_type, type) \
    fmi3Status fmi3##function(fmi3Instance c, References vr, size_t n, sizes_type sizes[], type value[], size_t length) { \
        size_t i; \
        USABLE(#function); \
        GIVEN(n == 0 || (vr && sizes && value), #function); \
        for (i = 0; i < n; i++) \
            if (!is_known(known_binary, N_KNOWN_BINARY, vr[i])) return fail(m, #function ": there is no variable %u of this type", vr[i]); \
        HAS(function, #function); \
        return n ? answered(m, inner_##function(m->inner, vr, n, sizes, value, length), #function) : fmi3OK; \
    }
BINARY(GetBinary, size_t, fmi3Binary)
BINARY(SetBinary, const size_t, const fmi3Binary)

/* ---- FMU state ------------------------------------------------------------ */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) { USABLE("GetFMUState"); return get_state(m, state); }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) { USABLE("SetFMUState"); m->ended = 0; return set_state(m, state); }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) { USABLE("FreeFMUState"); return free_state(m, state); }
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) { USABLE("SerializedFMUStateSize"); return size_of_state(m, state, size); }
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) { USABLE("SerializeFMUState"); return bytes_of_state(m, state, bytes, size); }
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) { USABLE("DeserializeFMUState"); return state_of_bytes(m, bytes, size, state); }

/* ---- co-simulation -------------------------------------------------------- */

static fmi3Status pass_step(Corrected *m, double at, double length, int no_rollback) {
    fmi3Boolean events = fmi3False, stop = fmi3False, early = fmi3False;
    fmi3Float64 last = at + length;
    const fmi3Status status = inner_DoStep(m->inner, at, length, no_rollback != 0, &events, &stop, &early, &last);
    if (status > fmi3Warning) return status;
    if (early) return fail(m, "doStep: the inner FMU returns early at t = %g s, which it was not allowed to", last);
    m->ended = stop;
    return status;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 length, fmi3Boolean no_rollback, fmi3Boolean *events, fmi3Boolean *stop,
                      fmi3Boolean *early, fmi3Float64 *last) {
    fmi3Status status;
    USABLE("DoStep");
    GIVEN(events && stop && early && last, "doStep");
    *events = *stop = *early = fmi3False;
    status = advance(m, t, length, no_rollback);
    *stop = m->ended != 0;
    *last = m->s.t;
    return status;
}
