/* The same as fmu_hostile.c for FMI 3.0, model exchange and co-simulation: fmu_hostile3 LIBRARY TOKEN REAL_VR STATES [RESOURCES];
 * without states it is co-simulation only */
#include <dlfcn.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "fmi3Functions.h"

static int lines, failures;
static const char *resources;

static void logger(fmi3InstanceEnvironment e, fmi3Status status, fmi3String category, fmi3String message) {
    (void)e; (void)status; (void)category;
    lines += message && *message;
}

static void check(const char *what, int fine) {
    if (!fine) { printf("%s\n", what); failures++; }
    fflush(stdout);
}

#define REFUSED(call) do { lines = 0; check(#call, (call) >= fmi3Discard && lines > 0); } while (0)
#define REFUSED_DEAD(call) check(#call, (call) >= fmi3Discard)
#define ANY(call) ((void)(call))
#define FINE(call) check(#call, (call) <= fmi3Warning)
#define NONE(call) do { fmi3Instance made; lines = 0; made = (call); check(#call, !made && lines > 0); } while (0)

#define FUNCTIONS(X) \
    X(InstantiateModelExchange) X(InstantiateCoSimulation) X(InstantiateScheduledExecution) X(FreeInstance) X(SetDebugLogging) \
    X(EnterInitializationMode) X(ExitInitializationMode) X(EnterEventMode) X(EnterContinuousTimeMode) X(Terminate) X(Reset) \
    X(GetFloat64) X(SetFloat64) X(GetInt32) X(SetBoolean) X(GetBinary) X(GetFMUState) X(SetFMUState) X(FreeFMUState) \
    X(SerializedFMUStateSize) X(SerializeFMUState) X(DeserializeFMUState) X(GetDirectionalDerivative) \
    X(UpdateDiscreteStates) X(CompletedIntegratorStep) X(SetTime) X(SetContinuousStates) X(GetContinuousStates) \
    X(GetContinuousStateDerivatives) X(GetNominalsOfContinuousStates) X(GetNumberOfContinuousStates) X(DoStep)
#define DECLARE(name) static fmi3##name##TYPE *f##name;
FUNCTIONS(DECLARE)

static void on_stranger(fmi3Instance c) {
    fmi3ValueReference vr[1] = {0};
    fmi3Float64 real[16] = {0};
    fmi3Int32 whole[1] = {0};
    fmi3Boolean flag[5] = {0};
    fmi3FMUState state = NULL;
    fmi3Byte bytes[8] = {0};
    size_t size;
    REFUSED_DEAD(fSetDebugLogging(c, 0, 0, NULL));
    REFUSED_DEAD(fEnterInitializationMode(c, 0, 0, 0, 0, 0));
    REFUSED_DEAD(fExitInitializationMode(c));
    REFUSED_DEAD(fEnterEventMode(c));
    REFUSED_DEAD(fEnterContinuousTimeMode(c));
    REFUSED_DEAD(fTerminate(c));
    REFUSED_DEAD(fReset(c));
    REFUSED_DEAD(fGetFloat64(c, vr, 1, real, 1));
    REFUSED_DEAD(fSetFloat64(c, vr, 1, real, 1));
    REFUSED_DEAD(fGetInt32(c, vr, 1, whole, 1));
    REFUSED_DEAD(fSetBoolean(c, vr, 1, flag, 1));
    REFUSED_DEAD(fGetBinary(c, vr, 1, &size, NULL, 1));
    REFUSED_DEAD(fGetFMUState(c, &state));
    REFUSED_DEAD(fSetFMUState(c, state));
    REFUSED_DEAD(fFreeFMUState(c, &state));
    REFUSED_DEAD(fSerializedFMUStateSize(c, state, &size));
    REFUSED_DEAD(fSerializeFMUState(c, state, bytes, 8));
    REFUSED_DEAD(fDeserializeFMUState(c, bytes, 8, &state));
    REFUSED_DEAD(fGetDirectionalDerivative(c, vr, 1, vr, 1, real, 1, real, 1));
    REFUSED_DEAD(fUpdateDiscreteStates(c, flag, flag + 1, flag + 2, flag + 3, flag + 4, real));
    REFUSED_DEAD(fCompletedIntegratorStep(c, 1, flag, flag + 1));
    REFUSED_DEAD(fSetTime(c, 0));
    REFUSED_DEAD(fSetContinuousStates(c, real, 1));
    REFUSED_DEAD(fGetContinuousStates(c, real, 1));
    REFUSED_DEAD(fGetContinuousStateDerivatives(c, real, 1));
    REFUSED_DEAD(fGetNominalsOfContinuousStates(c, real, 1));
    REFUSED_DEAD(fGetNumberOfContinuousStates(c, &size));
    REFUSED_DEAD(fDoStep(c, 0, 1e-3, 1, flag, flag + 1, flag + 2, real));
}

