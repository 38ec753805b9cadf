/* FMI 2.0 co-simulation library round another FMU, whose drive it corrects by a law in generated C.
 *
 * The other FMU lies unpacked in resources/inner, found from where this library lies. Every call is passed on; the
 * correction is read from position and velocity of the inner FMU and held until it is read again.
 *
 * corrected_config.h (written by irj_fmu.corrected.build) gives
 *   CORRECTED_GUID, INNER_GUID, INNER_LIBRARY (below resources/inner), INNER_STATES and INNER_BYTES (what it can do with its state);
 *   NS, NP, NF: lengths of the law's state, of its parameters, and of those that can be set (free_p, their places);
 *   VR_LAW: value reference of the first of these; then come the time between two readings and what is added;
 *   VR_DRIVE, VR_READ (position, velocity), PER_DRIVE, PER_POSITION, PER_RATE: link-referred value per unit of the FMU;
 *   start_p, DRIVE_START, HOLD; start_real, start_integer, start_boolean: fitted values for the inner FMU;
 *   known_real, known_integer, known_boolean, known_string: its value references, ascending.
 * corrected_law.c (written by CasADi): law(state, reading, parameters) -> (torque, state).
 */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "corrected_config.h"

#ifdef _WIN32
#include <windows.h>
#define LONGEST_PATH 32768
#else
#include <dlfcn.h>
#include <limits.h>
#define LONGEST_PATH PATH_MAX
#ifndef RTLD_DEEPBIND /* its names are looked up in itself first: both libraries have the same */
#define RTLD_DEEPBIND 0
#endif
#endif

#define CASADI_SYMBOL_EXPORT static
#include "corrected_law.c"

#define DIM(n) ((n) > 0 ? (n) : 1)
#define MAX_SUBSTEPS 2000000L

enum { VR_HOLD = VR_LAW + NF, VR_ADDED, VR_END };

typedef enum { INSTANTIATED = 1, INITIALIZING, STEPPING, TERMINATED } Phase;

typedef struct { /* what changes on this side; the inner FMU has the rest */
    char guid[40];
    Phase phase;
    double t, hold, drive, added;
    double law[NS], p[DIM(NP)];
} State;

typedef struct {
    State s;
    fmi2CallbackFunctions host;
    char *name;
    int logging, loaded, dead; /* dead: after fmi2Fatal nothing may be called any more */
    unsigned long serial;
    fmi2Component inner;
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double w[DIM(SZ_W)];
    casadi_int iw[DIM(SZ_IW)];
} Corrected;

static fmi2Status fail(Corrected *m, const char *format, ...) {
    char text[1024], safe[2 * sizeof text], *to = safe;
    const char *from;
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    for (from = text; *from; *to++ = *from++) /* a host may take the message for a format */
        if (*from == '%') *to++ = '%';
    *to = 0;
    m->host.logger(m->host.componentEnvironment, m->name, fmi2Error, "logStatusError", safe);
    return fmi2Error;
}

typedef Corrected Instance;
#define PASSES_ON
#define GUID CORRECTED_GUID
#include "fmi2_common.c"

/* ---- the inner FMU -------------------------------------------------------- */

#define NEEDED(X) \
    X(Instantiate) X(FreeInstance) X(SetupExperiment) X(EnterInitializationMode) X(ExitInitializationMode) \
    X(Terminate) X(Reset) X(GetReal) X(SetReal) X(DoStep)
#define USEFUL(X) \
    X(SetDebugLogging) X(GetInteger) X(GetBoolean) X(GetString) X(SetInteger) X(SetBoolean) X(SetString) \
    X(GetFMUstate) X(SetFMUstate) X(FreeFMUstate) X(SerializedFMUstateSize) X(SerializeFMUstate) X(DeSerializeFMUstate)
#define DECLARE(name) static fmi2##name##TYPE *inner_##name;
NEEDED(DECLARE)
USEFUL(DECLARE)

static char lock; /* over what follows */
static unsigned long users;
static void *library;
static void (*finalizer)(void);
static char place[3 * LONGEST_PATH + 16], problem[512]; /* place: resources of the inner FMU, as a URI */

static void acquire(void) { while (__atomic_test_and_set(&lock, __ATOMIC_ACQUIRE)) {} }
static void release(void) { __atomic_clear(&lock, __ATOMIC_RELEASE); }

