/* FMI 2.0 co-simulation library that stands before the pythonfmu library.
 *
 * It finds a Python interpreter where the host has none, decodes the resource URI, keeps the host's logger
 * safe from missing categories and stray '%', and finalizes the interpreter before the library is torn down.
 * A handle, state or pointer that the inner library would follow into nothing is refused, with a line in the log.
 * shim_config.h (written by irj_fmu.fmi.package) gives INNER_LIBRARY, GUID, LIBPYTHON_CANDIDATES,
 * MODULES that the slave imports, and KINDS, one letter for the type of each value reference.
 */
#include <dlfcn.h>
#include <limits.h>
#include <link.h>
#include <fcntl.h>
#include <pthread.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>
#include <wchar.h>

#include "fmi2Functions.h"
#include "living.c"
#include "shim_config.h"

typedef enum { INSTANTIATED = 1, INITIALIZING, STEPPING, TERMINATED } Phase;

typedef struct {
    fmi2Component inner;
    fmi2CallbackFunctions host, mine;
    Phase phase;
    char *name;
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

extern char **environ;

/* What an interpreter says: the path or name of its libpython, then whether it has the modules. */
static const char question[] =
    "import importlib.util as u, os, sys, sysconfig as s\n"
    "n = s.get_config_var('INSTSONAME') or ''\n"
    "p = os.path.join(s.get_config_var('LIBDIR') or '', n)\n"
    "print(p if os.path.isfile(p) else n)\n"
    "print(all(map(u.find_spec, '" MODULES "'.split())))\n";

/* 2: it has the modules, 1: not all of them, 0: no answer; `library` gets PATH_MAX bytes */
static int ask(const char *python, char *library) {
    char *const command[] = {(char *)python, "-P", "-c", (char *)question, NULL};
    char answer[PATH_MAX + 32], *line;
    posix_spawn_file_actions_t actions;
    size_t length = 0;
    ssize_t got = 0;
    int ends[2], failed;
    pid_t child;
    if (pipe2(ends, O_CLOEXEC) != 0) return 0;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, ends[1], 1);
    posix_spawn_file_actions_addopen(&actions, 0, "/dev/null", O_RDONLY, 0);
    posix_spawn_file_actions_addopen(&actions, 2, "/dev/null", O_WRONLY, 0);
    failed = posix_spawnp(&child, python, &actions, NULL, command, environ);
    posix_spawn_file_actions_destroy(&actions);
    close(ends[1]);
    while (!failed && length < sizeof answer - 1 && (got = read(ends[0], answer + length, sizeof answer - 1 - length)) > 0) length += (size_t)got;
    close(ends[0]);
    if (failed) return 0;
    waitpid(child, NULL, 0); /* a host may have waited for it already: the answer is what counts */
    answer[length] = 0;
    line = strchr(answer, '\n');
    if (!line || line == answer || line - answer >= PATH_MAX) return 0;
    *line = 0;
    strcpy(library, answer);
    return strncmp(line + 1, "True", 4) == 0 ? 2 : 1;
}

/* the first line of resources/python.txt, an interpreter; empty without one */
static void read_side_file(const char *resources, char *python) {
    char name[PATH_MAX + 16];
    FILE *file;
    *python = 0;
    snprintf(name, sizeof name, "%s/python.txt", resources);
    if (!(file = fopen(name, "r"))) return;
    if (!fgets(python, PATH_MAX, file)) *python = 0;
    python[strcspn(python, "\r\n")] = 0;
    fclose(file);
}

static int loaded(void) { return set_home(), set_encoding(), 1; }

/* The interpreter that the user names, in IRJ_LIBPYTHON, IRJ_PYTHON or python.txt; else the first on PATH that has the
 * modules; else any libpython that the system's loader knows. */
