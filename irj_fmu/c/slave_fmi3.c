/* FMI 3.0 co-simulation library of a Python slave: the FMI 2.0 library of slave_shim.c behind it does the work.
 *
 * shim_config.h gives beside what is said there VR_TIME, the value reference of the time.
 */
#define FMI2_Export __attribute__((visibility("hidden")))
#include "slave_shim.c"
#undef LIVING
#undef GIVEN

#include "fmi3Functions.h"

#include "fmi3_log.c"

typedef struct { /* what fmi2Instantiate takes for its host */
    Sink sink;
    fmi2CallbackFunctions functions;
    double now;
} Host;

static Host *host_of(void *c) { return ((Shim *)c)->host.componentEnvironment; }

#define PASSES_ON
#define COSIMULATION_ONLY
#include "fmi3_common.c"

/* ---- life cycle --------------------------------------------------------------------------------------------------- */

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    Host *host = calloc(1, sizeof *host);
    char *folder = strdup(resources ? resources : "");
    size_t length = folder ? strlen(folder) : 0;
    void *made = NULL;
    while (length > 1 && folder[length - 1] == '/') folder[--length] = 0; /* Python knows the folder by its name alone */
    if (host && folder) {
        host->sink = (Sink){environment, log};
        host->functions.logger = relay;
        host->functions.allocateMemory = calloc;
        host->functions.freeMemory = free;
        host->functions.componentEnvironment = host;
        if (events) relay(host, name, fmi2Error, "logStatusError", "instantiate: there is no event mode");
        else made = fmi2Instantiate(name, fmi2CoSimulation, token, folder, &host->functions, visible, logging);
    }
    free(folder);
    if (!made) free(host);
    return made;
}

void fmi3FreeInstance(fmi3Instance c) {
    Host *host = is_alive(&instances, c) && !((Shim *)c)->dead ? host_of(c) : NULL; /* a dead one stays, and may log */
    fmi2FreeInstance(c);
    free(host);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    return (fmi3Status)fmi2SetDebugLogging(c, on, n, categories);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    fmi2Status status;
    LIVING("fmi3EnterInitializationMode");
    BETWEEN(INSTANTIATED, INSTANTIATED, "enterInitializationMode");
    if (has_tolerance && !(tolerance > 0)) return (fmi3Status)fail(c, "enterInitializationMode: a tolerance of %g", tolerance);
    host_of(c)->now = start;
    status = fmi2SetupExperiment(c, has_tolerance, tolerance, start, has_stop, stop);
    return (fmi3Status)(status <= fmi2Warning ? fmi2EnterInitializationMode(c) : status);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return (fmi3Status)fmi2ExitInitializationMode(c); }
fmi3Status fmi3Terminate(fmi3Instance c) { return (fmi3Status)fmi2Terminate(c); }
fmi3Status fmi3Reset(fmi3Instance c) { return (fmi3Status)fmi2Reset(c); }

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 length, fmi3Boolean no_rollback, fmi3Boolean *events, fmi3Boolean *stop,
                      fmi3Boolean *early, fmi3Float64 *last) {
    fmi2Status status;
    LIVING("fmi3DoStep");
    GIVEN(events && stop && early && last, "doStep");
    *events = *stop = *early = fmi3False;
    status = fmi2DoStep(c, t, length, no_rollback);
    if (status <= fmi2Warning) host_of(c)->now = t + length;
    *last = host_of(c)->now;
    return (fmi3Status)status;
}

/* ---- variables ----------------------------------------------------------------------------------------------------- */

#define SCALARS(call) do { if (length != n) return fail(c, "%s: all variables are scalars", call); } while (0)

fmi3Status fmi3GetFloat64(fmi3Instance c, References vr, size_t n, fmi3Float64 value[], size_t length) {
    fmi2Status status = fmi2OK;
    size_t i;
    LIVING("fmi3GetFloat64");
    GIVEN(n == 0 || (vr && value), "getFloat64");
    SCALARS("getFloat64");
    for (i = 0; i < n && vr[i] != VR_TIME; i++) {}
    if (i == n) return (fmi3Status)fmi2GetReal(c, vr, n, value);
    for (i = 0; i < n && status <= fmi2Warning; i++) {
        if (vr[i] == VR_TIME) value[i] = host_of(c)->now;
        else status = fmi2GetReal(c, vr + i, 1, value + i);
    }
    return (fmi3Status)status;
}

#define SAME(function, older, type) \
    fmi3Status fmi3##function(fmi3Instance c, References vr, size_t n, type value[], size_t length) { \
        LIVING("fmi3" #function); \
        SCALARS(#function); \
        return (fmi3Status)fmi2##older(c, vr, n, value); \
    }
SAME(SetFloat64, SetReal, const fmi3Float64)
SAME(GetInt32, GetInteger, fmi3Int32)
SAME(SetInt32, SetInteger, const fmi3Int32)
SAME(GetString, GetString, fmi3String)
SAME(SetString, SetString, const fmi3String)

/* one is a byte, the other an integer */
fmi3Status fmi3GetBoolean(fmi3Instance c, References vr, size_t n, fmi3Boolean value[], size_t length) {
    fmi2Status status = fmi2OK;
    size_t i;
    LIVING("fmi3GetBoolean");
    GIVEN(n == 0 || (vr && value), "getBoolean");
    SCALARS("getBoolean");
    for (i = 0; i < n && status <= fmi2Warning; i++) {
        fmi2Boolean one = fmi2False;
        status = fmi2GetBoolean(c, vr + i, 1, &one);
        value[i] = one != fmi2False;
    }
    return (fmi3Status)status;
}

fmi3Status fmi3SetBoolean(fmi3Instance c, References vr, size_t n, const fmi3Boolean value[], size_t length) {
    fmi2Status status = fmi2OK;
    size_t i;
    LIVING("fmi3SetBoolean");
    GIVEN(n == 0 || (vr && value), "setBoolean");
    SCALARS("setBoolean");
    for (i = 0; i < n && status <= fmi2Warning; i++) {
        const fmi2Boolean one = value[i] ? fmi2True : fmi2False;
        status = fmi2SetBoolean(c, vr + i, 1, &one);
    }
    return (fmi3Status)status;
}

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)

fmi3Status fmi3GetBinary(fmi3Instance c, References vr, size_t n, size_t sizes[], fmi3Binary v[], size_t k) REFUSE("there are no binary variables")
fmi3Status fmi3SetBinary(fmi3Instance c, References vr, size_t n, const size_t sizes[], const fmi3Binary v[], size_t k) REFUSE("there are no binary variables")

/* ---- FMU state ------------------------------------------------------------------------------------------------------ */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) { return (fmi3Status)fmi2GetFMUstate(c, state); }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) { return (fmi3Status)fmi2SetFMUstate(c, state); }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) { return (fmi3Status)fmi2FreeFMUstate(c, state); }
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) { return (fmi3Status)fmi2SerializedFMUstateSize(c, state, size); }
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) { return (fmi3Status)fmi2SerializeFMUstate(c, state, (fmi2Byte *)bytes, size); }
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) { return (fmi3Status)fmi2DeSerializeFMUstate(c, (const fmi2Byte *)bytes, size, state); }
