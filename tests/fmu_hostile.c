/* A host that does everything wrong: fmu_hostile LIBRARY URI GUID TYPE NEEDS_RESOURCES REAL_VR
 * Every wrong call must come back with a status above fmi2Warning (or NULL) and a line in the log, and the instance must
 * run properly afterwards. Prints each check that fails; exit code 1 where one did. */
#include <dlfcn.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

static int lines, failures;

static void logger(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    (void)e; (void)name; (void)status; (void)category;
    lines += message && *message;
}

static void check(const char *what, int fine) {
    if (!fine) { printf("%s\n", what); failures++; }
    fflush(stdout);
}

/* an error that was told */
#define REFUSED(call) do { lines = 0; check(#call, (call) >= fmi2Discard && lines > 0); } while (0)
/* a handle without a logger: the status is all that can be asked for */
#define REFUSED_DEAD(call) check(#call, (call) >= fmi2Discard)
#define FINE(call) check(#call, (call) <= fmi2Warning)
#define ANY(call) (void)(call)

#define FUNCTIONS(X) \
    X(Instantiate) X(FreeInstance) X(SetDebugLogging) X(SetupExperiment) X(EnterInitializationMode) \
    X(ExitInitializationMode) X(Terminate) X(Reset) X(GetReal) X(GetInteger) X(GetBoolean) X(GetString) X(SetReal) \
    X(SetInteger) X(SetBoolean) X(SetString) X(GetFMUstate) X(SetFMUstate) X(FreeFMUstate) X(SerializedFMUstateSize) \
    X(SerializeFMUstate) X(DeSerializeFMUstate) X(GetDirectionalDerivative) X(SetRealInputDerivatives) \
    X(GetRealOutputDerivatives) X(DoStep) X(CancelStep) X(GetStatus) X(GetRealStatus) X(GetIntegerStatus) \
    X(GetBooleanStatus) X(GetStringStatus)
#define DECLARE(name) static fmi2##name##TYPE *f##name;
FUNCTIONS(DECLARE)

/* every function on a handle that is no living instance */
static void on_stranger(fmi2Component c) {
    fmi2ValueReference vr[1] = {0};
    fmi2Real real[1] = {0};
    fmi2Integer whole[1] = {1};
    fmi2String text[1] = {"x"};
    fmi2FMUstate state = NULL;
    fmi2Byte bytes[8] = {0};
    fmi2Status status;
    size_t size;
    REFUSED_DEAD(fSetDebugLogging(c, 0, 0, NULL));
    REFUSED_DEAD(fSetupExperiment(c, 0, 0, 0, 0, 0));
    REFUSED_DEAD(fEnterInitializationMode(c));
    REFUSED_DEAD(fExitInitializationMode(c));
    REFUSED_DEAD(fTerminate(c));
    REFUSED_DEAD(fReset(c));
    REFUSED_DEAD(fGetReal(c, vr, 1, real));
    REFUSED_DEAD(fSetReal(c, vr, 1, real));
    REFUSED_DEAD(fGetInteger(c, vr, 1, whole));
    REFUSED_DEAD(fSetInteger(c, vr, 1, whole));
    REFUSED_DEAD(fGetBoolean(c, vr, 1, whole));
    REFUSED_DEAD(fSetBoolean(c, vr, 1, whole));
    REFUSED_DEAD(fGetString(c, vr, 1, text));
    REFUSED_DEAD(fSetString(c, vr, 1, text));
    REFUSED_DEAD(fGetFMUstate(c, &state));
    REFUSED_DEAD(fSetFMUstate(c, state));
    REFUSED_DEAD(fFreeFMUstate(c, &state));
    REFUSED_DEAD(fSerializedFMUstateSize(c, state, &size));
    REFUSED_DEAD(fSerializeFMUstate(c, state, bytes, 8));
    REFUSED_DEAD(fDeSerializeFMUstate(c, bytes, 8, &state));
    REFUSED_DEAD(fGetDirectionalDerivative(c, vr, 1, vr, 1, real, real));
    REFUSED_DEAD(fSetRealInputDerivatives(c, vr, 1, whole, real));
    REFUSED_DEAD(fGetRealOutputDerivatives(c, vr, 1, whole, real));
    REFUSED_DEAD(fDoStep(c, 0, 1e-3, 1));
    REFUSED_DEAD(fCancelStep(c));
    REFUSED_DEAD(fGetStatus(c, fmi2DoStepStatus, &status));
    REFUSED_DEAD(fGetRealStatus(c, fmi2LastSuccessfulTime, real));
    REFUSED_DEAD(fGetIntegerStatus(c, fmi2DoStepStatus, whole));
    REFUSED_DEAD(fGetBooleanStatus(c, fmi2Terminated, whole));
    REFUSED_DEAD(fGetStringStatus(c, fmi2PendingStatus, text));
}

