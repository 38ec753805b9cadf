/* FMI 2.0 co-simulation library round another FMU, whose drive it corrects by a law in generated C.
 *
 * The other FMU lies unpacked in resources/inner, found from where this library lies. Every call is passed on; the
 * correction is read from position and velocity of the inner FMU and held until it is read again.
 *
 * corrected_config.h (written by irj_fmu.corrected.build) gives
 *   CORRECTED_GUID, INNER_GUID, INNER_LIBRARY (below resources/inner), INNER_STATES and INNER_BYTES (what it can do with its state);
 *   NS, NP, NF: lengths of the law's state, of its parameters, and of those that can be set (free_p, their places);
 *   VR_LAW: value reference of the first of these; then come the time between two readings and what is added;
 *   VR_DRIVE, VR_READ (position, velocity), PER_DRIVE, PER_POSITION, PER_RATE: link-referred value per unit of the FMU;
 *   start_p, DRIVE_START, HOLD; start_real, start_integer, start_boolean: fitted values for the inner FMU;
 *   known_real, known_integer, known_boolean, known_string: its value references, ascending.
 * corrected_law.c (written by CasADi): law(state, reading, parameters) -> (torque, state).
 */
#include "fmi2Functions.h"
#include "corrected_config.h"

#include "corrected_state.h"

typedef struct {
    State s;
    fmi2CallbackFunctions host;
    char *name;
    int logging, loaded, dead; /* dead: after fmi2Fatal nothing may be called any more */
    unsigned long serial;
    fmi2Component inner;
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double w[DIM(SZ_W)];
    casadi_int iw[DIM(SZ_IW)];
} Corrected;

static fmi2Status fail(Corrected *m, const char *format, ...) {
    char text[1024], safe[2 * sizeof text], *to = safe;
    const char *from;
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    for (from = text; *from; *to++ = *from++) /* a host may take the message for a format */
        if (*from == '%') *to++ = '%';
    *to = 0;
    m->host.logger(m->host.componentEnvironment, m->name, fmi2Error, "logStatusError", safe);
    return fmi2Error;
}

typedef Corrected Instance;
#define PASSES_ON
#define GUID CORRECTED_GUID
#include "fmi2_common.c"

/* ---- the inner FMU -------------------------------------------------------- */

#define FMI(name) fmi2##name
#define VERSION "fmi2"
#define NEEDED(X) \
    X(Instantiate) X(FreeInstance) X(SetupExperiment) X(EnterInitializationMode) X(ExitInitializationMode) \
    X(Terminate) X(Reset) X(GetReal) X(SetReal) X(DoStep)
#define USEFUL(X) \
    X(SetDebugLogging) X(GetInteger) X(GetBoolean) X(GetString) X(SetInteger) X(SetBoolean) X(SetString) \
    X(GetFMUstate) X(SetFMUstate) X(FreeFMUstate) X(SerializedFMUstateSize) X(SerializeFMUstate) X(DeSerializeFMUstate)
#define PASS_GET(m, vr, n, values, length) inner_GetReal((m)->inner, vr, n, values)
#define PASS_SET(m, vr, n, values, length) inner_SetReal((m)->inner, vr, n, values)
#define ENDED(m) 0
typedef fmi2Byte Byte;
#include "corrected_inner.c"