static void run(fmi3Instance c, size_t n) {
    fmi3Float64 x[64], dx[64];
    fmi3Boolean flag[5], stop;
    fmi3Float64 next;
    FINE(fEnterInitializationMode(c, 0, 0, 0, 0, 0));
    FINE(fExitInitializationMode(c));
    FINE(fUpdateDiscreteStates(c, flag, flag + 1, flag + 2, flag + 3, flag + 4, &next));
    FINE(fEnterContinuousTimeMode(c));
    FINE(fGetContinuousStates(c, x, n));
    FINE(fSetTime(c, 1e-3));
    FINE(fSetContinuousStates(c, x, n));
    FINE(fGetContinuousStateDerivatives(c, dx, n));
    FINE(fCompletedIntegratorStep(c, 1, flag, &stop));
    check("finite derivatives", isfinite(dx[0]));
}

static void run_steps(const char *token, size_t n) {
    fmi3Float64 x[64] = {0}, last = -1;
    fmi3Boolean flag[5];
    fmi3Instance c = fInstantiateCoSimulation("a", token, resources, 0, 0, 0, 0, NULL, 0, NULL, logger, NULL);
    check("instantiate for co-simulation", c != NULL);
    if (!c) return;
    REFUSED(fDoStep(c, 0, 1e-3, 1, flag, flag + 1, flag + 2, &last));
    REFUSED(fEnterInitializationMode(c, 1, -1, 0, 0, 0));
    FINE(fEnterInitializationMode(c, 1, 1e-6, 0, 0, 0));
    FINE(fExitInitializationMode(c));
    REFUSED(fEnterContinuousTimeMode(c));
    REFUSED(fEnterEventMode(c));
    REFUSED(fSetContinuousStates(c, x, n));
    REFUSED(fDoStep(c, 0, 1e-3, 1, NULL, NULL, NULL, NULL));
    if (n) {
        REFUSED(fDoStep(c, 0, -1, 1, flag, flag + 1, flag + 2, &last));
        REFUSED(fDoStep(c, 0, NAN, 1, flag, flag + 1, flag + 2, &last));
    } else { /* an estimator tells these by its health, as in FMI 2 */
        ANY(fDoStep(c, 0, -1, 1, flag, flag + 1, flag + 2, &last));
        ANY(fDoStep(c, 0, NAN, 1, flag, flag + 1, flag + 2, &last));
    }
    FINE(fDoStep(c, 0, 1e-3, 1, flag, flag + 1, flag + 2, &last));
    check("the time of the step", fabs(last - 1e-3) < 1e-12);
    FINE(fTerminate(c));
    REFUSED(fDoStep(c, 1e-3, 1e-3, 1, flag, flag + 1, flag + 2, &last));
    FINE(fReset(c));
    fFreeInstance(c);
}

/* What is probed in main: for model exchange, or for co-simulation where that is all there is. */
static fmi3Instance born_as(const char *token, size_t n) {
    if (n) return fInstantiateModelExchange("a", token, resources, 0, 0, NULL, logger);
    NONE(fInstantiateModelExchange("a", token, resources, 0, 0, NULL, logger));
    return fInstantiateCoSimulation("a", token, resources, 0, 0, 0, 0, NULL, 0, NULL, logger, NULL);
}

static void ready(fmi3Instance c, size_t n) {
    fmi3Boolean flag[3];
    fmi3Float64 last;
    if (n) { run(c, n); return; }
    FINE(fEnterInitializationMode(c, 0, 0, 0, 0, 0));
    FINE(fExitInitializationMode(c));
    FINE(fDoStep(c, 0, 1e-3, 1, flag, flag + 1, flag + 2, &last));
}

