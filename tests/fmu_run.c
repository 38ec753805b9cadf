/* A host without Python: fmu_run LIBRARY GUID STEP COUNT INPUT_VR OUTPUT_VR [VR=VALUE ...]
 * Feeds sin(5 t) * 8 to the input and prints the output at each communication point; two instances go side by side and
 * the second one, which is reset half way, must give the same. What is logged goes to stderr. Exit code 4: a step failed. */
#include <dlfcn.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include "fmi2Functions.h"

static void logger(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    va_list values;
    (void)e; (void)category;
    fprintf(stderr, "%s %d ", name, status);
    va_start(values, message);
    vfprintf(stderr, message, values);
    va_end(values);
    fputc('\n', stderr);
}

#define FUNCTIONS(X) \
    X(Instantiate) X(FreeInstance) X(SetupExperiment) X(EnterInitializationMode) X(ExitInitializationMode) X(Terminate) \
    X(Reset) X(GetReal) X(SetReal) X(DoStep)
#define DECLARE(name) static fmi2##name##TYPE *f##name;
FUNCTIONS(DECLARE)
static int settings;
static char **setting;

static void must(int fine, const char *what) {
    if (fine) return;
    fprintf(stderr, "%s failed\n", what);
    exit(3);
}

static void begin(fmi2Component c) {
    int i;
    for (i = 0; i < settings; i++) {
        char *end;
        fmi2ValueReference vr = (fmi2ValueReference)strtoul(setting[i], &end, 10);
        fmi2Real value = strtod(end + 1, NULL);
        must(fSetReal(c, &vr, 1, &value) <= fmi2Warning, "set");
    }
    must(fSetupExperiment(c, 0, 0, 0, 0, 0) <= fmi2Warning, "setup");
    must(fEnterInitializationMode(c) <= fmi2Warning, "enter");
    must(fExitInitializationMode(c) <= fmi2Warning, "exit");
}

static double advance(fmi2Component c, double t, double step, fmi2ValueReference in, fmi2ValueReference out) {
    double u = 8 * sin(5 * t), y;
    must(fSetReal(c, &in, 1, &u) <= fmi2Warning, "input");
    if (fDoStep(c, t, step, fmi2True) > fmi2Warning) {
        fFreeInstance(c);
        exit(4);
    }
    must(fGetReal(c, &out, 1, &y) <= fmi2Warning, "output");
    return y;
}

int main(int argc, char **argv) {
    fmi2CallbackFunctions callbacks = {logger, calloc, free, NULL, NULL};
    double step = atof(argv[3]), *y;
    int i, n = atoi(argv[4]);
    fmi2ValueReference in = (unsigned)atoi(argv[5]), out = (unsigned)atoi(argv[6]);
    fmi2Component a, b;
    void *library = dlopen(argv[1], RTLD_NOW | RTLD_LOCAL);
    if (!library) return fprintf(stderr, "%s\n", dlerror()), 2;
#define GET(name) must((*(void **)&f##name = dlsym(library, "fmi2" #name)) != NULL, "fmi2" #name);
    FUNCTIONS(GET)
    settings = argc - 7;
    setting = argv + 7;
    a = fInstantiate("a", fmi2CoSimulation, argv[2], NULL, &callbacks, 0, 0);
    if (!a) return 5;
    b = fInstantiate("b", fmi2CoSimulation, argv[2], NULL, &callbacks, 0, 0);
    must(b != NULL, "second instance");
    begin(a);
    begin(b);
    y = calloc((size_t)n, sizeof *y);
    for (i = 0; i < n; i++) {
        y[i] = advance(a, i * step, step, in, out);
        if (i < n / 2) must(advance(b, i * step, step, in, out) == y[i], "side by side");
    }
    must(fReset(b) <= fmi2Warning, "reset");
    begin(b);
    for (i = 0; i < n; i++) must(advance(b, i * step, step, in, out) == y[i], "after reset");
    for (i = 0; i < n; i++) printf("%.17g\n", y[i]);
    fTerminate(a);
    fFreeInstance(a);
    fFreeInstance(b);
    free(y);
    return dlclose(library);
}