/* percent-encoded: some FMUs follow nothing else */
static void note_place(const char *folder) {
    static const char plain[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-._~/:";
    char *to = place + sprintf(place, *folder == '/' ? "file://" : "file:///");
    for (; *folder; folder++)
        if (strchr(plain, *folder)) *to++ = *folder;
        else to += sprintf(to, "%%%02X", (unsigned char)*folder);
    strcpy(to, "/resources");
}

/* alive, and the inner FMU may be called */
#define USABLE(call) \
    LIVING("fmi2" call); \
    Corrected *m = c; \
    if (m->dead) return fail(m, call ": the inner FMU has met a fatal error; free the instance")

static fmi2Status set_starts(Corrected *m) {
    fmi2Status status = fmi2OK;
    start_anew(&m->s);
    if (N_START_REAL) status = answered(m, inner_SetReal(m->inner, start_real, N_START_REAL, start_real_to), "fitted values");
    if (status <= fmi2Warning && N_START_INTEGER)
        status = inner_SetInteger ? answered(m, inner_SetInteger(m->inner, start_integer, N_START_INTEGER, start_integer_to), "start values") : fail(m, "the inner FMU lacks fmi2SetInteger");
    if (status <= fmi2Warning && N_START_BOOLEAN)
        status = inner_SetBoolean ? answered(m, inner_SetBoolean(m->inner, start_boolean, N_START_BOOLEAN, start_boolean_to), "start values") : fail(m, "the inner FMU lacks fmi2SetBoolean");
    return status;
}

/* ---- life cycle ----------------------------------------------------------- */

static void silent(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    (void)e; (void)name; (void)status; (void)category; (void)message;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    static unsigned long made;
    Corrected *m = instance(name, functions, logging);
    (void)resources; /* where this library lies is surer */
    if (!m) return NULL;
    if (!m->host.logger) m->host.logger = silent;
    if (!m->host.allocateMemory) m->host.allocateMemory = calloc;
    if (!m->host.freeMemory) m->host.freeMemory = free;
    m->serial = __atomic_add_fetch(&made, 1, __ATOMIC_RELAXED);
    if (kind != fmi2CoSimulation) fail(m, "instantiate: this FMU is for co-simulation only");
    else if (!guid || strcmp(guid, GUID) != 0) fail(m, "instantiate: the GUID is not that of this library");
    else if (!(m->loaded = enter())) fail(m, "instantiate: the inner FMU cannot be loaded from resources/inner: %s", problem);
    else if (!(m->inner = inner_Instantiate(m->name, kind, INNER_GUID, place, &m->host, visible, logging))) fail(m, "instantiate: the inner FMU refuses to be instantiated");
    else if (set_starts(m) <= fmi2Warning) return m;
    fmi2FreeInstance(m);
    return NULL;
}

void fmi2FreeInstance(fmi2Component c) {
    Corrected *m = c;
    if (!c) return;
    if (!dies(&instances, c)) {
        tell_stranger("fmi2FreeInstance");
        return;
    }
    if (m->inner && !m->dead) inner_FreeInstance(m->inner);
    if (m->loaded) leave();
    discard(m);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    USABLE("SetDebugLogging");
    m->logging = on;
    return inner_SetDebugLogging ? answered(m, inner_SetDebugLogging(m->inner, on, n, categories), "setDebugLogging") : fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    USABLE("SetupExperiment");
    if (m->s.phase != INSTANTIATED) return fail(m, "setupExperiment: only before initialization");
    m->s.t = start;
    return answered(m, inner_SetupExperiment(m->inner, has_tolerance, tolerance, start, has_stop, stop), "setupExperiment");
}

#define CHANGE(function, call, allowed, next) \
    fmi2Status fmi2##function(fmi2Component c) { \
        fmi2Status status; \
        USABLE(#function); \
        if (!(allowed)) return fail(m, call ": called out of order"); \
        status = answered(m, inner_##function(m->inner), call); \
        if (status <= fmi2Warning) m->s.phase = next; \
        return status; \
    }
CHANGE(EnterInitializationMode, "enterInitializationMode", m->s.phase == INSTANTIATED, INITIALIZING)
CHANGE(ExitInitializationMode, "exitInitializationMode", m->s.phase == INITIALIZING, STEPPING)
CHANGE(Terminate, "terminate", m->s.phase == STEPPING, TERMINATED)

fmi2Status fmi2Reset(fmi2Component c) {
    fmi2Status status, later;
    USABLE("Reset");
    status = answered(m, inner_Reset(m->inner), "reset");
    if (status > fmi2Warning) return status;
    later = set_starts(m);
    return later > status ? later : status;
}

/* ---- variables ------------------------------------------------------------ */

static fmi2Status set_one(Corrected *m, fmi2ValueReference vr, double value) {
    return is_passed_on(vr) ? answered(m, inner_SetReal(m->inner, &vr, 1, &value), "setReal") : set_own(m, vr, value, "setReal");
}

static fmi2Status get_one(Corrected *m, fmi2ValueReference vr, double *value) {
    return is_passed_on(vr) ? answered(m, inner_GetReal(m->inner, &vr, 1, value), "getReal") : get_own(m, vr, value, "getReal");
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    fmi2Status status = fmi2OK, one;
    size_t i;
    USABLE("SetReal");
    GIVEN(n == 0 || (vr && value), "setReal");
    if (count_passed_on(vr, n) == n) return n ? answered(m, inner_SetReal(m->inner, vr, n, value), "setReal") : fmi2OK;
    for (i = 0; i < n; i++) {
        if ((one = set_one(m, vr[i], value[i])) > fmi2Warning) return one;
        if (one > status) status = one;
    }
    return status;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    fmi2Status status = fmi2OK, one;
    size_t i;
    USABLE("GetReal");
    GIVEN(n == 0 || (vr && value), "getReal");
    if (count_passed_on(vr, n) == n) return n ? answered(m, inner_GetReal(m->inner, vr, n, value), "getReal") : fmi2OK;
    for (i = 0; i < n; i++) {
        if ((one = get_one(m, vr[i], &value[i])) > fmi2Warning) return one;
        if (one > status) status = one;
    }
    return status;
}

#define WHOLE(function, type, table, length, given) \
    fmi2Status fmi2##function(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[]) { \
        size_t i; \
        USABLE(#function); \
        GIVEN(n == 0 || (vr && value), #function); \
        for (i = 0; i < n; i++) { \
            if (!is_known(table, length, vr[i])) return fail(m, #function ": there is no variable %u of this type", vr[i]); \
            if (!(given)) return fail(m, #function ": a pointer is NULL"); \
        } \
        HAS(function, #function); \
        return n ? answered(m, inner_##function(m->inner, vr, n, value), #function) : fmi2OK; \
    }
WHOLE(GetInteger, fmi2Integer, known_integer, N_KNOWN_INTEGER, 1)
WHOLE(GetBoolean, fmi2Boolean, known_boolean, N_KNOWN_BOOLEAN, 1)
WHOLE(GetString, fmi2String, known_string, N_KNOWN_STRING, 1)
WHOLE(SetInteger, const fmi2Integer, known_integer, N_KNOWN_INTEGER, 1)
WHOLE(SetBoolean, const fmi2Boolean, known_boolean, N_KNOWN_BOOLEAN, 1)
WHOLE(SetString, const fmi2String, known_string, N_KNOWN_STRING, value[i] != NULL)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known, const fmi2Real seed[], fmi2Real out[]) {
    USABLE("GetDirectionalDerivative");
    (void)unknown; (void)n_unknown; (void)known; (void)n_known; (void)seed; (void)out;
    return fail(m, "getDirectionalDerivative: not provided");
}

/* ---- FMU state ------------------------------------------------------------ */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) { USABLE("GetFMUstate"); return get_state(m, state); }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) { USABLE("SetFMUstate"); return set_state(m, state); }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) { USABLE("FreeFMUstate"); return free_state(m, state); }
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) { USABLE("SerializedFMUstateSize"); return size_of_state(m, state, size); }
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) { USABLE("SerializeFMUstate"); return bytes_of_state(m, state, bytes, size); }
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) { USABLE("DeSerializeFMUstate"); return state_of_bytes(m, bytes, size, state); }

/* ---- co-simulation -------------------------------------------------------- */

static fmi2Status pass_step(Corrected *m, double at, double length, int no_rollback) {
    return inner_DoStep(m->inner, at, length, no_rollback);
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real length, fmi2Boolean no_rollback) { USABLE("DoStep"); return advance(m, t, length, no_rollback); }

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]) {
    USABLE("SetRealInputDerivatives");
    (void)vr; (void)order; (void)value;
    return n ? fail(m, "setRealInputDerivatives: not provided") : fmi2OK;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    USABLE("GetRealStatus");
    if (kind != fmi2LastSuccessfulTime) return fail(m, "getRealStatus: only the last successful time is known");
    GIVEN(value, "getRealStatus");
    *value = m->s.t;
    return fmi2OK;
}