#ifdef _WIN32
static void *symbol(const char *name) { return (void *)GetProcAddress((HMODULE)library, name); }
static void close_library(void) { FreeLibrary((HMODULE)library); }

static int own_path(char *path) { /* UTF-8, with slashes */
    static wchar_t wide[LONGEST_PATH];
    HMODULE own;
    DWORD n;
    if (!GetModuleHandleExW(GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS | GET_MODULE_HANDLE_EX_FLAG_UNCHANGED_REFCOUNT, (LPCWSTR)&own_path, &own)) return 0;
    n = GetModuleFileNameW(own, wide, LONGEST_PATH);
    if (!n || n >= LONGEST_PATH || !WideCharToMultiByte(CP_UTF8, 0, wide, -1, path, LONGEST_PATH, NULL, NULL)) return 0;
    for (; *path; path++)
        if (*path == '\\') *path = '/';
    return 1;
}

static int open_library(char *path) {
    static wchar_t wide[LONGEST_PATH];
    char *c;
    for (c = path; *c; c++)
        if (*c == '/') *c = '\\';
    library = MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, LONGEST_PATH) ? (void *)LoadLibraryExW(wide, NULL, LOAD_WITH_ALTERED_SEARCH_PATH) : NULL;
    if (!library) snprintf(problem, sizeof problem, "Windows refuses %s with error %lu", INNER_LIBRARY, (unsigned long)GetLastError());
    return library != NULL;
}
#else
static void *symbol(const char *name) { return dlsym(library, name); }
static void close_library(void) { dlclose(library); }

static int own_path(char *path) {
    Dl_info info;
    return dladdr((void *)&own_path, &info) && info.dli_fname && realpath(info.dli_fname, path);
}

static int open_library(char *path) {
    library = dlopen(path, RTLD_NOW | RTLD_LOCAL | RTLD_DEEPBIND);
    if (!library) snprintf(problem, sizeof problem, "%s", dlerror());
    return library != NULL;
}
#endif

