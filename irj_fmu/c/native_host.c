/* A C host that replays readings through a native estimator and tells what a step costs.
 *
 *   native_host LIBRARY GUID READINGS RESULTS STEP IN,IN,... OUT,OUT,...
 *
 * READINGS: rows of doubles, one for each of IN (value references of reals). RESULTS: rows of doubles, one for each of
 * OUT, after each step. The record runs twice: the first pass gives the processor time per set + step + get, the second
 * that of the longest one.
 */
#ifdef _WIN32
#include <windows.h>
#else
#include <dlfcn.h>
#include <time.h>
#endif
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"

#define MOST 256

#ifdef _WIN32
static void *open_library(const char *path) { return (void *)LoadLibraryA(path); }
static void *find(void *library, const char *name) { return (void *)GetProcAddress((HMODULE)library, name); }
static double now(void) {
    LARGE_INTEGER count, rate;
    QueryPerformanceCounter(&count);
    QueryPerformanceFrequency(&rate);
    return 1e9 * (double)count.QuadPart / (double)rate.QuadPart;
}
#define single now /* the processor time of a process is too coarse for one step */
static double used(void) {
    FILETIME begun, ended, kernel, user;
    GetProcessTimes(GetCurrentProcess(), &begun, &ended, &kernel, &user);
    return 100.0 * ((double)user.dwHighDateTime * 4294967296.0 + (double)user.dwLowDateTime);
}
#else
static void *open_library(const char *path) { return dlopen(path, RTLD_NOW | RTLD_LOCAL); }
static void *find(void *library, const char *name) { return dlsym(library, name); }
static double clock_of(clockid_t which) {
    struct timespec t;
    clock_gettime(which, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}
static double used(void) { return clock_of(CLOCK_PROCESS_CPUTIME_ID); }
#define single used
#endif

static void logger(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    va_list values;
    (void)e;
    va_start(values, message);
    fprintf(stderr, "%s [%d] %s: ", name, (int)status, category);
    vfprintf(stderr, message, values);
    fprintf(stderr, "\n");
    va_end(values);
}

static size_t references(char *text, fmi2ValueReference out[MOST]) {
    size_t n = 0;
    char *word;
    for (word = strtok(text, ","); word && n < MOST; word = strtok(NULL, ",")) out[n++] = (fmi2ValueReference)strtoul(word, NULL, 10);
    return n;
}

static double *load(const char *path, size_t width, long *rows) {
    FILE *file = fopen(path, "rb");
    double *found = NULL;
    long size;
    if (!file) return NULL;
    fseek(file, 0, SEEK_END);
    size = ftell(file);
    rewind(file);
    *rows = size / (long)(width * sizeof(double));
    found = malloc((size_t)size + 1);
    if (found && fread(found, 1, (size_t)size, file) != (size_t)size) found = NULL;
    fclose(file);
    return found;
}

#define GET(name) \
    fmi2##name##TYPE *f##name = (fmi2##name##TYPE *)find(library, "fmi2" #name); \
    if (!f##name) { fprintf(stderr, "no fmi2" #name "\n"); return 3; }

int main(int argc, char **argv) {
    fmi2CallbackFunctions callbacks = {logger, calloc, free, NULL, NULL};
    fmi2ValueReference in[MOST], out[MOST];
    double *readings, *results, h, total = 0, longest = 0;
    size_t n_in, n_out;
    long rows, k;
    int pass;
    FILE *file;
    void *library;
    if (argc != 8) { fprintf(stderr, "native_host LIBRARY GUID READINGS RESULTS STEP IN,... OUT,...\n"); return 2; }
    library = open_library(argv[1]);
    if (!library) { fprintf(stderr, "%s cannot be loaded\n", argv[1]); return 2; }
    h = atof(argv[5]);
    n_in = references(argv[6], in);
    n_out = references(argv[7], out);
    readings = load(argv[3], n_in, &rows);
    file = fopen(argv[4], "wb");
    if (!readings || !file) { fprintf(stderr, "%s or %s cannot be opened\n", argv[3], argv[4]); return 2; }
    results = malloc((size_t)rows * n_out * sizeof(double) + 1);
    if (!results) return 2;
    GET(Instantiate) GET(FreeInstance) GET(SetupExperiment) GET(EnterInitializationMode) GET(ExitInitializationMode)
    GET(SetReal) GET(GetReal) GET(DoStep) GET(Terminate)
    for (pass = 0; pass < 2; pass++) {
        fmi2Component c = fInstantiate("host", fmi2CoSimulation, argv[2], "", &callbacks, fmi2False, !pass);
        double began;
        if (!c) return 4;
        fSetupExperiment(c, fmi2False, 0, 0, fmi2False, 0);
        if (fEnterInitializationMode(c) != fmi2OK || fExitInitializationMode(c) != fmi2OK) return 5;
        began = used();
        for (k = 0; k < rows; k++) {
            const double a = pass ? single() : 0;
            if (fSetReal(c, in, n_in, readings + (size_t)k * n_in) != fmi2OK || fDoStep(c, k * h, h, fmi2True) != fmi2OK
                || fGetReal(c, out, n_out, results + (size_t)k * n_out) != fmi2OK) return 6;
            if (pass) {
                const double took = single() - a;
                if (took > longest) longest = took;
            }
        }
        if (!pass) total = used() - began;
        fTerminate(c);
        fFreeInstance(c);
    }
    fwrite(results, sizeof(double), (size_t)rows * n_out, file);
    fclose(file);
    printf("%ld steps, %.0f ns per set + step + get, longest %.0f ns\n", rows, total / rows, longest);
    free(readings);
    free(results);
    return 0;
}