static void run(fmi2Component c, fmi2ValueReference vr) {
    double value = 0;
    int i;
    FINE(fSetupExperiment(c, 0, 0, 0, 0, 0));
    FINE(fEnterInitializationMode(c));
    FINE(fExitInitializationMode(c));
    for (i = 0; i < 3; i++) FINE(fDoStep(c, 1e-3 * i, 1e-3, 1));
    FINE(fGetReal(c, &vr, 1, &value));
    check("a finite value", isfinite(value));
}

#define NONE(call) do { fmi2Component made; lines = 0; made = (call); check(#call, !made && lines > 0); } while (0)

int main(int argc, char **argv) {
    fmi2CallbackFunctions callbacks = {logger, calloc, free, NULL, NULL};
    const char *uri = argv[2], *guid = argv[3];
    fmi2Type type = (fmi2Type)atoi(argv[4]);
    int needs = atoi(argv[5]), garbage[64] = {0};
    fmi2ValueReference real = (unsigned)atoi(argv[6]), none = 4000000, ones[1];
    fmi2Component c, other;
    fmi2FMUstate state = NULL, copy, strange = garbage;
    fmi2Byte *bytes;
    fmi2Real x[1] = {0};
    fmi2Integer k[1] = {1};
    fmi2String text[1] = {NULL};
    size_t size = 0;
    void *library = dlopen(argv[1], RTLD_NOW | RTLD_LOCAL);
    (void)argc;
    if (!library) { fprintf(stderr, "%s\n", dlerror()); return 2; }
#define GET(name) if (!(*(void **)&f##name = dlsym(library, "fmi2" #name))) { fprintf(stderr, "no fmi2" #name "\n"); return 3; }
    FUNCTIONS(GET)

    NONE(fInstantiate("a", type, "{wrong}", uri, &callbacks, 0, 0));
    NONE(fInstantiate("a", type, NULL, uri, &callbacks, 0, 0));
    NONE(fInstantiate("a", (fmi2Type)7, guid, uri, &callbacks, 0, 0));
    if (needs) {
        NONE(fInstantiate("a", type, guid, NULL, &callbacks, 0, 0));
        NONE(fInstantiate("a", type, guid, "", &callbacks, 0, 0));
        NONE(fInstantiate("a", type, guid, "file:///there/is/no/such%20folder", &callbacks, 0, 0));
        NONE(fInstantiate("a", type, guid, "http://example.org/a%zz%", &callbacks, 0, 0));
    } else {
        c = fInstantiate("a", type, guid, NULL, &callbacks, 0, 0);
        check("NULL resources", c != NULL);
        fFreeInstance(c);
    }
    c = fInstantiate(NULL, type, guid, uri, NULL, 0, 0); /* no name, no functions, no logger */
    if (c) {
        REFUSED_DEAD(fDoStep(c, 0, 1e-3, 1));
        REFUSED_DEAD(fGetReal(c, NULL, 1, NULL));
        fFreeInstance(c);
    }

    c = fInstantiate("a", type, guid, uri, &callbacks, 0, 0);
    check("instantiate", c != NULL);
    if (!c) return 4;
    ones[0] = real;
    REFUSED(fDoStep(c, 0, 1e-3, 1));
    REFUSED(fExitInitializationMode(c));
    REFUSED(fTerminate(c));
    REFUSED(fGetReal(c, NULL, 1, x));
    REFUSED(fGetReal(c, ones, 1, NULL));
    REFUSED(fSetReal(c, NULL, 1, x));
    REFUSED(fSetReal(c, ones, 1, NULL));
    REFUSED(fGetInteger(c, ones, 1, NULL));
    REFUSED(fSetInteger(c, NULL, 1, NULL));
    REFUSED(fGetBoolean(c, NULL, 1, NULL));
    REFUSED(fSetBoolean(c, ones, 1, NULL));
    REFUSED(fGetString(c, ones, 1, NULL));
    REFUSED(fSetString(c, ones, 1, text));
    REFUSED(fGetReal(c, &none, 1, x));
    REFUSED(fSetReal(c, &none, 1, x));
    REFUSED(fGetInteger(c, ones, 1, k)); /* of another type */
    REFUSED(fSetInteger(c, ones, 1, k));
    REFUSED(fGetBoolean(c, ones, 1, k));
    REFUSED(fSetBoolean(c, ones, 1, k));
    REFUSED(fGetString(c, ones, 1, text));
    text[0] = "text";
    REFUSED(fSetString(c, ones, 1, text));
    REFUSED(fGetInteger(c, &none, 1, k));
    REFUSED(fSetBoolean(c, &none, 1, k));
    REFUSED(fSetString(c, &none, 1, text));
    REFUSED(fGetFMUstate(c, NULL));
    REFUSED(fSetFMUstate(c, NULL));
    REFUSED(fSetFMUstate(c, garbage));
    REFUSED(fFreeFMUstate(c, &strange));
    REFUSED(fSerializedFMUstateSize(c, NULL, &size));
    REFUSED(fSerializeFMUstate(c, garbage, (fmi2Byte *)garbage, 64));
    REFUSED(fDeSerializeFMUstate(c, NULL, 8, &state));
    REFUSED(fDeSerializeFMUstate(c, (fmi2Byte *)garbage, 64, &state));
    REFUSED(fDeSerializeFMUstate(c, (fmi2Byte *)garbage, 0, &state));
    garbage[15] = 0x01010101;
    REFUSED(fDeSerializeFMUstate(c, (fmi2Byte *)garbage, 64, &state));
    REFUSED(fSetRealInputDerivatives(c, NULL, 1, NULL, NULL));
    REFUSED(fGetDirectionalDerivative(c, NULL, 1, NULL, 1, NULL, NULL));
    REFUSED(fGetRealOutputDerivatives(c, NULL, 1, NULL, NULL));
    REFUSED(fGetBooleanStatus(c, fmi2Terminated, NULL));
    REFUSED(fGetRealStatus(c, fmi2LastSuccessfulTime, NULL));
    REFUSED(fGetStatus(c, (fmi2StatusKind)99, NULL));
    REFUSED(fCancelStep(c));
    FINE(fReset(c));

    run(c, real);
    REFUSED(fEnterInitializationMode(c));
    REFUSED(fExitInitializationMode(c));
    REFUSED(fSetupExperiment(c, 0, 0, 0, 0, 0));
    FINE(fGetFMUstate(c, &state));
    copy = state;
    FINE(fSerializedFMUstateSize(c, state, &size));
    check("size of a state", size > 0);
    REFUSED(fSerializedFMUstateSize(c, state, NULL));
    bytes = malloc(size);
    REFUSED(fSerializeFMUstate(c, state, NULL, size));
    REFUSED(fSerializeFMUstate(c, state, bytes, size - 1));
    FINE(fSerializeFMUstate(c, state, bytes, size));
    REFUSED(fDeSerializeFMUstate(c, bytes, size - 1, &state));
    FINE(fSetFMUstate(c, state));
    FINE(fFreeFMUstate(c, &state));
    check("a freed state is NULL", !state);
    REFUSED(fSetFMUstate(c, copy));
    REFUSED(fFreeFMUstate(c, &copy));
    FINE(fFreeFMUstate(c, &state));
    other = fInstantiate("b", type, guid, uri, &callbacks, 0, 0); /* bytes go into an instance that has not begun */
    FINE(fDeSerializeFMUstate(other, bytes, size, &state));
    FINE(fSetFMUstate(other, state));
    FINE(fDoStep(other, 3e-3, 1e-3, 1));
    FINE(fFreeFMUstate(other, &state));
    fFreeInstance(other);
    free(bytes);
    ANY(fDoStep(c, 3e-3, -1, 1)); /* an estimator tells these by its health */
    ANY(fDoStep(c, NAN, NAN, 1));
    ANY(fDoStep(c, 3e-3, 0, 1));
    FINE(fReset(c));
    run(c, real);
    FINE(fTerminate(c));
    REFUSED(fTerminate(c));
    REFUSED(fDoStep(c, 3e-3, 1e-3, 1));
    FINE(fReset(c));
    run(c, real);

    on_stranger(NULL);
    on_stranger(garbage);
    fFreeInstance(garbage);
    fFreeInstance(NULL);
    fFreeInstance(c);
    fFreeInstance(c);
    on_stranger(c);
    c = fInstantiate("c", type, guid, uri, &callbacks, 0, 0);
    check("instantiate again", c != NULL);
    run(c, real);
    fFreeInstance(c);
    dlclose(library);
    printf("%d failed\n", failures);
    return failures > 0;
}
