/* FMI 2.0 co-simulation library that stands before the pythonfmu library.
 *
 * It finds a Python interpreter where the host has none, decodes the resource URI, keeps the host's logger
 * safe from missing categories and stray '%', and finalizes the interpreter before the library is torn down.
 * shim_config.h (written by irj_fmu.fmi.package) gives INNER_LIBRARY and LIBPYTHON_CANDIDATES.
 */
#include <dlfcn.h>
#include <limits.h>
#include <link.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include <wchar.h>

#include "fmi2Functions.h"
#include "shim_config.h"

typedef struct {
    fmi2Component inner;
    fmi2CallbackFunctions host, mine;
    int dead; /* after fmi2Fatal the inner library has freed parts of the instance */
} Shim;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int ready;
static char problem[1024];

/* ---- the inner library's functions ---------------------------------------- */

#define FUNCTIONS(X) \
    X(Instantiate) X(FreeInstance) X(SetDebugLogging) X(SetupExperiment) X(EnterInitializationMode) \
    X(ExitInitializationMode) X(Terminate) X(Reset) X(GetReal) X(GetInteger) X(GetBoolean) X(GetString) X(SetReal) \
    X(SetInteger) X(SetBoolean) X(SetString) X(GetFMUstate) X(SetFMUstate) X(FreeFMUstate) X(SerializedFMUstateSize) \
    X(SerializeFMUstate) X(DeSerializeFMUstate) X(GetDirectionalDerivative) X(SetRealInputDerivatives) \
    X(GetRealOutputDerivatives) X(DoStep) X(CancelStep) X(GetStatus) X(GetRealStatus) X(GetIntegerStatus) \
    X(GetBooleanStatus) X(GetStringStatus)
#define DECLARE(name) static fmi2##name##TYPE *inner_##name;
FUNCTIONS(DECLARE)

/* ---- Python ------------------------------------------------------------------ */

static int open_python(const char *path) { return path && *path && dlopen(path, RTLD_NOW | RTLD_GLOBAL | RTLD_NODELETE) != NULL; }

/* Embedded Python looks for its library beside the first python3 of PATH, which may be another installation: name the
 * folder that this libpython belongs to. PYTHONHOME goes first; a libpython outside the usual layout is left alone. */
static void set_home(void) {
    static wchar_t home[4096];
    const char *(*version)(void);
    void (*set)(const wchar_t *);
    char path[PATH_MAX], probe[PATH_MAX + 64], *slash;
    const unsigned char *from;
    wchar_t *to = home;
    Dl_info info;
    int major, minor;
    *(void **)&version = dlsym(RTLD_DEFAULT, "Py_GetVersion");
    *(void **)&set = dlsym(RTLD_DEFAULT, "Py_SetPythonHome");
    if (!version || !set || (getenv("PYTHONHOME") && *getenv("PYTHONHOME")) || sscanf(version(), "%d.%d", &major, &minor) != 2) return;
    if (!dladdr(*(void **)&version, &info) || !info.dli_fname || !realpath(info.dli_fname, path)) return;
    do {
        if (!(slash = strrchr(path, '/')) || slash == path) return;
        *slash = 0;
        snprintf(probe, sizeof probe, "%s/lib/python%d.%d/os.py", path, major, minor);
    } while (access(probe, R_OK) != 0);
    for (from = (const unsigned char *)path; *from && to < home + 4095; to++) { /* UTF-8 */
        int more = *from >= 0xF0 ? 3 : *from >= 0xE0 ? 2 : *from >= 0xC0 ? 1 : 0;
        *to = more ? *from & (0x3F >> more) : *from;
        for (from++; more && (*from & 0xC0) == 0x80; more--) *to = (*to << 6) | (*from++ & 0x3F);
    }
    *to = 0;
    set(home);
}

/* a host without a locale would give Python ASCII for file names */
static void set_encoding(void) {
    int *utf8 = (int *)dlsym(RTLD_DEFAULT, "Py_UTF8Mode");
    if (utf8 && !getenv("PYTHONUTF8")) *utf8 = 1;
}