int main(int argc, char **argv) {
    const char *token = argv[2];
    fmi3ValueReference vr = (unsigned)atoi(argv[3]), none = 4000000;
    size_t n = (size_t)atoi(argv[4]), size = 0;
    int garbage[64] = {0};
    fmi3Instance c;
    fmi3FMUState state = NULL, copy, strange = garbage;
    fmi3Byte *bytes;
    fmi3Float64 x[64] = {0};
    fmi3Int32 whole[1];
    fmi3Boolean flag[5] = {0};
    void *library = dlopen(argv[1], RTLD_NOW | RTLD_LOCAL);
    resources = argc > 5 ? argv[5] : NULL;
    if (!library) { fprintf(stderr, "%s\n", dlerror()); return 2; }
#define GET(name) if (!(*(void **)&f##name = dlsym(library, "fmi3" #name))) { fprintf(stderr, "no fmi3" #name "\n"); return 3; }
    FUNCTIONS(GET)
    NONE(fInstantiateModelExchange("a", "{wrong}", NULL, 0, 0, NULL, logger));
    NONE(fInstantiateModelExchange("a", NULL, NULL, 0, 0, NULL, logger));
    NONE(fInstantiateCoSimulation("a", "{wrong}", NULL, 0, 0, 0, 0, NULL, 0, NULL, logger, NULL));
    NONE(fInstantiateCoSimulation("a", token, resources, 0, 0, 1, 0, NULL, 0, NULL, logger, NULL));
    NONE(fInstantiateScheduledExecution("a", token, resources, 0, 0, NULL, logger, NULL, NULL, NULL));
    check("no logger", !fInstantiateModelExchange(NULL, NULL, NULL, 0, 0, NULL, NULL));

    c = born_as(token, n);
    check("instantiate", c != NULL);
    if (!c) return 4;
    REFUSED(fExitInitializationMode(c));
    REFUSED(fEnterContinuousTimeMode(c));
    REFUSED(fEnterEventMode(c));
    REFUSED(fTerminate(c));
    REFUSED(fSetContinuousStates(c, x, n));
    REFUSED(fCompletedIntegratorStep(c, 1, flag, flag + 1));
    REFUSED(fDoStep(c, 0, 1e-3, 1, flag, flag + 1, flag + 2, x));
    REFUSED(fGetFloat64(c, NULL, 1, x, 1));
    REFUSED(fGetFloat64(c, &vr, 1, NULL, 1));
    REFUSED(fSetFloat64(c, &vr, 1, NULL, 1));
    REFUSED(fGetFloat64(c, &vr, 1, x, 2));
    REFUSED(fGetFloat64(c, &none, 1, x, 1));
    REFUSED(fSetFloat64(c, &none, 1, x, 1));
    REFUSED(fGetInt32(c, &vr, 1, whole, 1));
    REFUSED(fSetBoolean(c, &vr, 1, flag, 1));
    REFUSED(fGetContinuousStates(c, x, n + 1));
    REFUSED(fGetContinuousStates(c, NULL, n));
    REFUSED(fGetContinuousStateDerivatives(c, NULL, n));
    REFUSED(fGetNominalsOfContinuousStates(c, NULL, n));
    REFUSED(fGetNumberOfContinuousStates(c, NULL));
    REFUSED(fGetDirectionalDerivative(c, NULL, 1, NULL, 1, NULL, 1, NULL, 1));
    REFUSED(fGetFMUState(c, NULL));
    REFUSED(fSetFMUState(c, NULL));
    REFUSED(fSetFMUState(c, garbage));
    REFUSED(fFreeFMUState(c, &strange));
    REFUSED(fSerializedFMUStateSize(c, garbage, &size));
    REFUSED(fSerializeFMUState(c, NULL, (fmi3Byte *)garbage, 64));
    REFUSED(fDeserializeFMUState(c, (fmi3Byte *)garbage, 64, &state));
    REFUSED(fDeserializeFMUState(c, NULL, 64, &state));
    FINE(fReset(c));
    ready(c, n);
    REFUSED(fEnterInitializationMode(c, 0, 0, 0, 0, 0));
    REFUSED(fUpdateDiscreteStates(c, NULL, NULL, NULL, NULL, NULL, NULL));
    REFUSED(fCompletedIntegratorStep(c, 1, NULL, NULL));
    REFUSED(fSetContinuousStates(c, NULL, n));
    FINE(fGetFMUState(c, &state));
    copy = state;
    FINE(fSerializedFMUStateSize(c, state, &size));
    bytes = malloc(size);
    REFUSED(fSerializeFMUState(c, state, bytes, size - 1));
    FINE(fSerializeFMUState(c, state, bytes, size));
    FINE(fFreeFMUState(c, &state));
    REFUSED(fSetFMUState(c, copy));
    REFUSED(fFreeFMUState(c, &copy));
    FINE(fDeserializeFMUState(c, bytes, size, &state));
    FINE(fSetFMUState(c, state));
    FINE(fFreeFMUState(c, &state));
    free(bytes);
    FINE(fTerminate(c));
    REFUSED(fTerminate(c));
    REFUSED(fEnterEventMode(c));
    FINE(fReset(c));
    ready(c, n);
    run_steps(token, n);
    on_stranger(NULL);
    on_stranger(garbage);
    fFreeInstance(garbage);
    fFreeInstance(NULL);
    fFreeInstance(c);
    fFreeInstance(c);
    on_stranger(c);
    dlclose(library);
    printf("%d failed\n", failures);
    return failures > 0;
}
