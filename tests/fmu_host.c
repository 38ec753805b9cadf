/* A C host for slave FMUs: fmu_host LIBRARY URI GUID CYCLES STEPS H VR_U VR_Y VR_OUT
 * Each cycle instantiates, runs with u = sin(0.3 i), y = 2 u + 0.5 + 0.1 cos(i), and frees.
 * The last cycle prints the output after each step. */
#include <dlfcn.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

static void logger(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    va_list values;
    (void)e;
    va_start(values, message);
    fprintf(stderr, "%s [%d] %lu ", name, status, (unsigned long)strlen(category));
    vfprintf(stderr, message, values);
    fprintf(stderr, "\n");
    va_end(values);
}

#define GET(name) \
    fmi2##name##TYPE *f##name = (fmi2##name##TYPE *)dlsym(library, "fmi2" #name); \
    if (!f##name) { fprintf(stderr, "no fmi2" #name "\n"); return 3; }

int main(int argc, char **argv) {
    fmi2CallbackFunctions callbacks = {logger, calloc, free, NULL, NULL};
    int cycle, i, cycles = atoi(argv[4]), steps = atoi(argv[5]);
    double h = atof(argv[6]);
    fmi2ValueReference in[2] = {(unsigned)atoi(argv[7]), (unsigned)atoi(argv[8])}, out = (unsigned)atoi(argv[9]);
    void *library = dlopen(argv[1], RTLD_NOW | RTLD_LOCAL);
    (void)argc;
    if (!library) { fprintf(stderr, "%s\n", dlerror()); return 2; }
    GET(Instantiate) GET(FreeInstance) GET(SetupExperiment) GET(EnterInitializationMode) GET(ExitInitializationMode)
    GET(SetReal) GET(GetReal) GET(DoStep) GET(Terminate)
    for (cycle = 0; cycle < cycles; cycle++) {
        fmi2Component c = fInstantiate("host", fmi2CoSimulation, argv[3], argv[2], &callbacks, fmi2False, fmi2True);
        if (!c) return 4;
        fSetupExperiment(c, fmi2False, 0, 0, fmi2False, 0);
        if (fEnterInitializationMode(c) != fmi2OK || fExitInitializationMode(c) != fmi2OK) return 5;
        for (i = 0; i < steps; i++) {
            double u[2], y;
            u[0] = sin(0.3 * i);
            u[1] = 2 * u[0] + 0.5 + 0.1 * cos((double)i);
            if (fSetReal(c, in, 2, u) != fmi2OK || fDoStep(c, i * h, h, fmi2True) != fmi2OK || fGetReal(c, &out, 1, &y) != fmi2OK) return 6;
            if (cycle == cycles - 1) printf("%.17g\n", y);
        }
        fTerminate(c);
        fFreeInstance(c);
    }
    dlclose(library);
    return 0;
}
