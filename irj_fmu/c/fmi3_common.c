/* What the FMI 3.0 wrappers answer alike, included by them.
 *
 * Before it stand: Instance with State s (which begins with the token), environment and log; TOKEN; fail(instance, format,
 * ...); restored(instance), called when another state was put into it. A wrapper round another FMU, which passes calls on, defines
 * PASSES_ON and answers those of the life cycle, of binary variables and of the FMU state itself. One without model exchange
 * and derivatives defines COSIMULATION_ONLY.
 */

#include "living.c"

typedef const fmi3ValueReference *References;

#define LIVING(call) do { if (!is_alive(&instances, c)) { tell_stranger(call); return fmi3Error; } } while (0)
#define GIVEN(condition, call) do { if (!(condition)) return fail(c, "%s: a pointer is NULL", call); } while (0)
#define REFUSE(text) { LIVING(__func__); return fail(c, text); }

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback clock,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock) {
    if (log) log(environment, fmi3Error, "logStatusError", "instantiate: this FMU is not for scheduled execution");
    return NULL;
}

#ifndef PASSES_ON
void fmi3FreeInstance(fmi3Instance c) {
    if (!c) return;
    if (dies(&instances, c)) discard(c);
    else tell_stranger("fmi3FreeInstance");
}
fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) { LIVING("fmi3SetDebugLogging"); return fmi3OK; }
#endif

/* ---- no such variables -------------------------------------------------- */

fmi3Status fmi3GetClock(fmi3Instance c, References vr, size_t n, fmi3Clock v[]) REFUSE("there are no clocks")
fmi3Status fmi3SetClock(fmi3Instance c, References vr, size_t n, const fmi3Clock v[]) REFUSE("there are no clocks")

#ifndef PASSES_ON
fmi3Status fmi3GetBinary(fmi3Instance c, References vr, size_t n, size_t sizes[], fmi3Binary v[], size_t k) REFUSE("there are no binary variables")
fmi3Status fmi3SetBinary(fmi3Instance c, References vr, size_t n, const size_t sizes[], const fmi3Binary v[], size_t k) REFUSE("there are no binary variables")

/* ---- FMU state ------------------------------------------------------------ */

static State *new_state(void) {
    State *made = malloc(sizeof *made);
    if (made && born(&states, made)) return made;
    free(made);
    return NULL;
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    LIVING("fmi3GetFMUState");
    GIVEN(state, "getFMUState");
    if (!is_alive(&states, *state) && !(*state = new_state())) return fail(c, "getFMUState: out of memory");
    memcpy(*state, &((Instance *)c)->s, sizeof(State));
    return fmi3OK;
}
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    LIVING("fmi3SetFMUState");
    if (!is_alive(&states, state)) return fail(c, "setFMUState: this is no state of this FMU, or it was freed");
    memcpy(&((Instance *)c)->s, state, sizeof(State));
    restored(c);
    return fmi3OK;
}
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    LIVING("fmi3FreeFMUState");
    if (!state || !*state) return fmi3OK;
    if (!dies(&states, *state)) return fail(c, "freeFMUState: this is no state of this FMU, or it was freed");
    free(*state);
    *state = NULL;
    return fmi3OK;
}
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) { LIVING("fmi3SerializedFMUStateSize"); 
    if (!is_alive(&states, state)) return fail(c, "serializedFMUStateSize: this is no state of this FMU, or it was freed");
    GIVEN(size, "serializedFMUStateSize");
    *size = sizeof(State);
    return fmi3OK;
}
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    LIVING("fmi3SerializeFMUState");
    if (!is_alive(&states, state)) return fail(c, "serializeFMUState: this is no state of this FMU, or it was freed");
    GIVEN(bytes, "serializeFMUState");
    if (size < sizeof(State)) return fail(c, "serializeFMUState: %lu bytes are too few", (unsigned long)size);
    memcpy(bytes, state, sizeof(State));
    return fmi3OK;
}
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    LIVING("fmi3DeserializeFMUState");
    GIVEN(bytes && state, "deserializeFMUState");
    if (size != sizeof(State) || memcmp(bytes, TOKEN, strlen(TOKEN)) != 0) return fail(c, "deserializeFMUState: these bytes are not a state of this FMU");
    if (!is_alive(&states, *state) && !(*state = new_state())) return fail(c, "deserializeFMUState: out of memory");
    memcpy(*state, bytes, sizeof(State));
    return fmi3OK;
}

