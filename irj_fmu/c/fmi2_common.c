/* What the FMI 2.0 wrappers answer alike, included by them.
 *
 * Before it stand: Instance with State s (which begins with the GUID), name and logging; GUID; fail(instance, format, ...);
 * restored(instance), called when another state was put into it. A wrapper round another FMU, which passes calls on,
 * defines PASSES_ON and answers those of the life cycle and of the FMU state itself.
 */

#include "living.c"

#define LIVING(call) do { if (!is_alive(&instances, c)) { tell_stranger(call); return fmi2Error; } } while (0)
#define GIVEN(condition, call) do { if (!(condition)) return fail(c, "%s: a pointer is NULL", call); } while (0)

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

/* An instance with the host's name and functions; NULL where memory is out. */
static Instance *instance(fmi2String name, const fmi2CallbackFunctions *functions, fmi2Boolean logging) {
    Instance *m = calloc(1, sizeof *m);
    if (!m) return NULL;
    if (functions) m->host = *functions;
    m->name = calloc(1, (name ? strlen(name) : 0) + 1);
    if (!m->name) {
        free(m);
        return NULL;
    }
    if (name) strcpy(m->name, name);
    m->logging = logging;
    if (!born(&instances, m)) {
        free(m->name);
        free(m);
        return NULL;
    }
    return m;
}

static void discard(Instance *m) {
    free(m->name);
    free(m);
}

#ifndef PASSES_ON
void fmi2FreeInstance(fmi2Component c) {
    if (!c) return;
    if (dies(&instances, c)) discard(c);
    else tell_stranger("fmi2FreeInstance");
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    LIVING("fmi2SetDebugLogging");
    (void)n; (void)categories;
    ((Instance *)c)->logging = on;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    LIVING("fmi2EnterInitializationMode");
    Instance *m = c;
    if (m->s.phase != INSTANTIATED) return fail(m, "enterInitializationMode: called out of order");
    m->s.phase = INITIALIZING;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) {
    LIVING("fmi2Terminate");
    if (((Instance *)c)->s.phase <= INITIALIZING || ((Instance *)c)->s.phase == TERMINATED) return fail(c, "terminate: called out of order");
    ((Instance *)c)->s.phase = TERMINATED;
    return fmi2OK;
}

/* ---- FMU state ------------------------------------------------------------ */

static State *new_state(void) {
    State *made = malloc(sizeof *made);
    if (made && born(&states, made)) return made;
    free(made);
    return NULL;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    LIVING("fmi2GetFMUstate");
    GIVEN(state, "getFMUstate");
    if (!is_alive(&states, *state) && !(*state = new_state())) return fail(c, "getFMUstate: out of memory");
    memcpy(*state, &((Instance *)c)->s, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    LIVING("fmi2SetFMUstate");
    if (!is_alive(&states, state)) return fail(c, "setFMUstate: this is no state of this FMU, or it was freed");
    memcpy(&((Instance *)c)->s, state, sizeof(State));
    restored(c);
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    LIVING("fmi2FreeFMUstate");
    if (!state || !*state) return fmi2OK;
    if (!dies(&states, *state)) return fail(c, "freeFMUstate: this is no state of this FMU, or it was freed");
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    LIVING("fmi2SerializedFMUstateSize");
    if (!is_alive(&states, state)) return fail(c, "serializedFMUstateSize: this is no state of this FMU, or it was freed");
    GIVEN(size, "serializedFMUstateSize");
    *size = sizeof(State);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    LIVING("fmi2SerializeFMUstate");
    if (!is_alive(&states, state)) return fail(c, "serializeFMUstate: this is no state of this FMU, or it was freed");
    GIVEN(bytes, "serializeFMUstate");
    if (size < sizeof(State)) return fail(c, "serializeFMUstate: %lu bytes are too few", (unsigned long)size);
    memcpy(bytes, state, sizeof(State));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    LIVING("fmi2DeSerializeFMUstate");
    GIVEN(bytes && state, "deSerializeFMUstate");
    if (size != sizeof(State) || memcmp(bytes, GUID, strlen(GUID)) != 0)
        return fail(c, "deSerializeFMUstate: these bytes are not a state of this FMU");
    if (!is_alive(&states, *state) && !(*state = new_state())) return fail(c, "deSerializeFMUstate: out of memory");
    memcpy(*state, bytes, sizeof(State));
    return fmi2OK;
}

#endif

/* ---- co-simulation -------------------------------------------------------- */

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], fmi2Real value[]) {
    LIVING("fmi2GetRealOutputDerivatives");
    (void)vr; (void)order; (void)value;
    return n ? fail(c, "getRealOutputDerivatives: not provided") : fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c) { LIVING("fmi2CancelStep"); return fail(c, "cancelStep: doStep is never pending"); }

#define NO_STATUS(function, type) \
    fmi2Status function(fmi2Component c, const fmi2StatusKind what, type *value) { \
        LIVING(#function); \
        (void)what; (void)value; \
        return fail(c, #function ": doStep is never pending"); \
    }
NO_STATUS(fmi2GetStatus, fmi2Status)
NO_STATUS(fmi2GetIntegerStatus, fmi2Integer)
NO_STATUS(fmi2GetStringStatus, fmi2String)

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind what, fmi2Boolean *value) {
    LIVING("fmi2GetBooleanStatus");
    if (what != fmi2Terminated) return fail(c, "getBooleanStatus: only 'terminated' is known");
    GIVEN(value, "getBooleanStatus");
    *value = ((Instance *)c)->s.phase == TERMINATED;
    return fmi2OK;
}