static int find_python(void) {
    static const char *const candidates[] = {LIBPYTHON_CANDIDATES, NULL};
    const char *named = getenv("IRJ_LIBPYTHON");
    int i;
    if (dlsym(RTLD_DEFAULT, "Py_IsInitialized")) return 1;
    if (named && *named) {
        if (open_python(named)) return set_home(), set_encoding(), 1;
        snprintf(problem, sizeof problem, "IRJ_LIBPYTHON=%s cannot be loaded (%s)", named, dlerror());
        return 0;
    }
    for (i = 0; candidates[i]; i++)
        if (open_python(candidates[i])) return set_home(), set_encoding(), 1;
    snprintf(problem, sizeof problem, "no libpython found; set IRJ_LIBPYTHON to the path of libpython3.x.so");
    return 0;
}

/* The interpreter must end before the static objects of the libraries its modules have loaded; what is registered
 * last is called first, so the end is registered again whenever libraries have come since. */
static void (*finalizer)(void);

static void end_python(void) {
    void (*end)(void) = finalizer;
    finalizer = NULL;
    if (end) end();
}

static int count_libraries(struct dl_phdr_info *info, size_t size, void *count) {
    (void)size;
    *(unsigned long long *)count = info->dlpi_adds;
    return 1;
}

static void end_before_libraries(void) {
    static unsigned long long known;
    unsigned long long now = 0;
    pthread_mutex_lock(&lock);
    dl_iterate_phdr(count_libraries, &now);
    if (finalizer && now != known && atexit(end_python) == 0) known = now;
    pthread_mutex_unlock(&lock);
}