static int find_python(const char *resources) {
    static const char *const candidates[] = {LIBPYTHON_CANDIDATES, NULL};
    static const char *const on_path[] = {"python3", "python", "python3.13", "python3.12", "python3.11"};
    const char *named = getenv("IRJ_LIBPYTHON"), *by = "IRJ_PYTHON", *python = getenv("IRJ_PYTHON");
    char library[PATH_MAX], noted[PATH_MAX];
    size_t i;
    if (dlsym(RTLD_DEFAULT, "Py_IsInitialized")) return 1;
    if (named && *named) {
        if (open_python(named)) return loaded();
        snprintf(problem, sizeof problem, "IRJ_LIBPYTHON=%s cannot be loaded (%s)", named, dlerror());
        return 0;
    }
    if (!python || !*python) {
        read_side_file(resources, noted);
        python = noted;
        by = "resources/python.txt";
    }
    if (*python) {
        if (!ask(python, library)) snprintf(problem, sizeof problem, "%s names %s, which is no Python 3.11 or newer", by, python);
        else if (open_python(library)) return loaded();
        else snprintf(problem, sizeof problem, "%s names %s, which has no shared library (%s)", by, python, library);
        return 0;
    }
    for (i = 0; i < sizeof on_path / sizeof *on_path; i++)
        if (ask(on_path[i], library) == 2 && open_python(library)) return loaded();
    for (i = 0; candidates[i]; i++)
        if (open_python(candidates[i])) return loaded();
    snprintf(problem, sizeof problem, "no Python with a shared library found; set IRJ_PYTHON to the path of a Python 3.11 or newer that has " MODULES);
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

static int prepare(const char *resources) {
    int done;
    pthread_mutex_lock(&lock);
    if (!ready) ready = find_python(resources) && open_inner();
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

static fmi2Status fail(Shim *shim, const char *format, ...) {
    char text[1200];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    forward_log(shim, shim->name, fmi2Error, "logStatusError", text);
    return fmi2Error;
}

static int is_folder(const char *path) {
    struct stat status;
    return stat(path, &status) == 0 && S_ISDIR(status.st_mode);
}

static void discard(Shim *shim) {
    if (shim) free(shim->name);
    free(shim);
}

FMI2_Export fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    Shim *shim = calloc(1, sizeof *shim);
    char *path = decoded(resources);
    if (shim && path && (shim->name = strdup(name ? name : ""))) {
        if (functions) shim->host = *functions;
        shim->mine = shim->host;
        shim->mine.logger = forward_log;
        shim->mine.componentEnvironment = shim;
        if (kind != fmi2CoSimulation) fail(shim, "instantiate: co-simulation only");
        else if (!guid || strcmp(guid, GUID) != 0) fail(shim, "instantiate: the GUID is not that of this library");
        else if (!is_folder(path)) fail(shim, "instantiate: there is no resources folder %s", *path ? path : "(no location given)");
        else if (!prepare(path)) forward_log(shim, shim->name, fmi2Fatal, "logStatusFatal", problem);
        else shim->inner = inner_Instantiate(shim->name, kind, guid, path, &shim->mine, visible, logging);
    }
    free(path);
    if (ready) end_before_libraries();
    if (shim && shim->inner && born(&instances, shim)) {
        shim->phase = INSTANTIATED;
        return shim;
    }
    if (shim && shim->inner) inner_FreeInstance(shim->inner);
    discard(shim);
    return NULL;
}

FMI2_Export void fmi2FreeInstance(fmi2Component c) {
    Shim *shim = c;
    if (!c) return;
    if (!dies(&instances, c)) {
        tell_stranger("fmi2FreeInstance");
        return;
    }
    end_before_libraries();
    if (shim->dead) return; /* freeing it again would crash; the rest is left to the end of the process */
    inner_FreeInstance(shim->inner);
    discard(shim);
}

static fmi2Status noted(Shim *shim, fmi2Status status) {
    shim->dead |= status == fmi2Fatal;
    return status;
}

#define LIVING(call) do { if (!is_alive(&instances, c)) { tell_stranger(call); return fmi2Error; } } while (0)
#define GIVEN(condition, call) do { if (!(condition)) return fail(c, "%s: a pointer is NULL", call); } while (0)
#define KNOWN(state, call) do { if (!is_alive(&states, state)) return fail(c, "%s: this is no state of this FMU, or it was freed", call); } while (0)
#define BETWEEN(first, last, call) do { \
    if (((Shim *)c)->phase < first || ((Shim *)c)->phase > last) return fail(c, "%s: called out of order", call); \
} while (0)
#define CALL(name, ...) (((Shim *)c)->dead ? fmi2Fatal : noted(c, inner_##name(((Shim *)c)->inner, ##__VA_ARGS__)))
#define FORWARD(name, parameters, condition, ...) \
    FMI2_Export fmi2Status fmi2##name parameters { \
        LIVING("fmi2" #name); \
        GIVEN(condition, #name); \
        return CALL(name, ##__VA_ARGS__); \
    }
/* every reference is there and of this kind; an exception in the slave would end the instance */
static fmi2Status matches(Shim *shim, const char *call, char kind, const fmi2ValueReference vr[], size_t n) {
    static const char kinds[] = KINDS;
    size_t i;
    for (i = 0; i < n; i++) {
        const char own = vr[i] < sizeof kinds - 1 ? kinds[vr[i]] : ' ';
        if (own == ' ') return fail(shim, "%s: there is no variable %u", call, vr[i]);
        if (own != kind) return fail(shim, "%s: variable %u is of another type", call, vr[i]);
    }
    return fmi2OK;
}

#define ACCESS(name, kind, parameters, condition) \
    FMI2_Export fmi2Status fmi2##name parameters { \
        LIVING("fmi2" #name); \
        GIVEN(condition, #name); \
        return matches(c, #name, kind, vr, n) == fmi2OK ? CALL(name, vr, n, value) : fmi2Error; \
    }
#define VARIABLES(type, kind) \
    ACCESS(Get##type, kind, (fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##type value[]), n == 0 || (vr && value)) \
    ACCESS(Set##type, kind, (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##type value[]), n == 0 || (vr && value)) \
    FORWARD(Get##type##Status, (fmi2Component c, const fmi2StatusKind what, fmi2##type *value), value, what, value)
VARIABLES(Real, 'R')
VARIABLES(Integer, 'I')
VARIABLES(Boolean, 'B')

/* the inner library reads each text */
static int all_given(size_t n, const fmi2String value[]) {
    size_t i;
    for (i = 0; value && i < n; i++)
        if (!value[i]) return 0;
    return n == 0 || value;
}

ACCESS(GetString, 'S', (fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]), n == 0 || (vr && value))
ACCESS(SetString, 'S', (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]), n == 0 || (vr && all_given(n, value)))
FORWARD(GetStringStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2String *value), value, kind, value)
FORWARD(GetStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Status *value), value, kind, value)
FORWARD(SetDebugLogging, (fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]), all_given(n, categories), on, n, categories)
FORWARD(GetDirectionalDerivative, (fmi2Component c, const fmi2ValueReference u[], size_t nu, const fmi2ValueReference k[], size_t nk,
        const fmi2Real dk[], fmi2Real du[]), (nu == 0 || (u && du)) && (nk == 0 || (k && dk)), u, nu, k, nk, dk, du)
FORWARD(SetRealInputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]),
        n == 0 || (vr && order && value), vr, n, order, value)