#endif

/* ---- what other interfaces would need ------------------------------------- */

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) REFUSE("there is nothing to configure")
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) REFUSE("there is nothing to configure")
fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, References v, size_t n, fmi3Float64 a[], fmi3IntervalQualifier q[]) REFUSE("there are no clocks")
fmi3Status fmi3GetIntervalFraction(fmi3Instance c, References v, size_t n, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[]) REFUSE("there are no clocks")
fmi3Status fmi3GetShiftDecimal(fmi3Instance c, References v, size_t n, fmi3Float64 a[]) REFUSE("there are no clocks")
fmi3Status fmi3GetShiftFraction(fmi3Instance c, References v, size_t n, fmi3UInt64 a[], fmi3UInt64 b[]) REFUSE("there are no clocks")
fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, References v, size_t n, const fmi3Float64 a[]) REFUSE("there are no clocks")
fmi3Status fmi3SetIntervalFraction(fmi3Instance c, References v, size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]) REFUSE("there are no clocks")
fmi3Status fmi3SetShiftDecimal(fmi3Instance c, References v, size_t n, const fmi3Float64 a[]) REFUSE("there are no clocks")
fmi3Status fmi3SetShiftFraction(fmi3Instance c, References v, size_t n, const fmi3UInt64 a[], const fmi3UInt64 b[]) REFUSE("there are no clocks")
fmi3Status fmi3EnterStepMode(fmi3Instance c) REFUSE("this FMU has no event mode in co-simulation")
fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, References v, size_t n, const fmi3Int32 o[], fmi3Float64 a[], size_t k) REFUSE("output derivatives are not provided")
fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference v, fmi3Float64 t) REFUSE("this FMU is not for scheduled execution")
fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference v, size_t *n) REFUSE("dependencies are not provided")
fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference v, size_t a[], fmi3ValueReference b[], size_t d[], fmi3DependencyKind e[],
                                       size_t n) REFUSE("dependencies are not provided")

/* Variables of a type of which there are none. */
#define NO_VARIABLES(name) \
    fmi3Status fmi3Get##name(fmi3Instance c, References vr, size_t n, fmi3##name value[], size_t length) { \
        LIVING("fmi3Get" #name); \
        return n ? fail(c, "get" #name ": there are no such variables") : fmi3OK; \
    } \
    fmi3Status fmi3Set##name(fmi3Instance c, References vr, size_t n, const fmi3##name value[], size_t length) { \
        LIVING("fmi3Set" #name); \
        return n ? fail(c, "set" #name ": there are no such variables") : fmi3OK; \
    }

#ifdef COSIMULATION_ONLY
/* ---- what a co-simulation does not provide; some hosts look for it in every FMU ---- */

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    if (log) log(environment, fmi3Error, "logStatusError", "instantiate: co-simulation only");
    return NULL;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, References u, size_t n, References k, size_t nk, const fmi3Float64 seed[], size_t ns,
                                        fmi3Float64 out[], size_t no) REFUSE("directional derivatives are not provided")
fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, References u, size_t n, References k, size_t nk, const fmi3Float64 seed[], size_t ns,
                                    fmi3Float64 out[], size_t no) REFUSE("adjoint derivatives are not provided")
#define ONLY_EXCHANGE REFUSE("this FMU is for co-simulation only")
fmi3Status fmi3EnterEventMode(fmi3Instance c) REFUSE("this FMU has no event mode in co-simulation")
fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) REFUSE("this FMU has no event mode in co-simulation")
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *a, fmi3Boolean *b, fmi3Boolean *d, fmi3Boolean *e, fmi3Boolean *f, fmi3Float64 *t) REFUSE("this FMU has no event mode in co-simulation")
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) ONLY_EXCHANGE
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean n, fmi3Boolean *event, fmi3Boolean *stop) ONLY_EXCHANGE
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) ONLY_EXCHANGE
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) ONLY_EXCHANGE
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) ONLY_EXCHANGE
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) ONLY_EXCHANGE
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) ONLY_EXCHANGE
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) ONLY_EXCHANGE
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) ONLY_EXCHANGE
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) ONLY_EXCHANGE
#endif