static int open_inner(void) {
    char path[4096];
    Dl_info info;
    void *library;
    const char *slash;
    if (!dladdr((void *)&open_inner, &info) || !info.dli_fname) return 0;
    slash = strrchr(info.dli_fname, '/');
    snprintf(path, sizeof path, "%.*s" INNER_LIBRARY, slash ? (int)(slash - info.dli_fname + 1) : 0, info.dli_fname);
    dlopen(info.dli_fname, RTLD_NOW | RTLD_NODELETE); /* atexit and callbacks point into this library */
    library = dlopen(path, RTLD_NOW | RTLD_LOCAL | RTLD_NODELETE);
    if (!library) {
        snprintf(problem, sizeof problem, "%s", dlerror());
        return 0;
    }
#define RESOLVE(name) \
    if (!(*(void **)&inner_##name = dlsym(library, "fmi2" #name))) { \
        snprintf(problem, sizeof problem, "fmi2" #name " is missing in " INNER_LIBRARY); \
        return 0; \
    }
    FUNCTIONS(RESOLVE)
    *(void **)&finalizer = dlsym(library, "finalizePythonInterpreter");
    return 1;
}

static int prepare(void) {
    int done;
    pthread_mutex_lock(&lock);
    if (!ready) ready = find_python() && open_inner();
    done = ready;
    pthread_mutex_unlock(&lock);
    return done;
}

/* ---- resource URI --------------------------------------------------------------- */

static int hex(char c) {
    if (c >= '0' && c <= '9') return c - '0';
    if (c >= 'a' && c <= 'f') return c - 'a' + 10;
    if (c >= 'A' && c <= 'F') return c - 'A' + 10;
    return -1;
}

/* "file:///a%20b", "file:/a b", "file://localhost/a" or a plain path to a plain path; caller frees */
static char *decoded(const char *uri) {
    struct stat status;
    const char *from = uri ? uri : "";
    char *path, *to;
    if (strncmp(from, "file://", 7) == 0) {
        from += 7;
        if (*from != '/' && strchr(from, '/')) from = strchr(from, '/');
    } else if (strncmp(from, "file:", 5) == 0) from += 5;
    path = to = malloc(strlen(from) + 1);
    if (!path) return NULL;
    if (stat(from, &status) == 0) return strcpy(path, from); /* a host that does not encode */
    while (*from) {
        if (*from == '%' && hex(from[1]) >= 0 && hex(from[2]) >= 0) {
            *to++ = (char)(16 * hex(from[1]) + hex(from[2]));
            from += 3;
        } else *to++ = *from++;
    }
    *to = 0;
    return path;
}

/* ---- logger ----------------------------------------------------------------------- */

static void forward_log(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    Shim *shim = environment;
    static const char *const names[] = {"logAll", "logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal", "logAll"};
    const char *from;
    char *copy, *to;
    if (!shim->host.logger) return;
    if (!category || !*category) category = status >= fmi2OK && status <= fmi2Pending ? names[status] : "logAll";
    /* hosts print the text as a format; those in Python see it alone, so "%s" would hide the message from them */
    copy = malloc(2 * strlen(message ? message : "") + 1);
    if (!copy) return;
    for (from = message ? message : "", to = copy; *from; from++) {
        if (*from == '%') *to++ = '%';
        *to++ = *from;
    }
    *to = 0;
    shim->host.logger(shim->host.componentEnvironment, name, status, category, copy);
    free(copy);
}

/* ---- FMI --------------------------------------------------------------------------- */

FMI2_Export const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
FMI2_Export const char *fmi2GetVersion(void) { return fmi2Version; }

FMI2_Export fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    Shim *shim = calloc(1, sizeof *shim);
    char *path = decoded(resources);
    if (shim && path) {
        if (functions) shim->host = *functions;
        shim->mine = shim->host;
        shim->mine.logger = forward_log;
        shim->mine.componentEnvironment = shim;
        if (prepare()) shim->inner = inner_Instantiate(name, kind, guid, path, &shim->mine, visible, logging);
        else forward_log(shim, name, fmi2Fatal, "logStatusFatal", problem);
    }
    free(path);
    end_before_libraries();
    if (shim && shim->inner) return shim;
    free(shim);
    return NULL;
}

FMI2_Export void fmi2FreeInstance(fmi2Component c) {
    if (!c) return;
    end_before_libraries();
    if (((Shim *)c)->dead) return; /* freeing it again would crash; the rest is left to the end of the process */
    inner_FreeInstance(((Shim *)c)->inner);
    free(c);
}

static fmi2Status noted(Shim *shim, fmi2Status status) {
    shim->dead |= status == fmi2Fatal;
    return status;
}

#define CALL(name, ...) (((Shim *)c)->dead ? fmi2Fatal : noted(c, inner_##name(((Shim *)c)->inner, ##__VA_ARGS__)))
#define FORWARD(name, parameters, ...) \
    FMI2_Export fmi2Status fmi2##name parameters { return CALL(name, ##__VA_ARGS__); }
#define VARIABLES(type) \
    FORWARD(Get##type, (fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##type value[]), vr, n, value) \
    FORWARD(Set##type, (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##type value[]), vr, n, value) \
    FORWARD(Get##type##Status, (fmi2Component c, const fmi2StatusKind kind, fmi2##type *value), kind, value)
VARIABLES(Real)
VARIABLES(Integer)
VARIABLES(Boolean)
VARIABLES(String)
FORWARD(GetStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Status *value), kind, value)
FORWARD(SetDebugLogging, (fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]), on, n, categories)
FORWARD(SetupExperiment, (fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop),
        has_tolerance, tolerance, start, has_stop, stop)
FORWARD(EnterInitializationMode, (fmi2Component c))
FORWARD(ExitInitializationMode, (fmi2Component c))
FORWARD(Reset, (fmi2Component c))
FORWARD(SetFMUstate, (fmi2Component c, fmi2FMUstate state), state)
FORWARD(SerializedFMUstateSize, (fmi2Component c, fmi2FMUstate state, size_t *size), state, size)
FORWARD(SerializeFMUstate, (fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size), state, bytes, size)
FORWARD(GetDirectionalDerivative, (fmi2Component c, const fmi2ValueReference u[], size_t nu, const fmi2ValueReference k[], size_t nk,
        const fmi2Real dk[], fmi2Real du[]), u, nu, k, nk, dk, du)
FORWARD(SetRealInputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]), vr, n, order, value)
FORWARD(GetRealOutputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], fmi2Real value[]), vr, n, order, value)
FORWARD(DoStep, (fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_rollback), t, h, no_rollback)
FORWARD(CancelStep, (fmi2Component c))

FMI2_Export fmi2Status fmi2Terminate(fmi2Component c) {
    end_before_libraries();
    return CALL(Terminate);
}

FMI2_Export fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    fmi2Status status = fmi2OK;
    if (state && *state) {
        status = CALL(FreeFMUstate, state);
        *state = NULL;
    }
    return status;
}

/* a state that is passed in for re-use is released first: the inner library would lose it */
FMI2_Export fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    fmi2FreeFMUstate(c, state);
    return CALL(GetFMUstate, state);
}

FMI2_Export fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    fmi2FreeFMUstate(c, state);
    return CALL(DeSerializeFMUstate, bytes, size, state);
}