FORWARD(GetRealOutputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], fmi2Real value[]),
        n == 0 || (vr && order && value), vr, n, order, value)

FMI2_Export fmi2Status fmi2CancelStep(fmi2Component c) {
    LIVING("fmi2CancelStep");
    return fail(c, "cancelStep: doStep is never pending");
}

/* ---- life cycle -------------------------------------------------------------------- */

static fmi2Status reached(Shim *shim, Phase phase, fmi2Status status) {
    if (status <= fmi2Warning) shim->phase = phase;
    return status;
}

FMI2_Export fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    LIVING("fmi2SetupExperiment");
    BETWEEN(INSTANTIATED, INSTANTIATED, "setupExperiment");
    return CALL(SetupExperiment, has_tolerance, tolerance, start, has_stop, stop);
}

FMI2_Export fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    LIVING("fmi2EnterInitializationMode");
    BETWEEN(INSTANTIATED, INSTANTIATED, "enterInitializationMode");
    return reached(c, INITIALIZING, CALL(EnterInitializationMode));
}

FMI2_Export fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    LIVING("fmi2ExitInitializationMode");
    BETWEEN(INITIALIZING, INITIALIZING, "exitInitializationMode");
    return reached(c, STEPPING, CALL(ExitInitializationMode));
}

FMI2_Export fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_rollback) {
    LIVING("fmi2DoStep");
    BETWEEN(STEPPING, STEPPING, "doStep");
    return CALL(DoStep, t, h, no_rollback);
}

FMI2_Export fmi2Status fmi2Terminate(fmi2Component c) {
    LIVING("fmi2Terminate");
    BETWEEN(STEPPING, STEPPING, "terminate");
    end_before_libraries();
    return reached(c, TERMINATED, CALL(Terminate));
}

FMI2_Export fmi2Status fmi2Reset(fmi2Component c) {
    LIVING("fmi2Reset");
    return reached(c, INSTANTIATED, CALL(Reset));
}