/* percent-encoded: some FMUs follow nothing else */
static void note_place(const char *folder) {
    static const char plain[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-._~/:";
    char *to = place + sprintf(place, *folder == '/' ? "file://" : "file:///");
    for (; *folder; folder++)
        if (strchr(plain, *folder)) *to++ = *folder;
        else to += sprintf(to, "%%%02X", (unsigned char)*folder);
    strcpy(to, "/resources");
}

static int load(void) {
    static char path[LONGEST_PATH + 1], whole[LONGEST_PATH + sizeof INNER_LIBRARY + 32];
    char *slash;
    int i;
    if (!own_path(path)) {
        snprintf(problem, sizeof problem, "the folder of this library is not known");
        return 0;
    }
    for (i = 0; i < 3; i++) /* binaries/PLATFORM/library */
        if ((slash = strrchr(path, '/'))) *slash = 0;
    snprintf(whole, sizeof whole, "%s/resources/inner", path);
    note_place(whole);
    strcat(whole, "/" INNER_LIBRARY);
    if (!open_library(whole)) return 0;
#define RESOLVE(name) *(void **)&inner_##name = symbol("fmi2" #name);
    NEEDED(RESOLVE)
    USEFUL(RESOLVE)
#define MUST(name) if (!inner_##name) { snprintf(problem, sizeof problem, "it lacks fmi2" #name); close_library(); library = NULL; return 0; }
    NEEDED(MUST)
    *(void **)&finalizer = symbol("finalizePythonInterpreter");
    return 1;
}

static int enter(void) { /* one more instance */
    int fine;
    acquire();
    fine = library || load();
    users += fine;
    release();
    return fine;
}

static void leave(void) { /* one less; without any the library goes, so that its files can be deleted */
    acquire();
    if (--users == 0) {
        if (finalizer) finalizer(); /* it would be late at exit; such a library stays mapped anyway */
        else {
            close_library();
            library = NULL;
        }
    }
    release();
}

/* ---- what the inner FMU answers ------------------------------------------- */

static fmi2Status answered(Corrected *m, fmi2Status status, const char *call) {
    if (status <= fmi2Warning) return status;
    fail(m, "%s: the inner FMU answers with status %d (3 is an error)", call, (int)status);
    if (status == fmi2Fatal) m->dead = 1;
    return status == fmi2Fatal ? fmi2Fatal : fmi2Error;
}

/* alive, and the inner FMU may be called */
#define USABLE(call) \
    LIVING("fmi2" call); \
    Corrected *m = c; \
    if (m->dead) return fail(m, call ": the inner FMU has met a fatal error; free the instance")

#define HAS(name, call) if (!inner_##name) return fail(m, call ": the inner FMU lacks fmi2" #name)

static int is_known(const fmi2ValueReference *table, size_t n, fmi2ValueReference vr) {
    size_t low = 0, high = n;
    while (low < high) {
        const size_t middle = (low + high) / 2;
        if (table[middle] < vr) low = middle + 1;
        else high = middle;
    }
    return low < n && table[low] == vr;
}

static fmi2Status set_starts(Corrected *m) {
    State *s = &m->s;
    fmi2Status status = fmi2OK;
    memset(s, 0, sizeof *s);
    memcpy(s->guid, CORRECTED_GUID, strlen(CORRECTED_GUID));
    s->phase = INSTANTIATED;
    s->hold = HOLD;
    s->drive = DRIVE_START;
    memcpy(s->p, start_p, sizeof s->p);
    if (N_START_REAL) status = answered(m, inner_SetReal(m->inner, start_real, N_START_REAL, start_real_to), "fitted values");
    if (status <= fmi2Warning && N_START_INTEGER)
        status = inner_SetInteger ? answered(m, inner_SetInteger(m->inner, start_integer, N_START_INTEGER, start_integer_to), "start values") : fail(m, "the inner FMU lacks fmi2SetInteger");
    if (status <= fmi2Warning && N_START_BOOLEAN)
        status = inner_SetBoolean ? answered(m, inner_SetBoolean(m->inner, start_boolean, N_START_BOOLEAN, start_boolean_to), "start values") : fail(m, "the inner FMU lacks fmi2SetBoolean");
    return status;
}

/* ---- life cycle ----------------------------------------------------------- */

static void silent(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    (void)e; (void)name; (void)status; (void)category; (void)message;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    static unsigned long made;
    Corrected *m = instance(name, functions, logging);
    (void)resources; /* where this library lies is surer */
    if (!m) return NULL;
    if (!m->host.logger) m->host.logger = silent;
    if (!m->host.allocateMemory) m->host.allocateMemory = calloc;
    if (!m->host.freeMemory) m->host.freeMemory = free;
    m->serial = __atomic_add_fetch(&made, 1, __ATOMIC_RELAXED);
    if (kind != fmi2CoSimulation) fail(m, "instantiate: this FMU is for co-simulation only");
    else if (!guid || strcmp(guid, GUID) != 0) fail(m, "instantiate: the GUID is not that of this library");
    else if (!(m->loaded = enter())) fail(m, "instantiate: the inner FMU cannot be loaded from resources/inner: %s", problem);
    else if (!(m->inner = inner_Instantiate(m->name, kind, INNER_GUID, place, &m->host, visible, logging))) fail(m, "instantiate: the inner FMU refuses to be instantiated");
    else if (set_starts(m) <= fmi2Warning) return m;
    fmi2FreeInstance(m);
    return NULL;
}

void fmi2FreeInstance(fmi2Component c) {
    Corrected *m = c;
    if (!c) return;
    if (!dies(&instances, c)) {
        tell_stranger("fmi2FreeInstance");
        return;
    }
    if (m->inner && !m->dead) inner_FreeInstance(m->inner);
    if (m->loaded) leave();
    discard(m);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    USABLE("SetDebugLogging");
    m->logging = on;
    return inner_SetDebugLogging ? answered(m, inner_SetDebugLogging(m->inner, on, n, categories), "setDebugLogging") : fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    USABLE("SetupExperiment");
    if (m->s.phase != INSTANTIATED) return fail(m, "setupExperiment: only before initialization");
    m->s.t = start;
    return answered(m, inner_SetupExperiment(m->inner, has_tolerance, tolerance, start, has_stop, stop), "setupExperiment");
}

#define CHANGE(function, call, allowed, next) \
    fmi2Status fmi2##function(fmi2Component c) { \
        fmi2Status status; \
        USABLE(#function); \
        if (!(allowed)) return fail(m, call ": called out of order"); \
        status = answered(m, inner_##function(m->inner), call); \
        if (status <= fmi2Warning) m->s.phase = next; \
        return status; \
    }
CHANGE(EnterInitializationMode, "enterInitializationMode", m->s.phase == INSTANTIATED, INITIALIZING)
CHANGE(ExitInitializationMode, "exitInitializationMode", m->s.phase == INITIALIZING, STEPPING)
CHANGE(Terminate, "terminate", m->s.phase == STEPPING, TERMINATED)

fmi2Status fmi2Reset(fmi2Component c) {
    fmi2Status status, later;
    USABLE("Reset");
    status = answered(m, inner_Reset(m->inner), "reset");
    if (status > fmi2Warning) return status;
    later = set_starts(m);
    return later > status ? later : status;
}

/* ---- variables ------------------------------------------------------------ */

static int is_passed_on(fmi2ValueReference vr) { return vr != VR_DRIVE && is_known(known_real, N_KNOWN_REAL, vr); }

static size_t count_passed_on(const fmi2ValueReference vr[], size_t n) {
    size_t i = 0;
    while (i < n && is_passed_on(vr[i])) i++;
    return i;
}

static fmi2Status set_one(Corrected *m, fmi2ValueReference vr, double value) {
    State *s = &m->s;
    double sum;
    if (is_passed_on(vr)) return answered(m, inner_SetReal(m->inner, &vr, 1, &value), "setReal");
    if (vr == VR_DRIVE) {
        s->drive = value;
        sum = value + s->added;
        return answered(m, inner_SetReal(m->inner, &vr, 1, &sum), "setReal");
    }
    if (vr < VR_LAW || vr >= VR_ADDED) return fail(m, "setReal: variable %u is unknown or cannot be set", vr);
    if (s->phase > INITIALIZING) return fail(m, "setReal: variable %u cannot be set in this phase", vr);
    if (!isfinite(value) || (vr == VR_HOLD && value <= 0)) return fail(m, "setReal: variable %u cannot be %g", vr, value);
    *(vr == VR_HOLD ? &s->hold : &s->p[free_p[vr - VR_LAW]]) = value;
    return fmi2OK;
}

static fmi2Status get_one(Corrected *m, fmi2ValueReference vr, double *value) {
    State *s = &m->s;
    if (is_passed_on(vr)) return answered(m, inner_GetReal(m->inner, &vr, 1, value), "getReal");
    if (vr == VR_DRIVE) *value = s->drive;
    else if (vr == VR_HOLD) *value = s->hold;
    else if (vr == VR_ADDED) *value = s->added;
    else if (vr >= VR_LAW && vr < VR_HOLD) *value = s->p[free_p[vr - VR_LAW]];
    else return fail(m, "getReal: there is no variable %u", vr);
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    fmi2Status status = fmi2OK, one;
    size_t i;
    USABLE("SetReal");
    GIVEN(n == 0 || (vr && value), "setReal");
    if (count_passed_on(vr, n) == n) return n ? answered(m, inner_SetReal(m->inner, vr, n, value), "setReal") : fmi2OK;
    for (i = 0; i < n; i++) {
        if ((one = set_one(m, vr[i], value[i])) > fmi2Warning) return one;
        if (one > status) status = one;
    }
    return status;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    fmi2Status status = fmi2OK, one;
    size_t i;
    USABLE("GetReal");
    GIVEN(n == 0 || (vr && value), "getReal");
    if (count_passed_on(vr, n) == n) return n ? answered(m, inner_GetReal(m->inner, vr, n, value), "getReal") : fmi2OK;
    for (i = 0; i < n; i++) {
        if ((one = get_one(m, vr[i], &value[i])) > fmi2Warning) return one;
        if (one > status) status = one;
    }
    return status;
}

#define WHOLE(function, type, table, length, given) \
    fmi2Status fmi2##function(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[]) { \
        size_t i; \
        USABLE(#function); \
        GIVEN(n == 0 || (vr && value), #function); \
        for (i = 0; i < n; i++) { \
            if (!is_known(table, length, vr[i])) return fail(m, #function ": there is no variable %u of this type", vr[i]); \
            if (!(given)) return fail(m, #function ": a pointer is NULL"); \
        } \
        HAS(function, #function); \
        return n ? answered(m, inner_##function(m->inner, vr, n, value), #function) : fmi2OK; \
    }
WHOLE(GetInteger, fmi2Integer, known_integer, N_KNOWN_INTEGER, 1)
WHOLE(GetBoolean, fmi2Boolean, known_boolean, N_KNOWN_BOOLEAN, 1)
WHOLE(GetString, fmi2String, known_string, N_KNOWN_STRING, 1)
WHOLE(SetInteger, const fmi2Integer, known_integer, N_KNOWN_INTEGER, 1)
WHOLE(SetBoolean, const fmi2Boolean, known_boolean, N_KNOWN_BOOLEAN, 1)
WHOLE(SetString, const fmi2String, known_string, N_KNOWN_STRING, value[i] != NULL)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known, const fmi2Real seed[], fmi2Real out[]) {
    USABLE("GetDirectionalDerivative");
    (void)unknown; (void)n_unknown; (void)known; (void)n_known; (void)seed; (void)out;
    return fail(m, "getDirectionalDerivative: not provided");
}

/* ---- FMU state ------------------------------------------------------------ */

typedef struct {
    State s;
    unsigned long serial; /* of the instance it belongs to */
    fmi2FMUstate inner;
} Saved;

#define OF_THIS(state, call) do { \
    if (!is_alive(&states, state) || ((Saved *)(state))->serial != m->serial) \
        return fail(m, call ": this is no state of this instance, or it was freed"); \
} while (0)
#define STATES(call) do { if (!INNER_STATES) return fail(m, call ": the inner FMU does not give its state"); } while (0)
#define BYTES(call) do { if (!INNER_BYTES) return fail(m, call ": the inner FMU does not give its state as bytes"); } while (0)

static Saved *saved_for(Corrected *m, fmi2FMUstate *state) { /* the one that is there, or a new one */
    Saved *made;
    if (is_alive(&states, *state) && ((Saved *)*state)->serial == m->serial) return *state;
    if (!(made = calloc(1, sizeof *made))) return NULL;
    made->serial = m->serial;
    if (born(&states, made)) return made;
    free(made);
    return NULL;
}

static fmi2Status kept(Corrected *m, fmi2FMUstate *state, Saved *saved, fmi2Status status) {
    if (status <= fmi2Warning) *state = saved;
    else if (saved != *state && dies(&states, saved)) free(saved);
    (void)m;
    return status;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    Saved *saved;
    USABLE("GetFMUstate");
    GIVEN(state, "getFMUstate");
    STATES("getFMUstate");
    HAS(GetFMUstate, "getFMUstate");
    if (!(saved = saved_for(m, state))) return fail(m, "getFMUstate: out of memory");
    saved->s = m->s;
    return kept(m, state, saved, answered(m, inner_GetFMUstate(m->inner, &saved->inner), "getFMUstate"));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    fmi2Status status;
    USABLE("SetFMUstate");
    OF_THIS(state, "setFMUstate");
    HAS(SetFMUstate, "setFMUstate");
    status = answered(m, inner_SetFMUstate(m->inner, ((Saved *)state)->inner), "setFMUstate");
    if (status <= fmi2Warning) m->s = ((Saved *)state)->s;
    return status;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    fmi2Status status = fmi2OK;
    USABLE("FreeFMUstate");
    if (!state || !*state) return fmi2OK;
    OF_THIS(*state, "freeFMUstate");
    if (inner_FreeFMUstate) status = answered(m, inner_FreeFMUstate(m->inner, &((Saved *)*state)->inner), "freeFMUstate");
    if (dies(&states, *state)) free(*state);
    *state = NULL;
    return status;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    fmi2Status status;
    USABLE("SerializedFMUstateSize");
    OF_THIS(state, "serializedFMUstateSize");
    GIVEN(size, "serializedFMUstateSize");
    BYTES("serializedFMUstateSize");
    HAS(SerializedFMUstateSize, "serializedFMUstateSize");
    status = answered(m, inner_SerializedFMUstateSize(m->inner, ((Saved *)state)->inner, size), "serializedFMUstateSize");
    *size += sizeof(State);
    return status;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    size_t needed = 0;
    fmi2Status status;
    USABLE("SerializeFMUstate");
    OF_THIS(state, "serializeFMUstate");
    GIVEN(bytes, "serializeFMUstate");
    HAS(SerializeFMUstate, "serializeFMUstate");
    status = fmi2SerializedFMUstateSize(c, state, &needed);
    if (status > fmi2Warning) return status;
    if (size < needed) return fail(m, "serializeFMUstate: %lu bytes are too few", (unsigned long)size);
    memcpy(bytes, &((Saved *)state)->s, sizeof(State));
    return answered(m, inner_SerializeFMUstate(m->inner, ((Saved *)state)->inner, bytes + sizeof(State), size - sizeof(State)), "serializeFMUstate");
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    Saved *saved;
    USABLE("DeSerializeFMUstate");
    GIVEN(bytes && state, "deSerializeFMUstate");
    BYTES("deSerializeFMUstate");
    HAS(DeSerializeFMUstate, "deSerializeFMUstate");
    if (size <= sizeof(State) || memcmp(bytes, GUID, strlen(GUID)) != 0)
        return fail(m, "deSerializeFMUstate: these bytes are not a state of this FMU");
    if (!(saved = saved_for(m, state))) return fail(m, "deSerializeFMUstate: out of memory");
    memcpy(&saved->s, bytes, sizeof(State));
    return kept(m, state, saved, answered(m, inner_DeSerializeFMUstate(m->inner, bytes + sizeof(State), size - sizeof(State), &saved->inner), "deSerializeFMUstate"));
}

/* ---- co-simulation -------------------------------------------------------- */

/* Reads the inner FMU with the host's drive, then gives it the corrected one. */
static fmi2Status correct(Corrected *m, double at) {
    static const fmi2ValueReference drive = VR_DRIVE, read[] = VR_READ;
    State *s = &m->s;
    double found[2] = {0, 0}, reading[4], out[1 + NS], sum;
    fmi2Status status = answered(m, inner_SetReal(m->inner, &drive, 1, &s->drive), "doStep");
    if (status <= fmi2Warning) status = answered(m, inner_GetReal(m->inner, read, sizeof read / sizeof *read, found), "doStep");
    if (status > fmi2Warning) return status;
    reading[0] = at;
    reading[1] = s->drive * PER_DRIVE;
    reading[2] = found[0] * PER_POSITION;
    reading[3] = found[1] * PER_RATE;
    m->arg[0] = s->law;
    m->arg[1] = reading;
    m->arg[2] = s->p;
    m->res[0] = out;
    law(m->arg, m->res, m->iw, m->w, 0);
    if (!isfinite(out[0])) return fail(m, "doStep: the correction is not finite at t = %g s; drive %g, position %g, velocity %g of the inner FMU", at, s->drive, found[0], found[1]);
    memcpy(s->law, out + 1, sizeof s->law);
    s->added = out[0] / PER_DRIVE;
    sum = s->drive + s->added;
    return answered(m, inner_SetReal(m->inner, &drive, 1, &sum), "doStep");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real length, fmi2Boolean no_rollback) {
    fmi2Status status = fmi2OK, one;
    long i, count;
    USABLE("DoStep");
    if (m->s.phase != STEPPING) return fail(m, "doStep: called out of order");
    if (!isfinite(t) || !(length >= 0) || length / m->s.hold > MAX_SUBSTEPS) return fail(m, "doStep: time %g s or step size %g s is not usable", t, length);
    count = (long)ceil(length / m->s.hold - 1e-6);
    if (count < 1) count = 1;
    for (i = 0; i < count; i++) {
        const double at = t + i * length / count, end = i + 1 < count ? t + (i + 1) * length / count : t + length;
        one = length > 0 ? correct(m, at) : fmi2OK;
        if (one <= fmi2Warning) {
            const fmi2Status stepped = inner_DoStep(m->inner, at, end - at, no_rollback);
            if (stepped > fmi2Warning) fail(m, "doStep: the inner FMU fails at t = %g s", at);
            one = answered(m, stepped, "doStep");
        }
        if (one > fmi2Warning) {
            m->s.phase = TERMINATED; /* part of the step is done: another state or a reset goes on from here */
            return one;
        }
        m->s.t = end;
        if (one > status) status = one;
    }
    return status;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real value[]) {
    USABLE("SetRealInputDerivatives");
    (void)vr; (void)order; (void)value;
    return n ? fail(m, "setRealInputDerivatives: not provided") : fmi2OK;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    USABLE("GetRealStatus");
    if (kind != fmi2LastSuccessfulTime) return fail(m, "getRealStatus: only the last successful time is known");
    GIVEN(value, "getRealStatus");
    *value = m->s.t;
    return fmi2OK;
}