/* ---- FMU state: its bytes are those of the inner library, the phase and a checksum ---- */

typedef struct { /* the inner state and the phase that goes with it */
    fmi2FMUstate inner;
    Phase phase;
} State;

#define TRAILER 5

/* FNV-1a of the GUID and the bytes: what is damaged, or of another FMU, is refused before Python reads it */
static unsigned checksum(const fmi2Byte bytes[], size_t size) {
    const char *g;
    unsigned sum = 2166136261u;
    size_t i;
    for (g = GUID; *g; g++) sum = (sum ^ (unsigned char)*g) * 16777619u;
    for (i = 0; i < size; i++) sum = (sum ^ (unsigned char)bytes[i]) * 16777619u;
    return sum;
}

static void drop(Shim *c, State *state) {
    if (!dies(&states, state)) return;
    if (state->inner) CALL(FreeFMUstate, &state->inner);
    free(state);
}

/* a state that is passed in for re-use is released: the inner library would lose it */
static fmi2Status kept(Shim *c, fmi2FMUstate *state, fmi2FMUstate inner, Phase phase, fmi2Status status) {
    State *made;
    if (status > fmi2Warning) return status;
    drop(c, *state);
    *state = NULL;
    made = malloc(sizeof *made);
    if (!made || !born(&states, made)) {
        free(made);
        CALL(FreeFMUstate, &inner);
        return fail(c, "the FMU state: out of memory");
    }
    made->inner = inner;
    made->phase = phase;
    *state = made;
    return status;
}

FMI2_Export fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    fmi2FMUstate inner = NULL;
    fmi2Status status;
    LIVING("fmi2GetFMUstate");
    GIVEN(state, "getFMUstate");
    status = CALL(GetFMUstate, &inner);
    return kept(c, state, inner, ((Shim *)c)->phase, status);
}

FMI2_Export fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    LIVING("fmi2SetFMUstate");
    KNOWN(state, "setFMUstate");
    return reached(c, ((State *)state)->phase, CALL(SetFMUstate, ((State *)state)->inner));
}

FMI2_Export fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    LIVING("fmi2FreeFMUstate");
    if (!state || !*state) return fmi2OK;
    KNOWN(*state, "freeFMUstate");
    drop(c, *state);
    *state = NULL;
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    fmi2Status status;
    LIVING("fmi2SerializedFMUstateSize");
    KNOWN(state, "serializedFMUstateSize");
    GIVEN(size, "serializedFMUstateSize");
    status = CALL(SerializedFMUstateSize, ((State *)state)->inner, size);
    *size += TRAILER;
    return status;
}

FMI2_Export fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    size_t needed = 0;
    unsigned sum;
    int i;
    fmi2Status status;
    LIVING("fmi2SerializeFMUstate");
    KNOWN(state, "serializeFMUstate");
    GIVEN(bytes, "serializeFMUstate");
    status = CALL(SerializedFMUstateSize, ((State *)state)->inner, &needed);
    if (status > fmi2Warning) return status;
    if (size < needed + TRAILER) return fail(c, "serializeFMUstate: %lu bytes are too few", (unsigned long)size);
    status = CALL(SerializeFMUstate, ((State *)state)->inner, bytes, needed);
    if (status > fmi2Warning) return status;
    bytes[needed] = (fmi2Byte)((State *)state)->phase;
    sum = checksum(bytes, needed + 1);
    for (i = 0; i < 4; i++) bytes[needed + 1 + i] = (fmi2Byte)(sum >> 8 * i);
    return status;
}

FMI2_Export fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    fmi2FMUstate inner = NULL;
    fmi2Status status;
    unsigned sum = 0;
    int i;
    LIVING("fmi2DeSerializeFMUstate");
    GIVEN(bytes && state, "deSerializeFMUstate");
    if (size <= TRAILER) return fail(c, "deSerializeFMUstate: these bytes are not a state of this FMU");
    size -= TRAILER;
    for (i = 0; i < 4; i++) sum |= (unsigned)(unsigned char)bytes[size + 1 + i] << 8 * i;
    if (sum != checksum(bytes, size + 1)) return fail(c, "deSerializeFMUstate: these bytes are not a state of this FMU, or were damaged");
    status = CALL(DeSerializeFMUstate, bytes, size, &inner);
    return kept(c, state, inner, (Phase)bytes[size], status);
}
