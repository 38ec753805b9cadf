/* The FMU inside a corrected one, its library and what is asked of it; included by both wrappers.
 *
 * Before it stand: Instance with State s, inner and dead, and the arrays of the law; fail(instance, format, ...); FMI(name), VERSION
 * ("fmi2"); NEEDED and USEFUL, the functions that the inner library must and may have; PASS_GET and PASS_SET(instance,
 * references, count, values, length) on to it. note_place(path), which writes the resources of the inner FMU to `place` as this
 * version of FMI has them, stands behind it.
 */

typedef FMI(Status) Status;
typedef FMI(ValueReference) Reference;

#define DECLARE(name) static FMI(name##TYPE) *inner_##name;
NEEDED(DECLARE)
USEFUL(DECLARE)

static char lock; /* over what follows */
static unsigned long users;
static void *library;
static void (*finalizer)(void);
static char place[3 * LONGEST_PATH + 16], problem[512]; /* place: resources of the inner FMU, as a host says it */

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

static void note_place(const char *folder);

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
#define RESOLVE(name) *(void **)&inner_##name = symbol(VERSION #name);
    NEEDED(RESOLVE)
    USEFUL(RESOLVE)
#define MUST(name) if (!inner_##name) { snprintf(problem, sizeof problem, "it lacks " VERSION #name); close_library(); library = NULL; return 0; }
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

static Status answered(Instance *m, Status status, const char *call) {
    if (status <= FMI(Warning)) return status;
    fail(m, "%s: the inner FMU answers with status %d (3 is an error)", call, (int)status);
    if (status == FMI(Fatal)) m->dead = 1;
    return status == FMI(Fatal) ? FMI(Fatal) : FMI(Error);
}

#define HAS(name, call) if (!inner_##name) return fail(m, call ": the inner FMU lacks " VERSION #name)

/* Where a reference stands in a table; n where it is not there. */
static size_t place_of(const Reference *table, size_t n, Reference vr) {
    size_t low = 0, high = n;
    while (low < high) {
        const size_t middle = (low + high) / 2;
        if (table[middle] < vr) low = middle + 1;
        else high = middle;
    }
    return low < n && table[low] == vr ? low : n;
}

static int is_known(const Reference *table, size_t n, Reference vr) { return place_of(table, n, vr) < n; }
static int is_passed_on(Reference vr) { return vr != VR_DRIVE && is_known(known_real, N_KNOWN_REAL, vr); }

static size_t count_passed_on(const Reference vr[], size_t n) {
    size_t i = 0;
    while (i < n && is_passed_on(vr[i])) i++;
    return i;
}

/* ---- what it has not: the correction, and the host's drive ---------------- */

static Status set_own(Instance *m, Reference vr, double value, const char *call) {
    State *s = &m->s;
    double sum;
    if (vr == VR_DRIVE) {
        s->drive = value;
        sum = value + s->added;
        return answered(m, PASS_SET(m, &vr, 1, &sum, 1), call);
    }
    if (vr < VR_LAW || vr >= VR_ADDED) return fail(m, "%s: variable %u is unknown or cannot be set", call, vr);
    if (s->phase > INITIALIZING) return fail(m, "%s: variable %u cannot be set in this phase", call, vr);
    if (!isfinite(value) || (vr == VR_HOLD && value <= 0)) return fail(m, "%s: variable %u cannot be %g", call, vr, value);
    *(vr == VR_HOLD ? &s->hold : &s->p[free_p[vr - VR_LAW]]) = value;
    return FMI(OK);
}

static Status get_own(Instance *m, Reference vr, double *value, const char *call) {
    State *s = &m->s;
    if (vr == VR_DRIVE) *value = s->drive;
    else if (vr == VR_HOLD) *value = s->hold;
    else if (vr == VR_ADDED) *value = s->added;
    else if (vr >= VR_LAW && vr < VR_HOLD) *value = s->p[free_p[vr - VR_LAW]];
    else return fail(m, "%s: there is no variable %u", call, vr);
    return FMI(OK);
}

static void start_anew(State *s) {
    memset(s, 0, sizeof *s);
    memcpy(s->guid, CORRECTED_GUID, strlen(CORRECTED_GUID));
    s->phase = INSTANTIATED;
    s->hold = HOLD;
    s->drive = DRIVE_START;
    memcpy(s->p, start_p, sizeof s->p);
}

/* Reads the inner FMU with the host's drive, then gives it the corrected one. */
static Status correct(Instance *m, double at) {
    static const Reference drive = VR_DRIVE, read[] = VR_READ;
    State *s = &m->s;
    double found[2] = {0, 0}, reading[4], out[1 + NS], sum;
    Status status = answered(m, PASS_SET(m, &drive, 1, &s->drive, 1), "doStep");
    if (status <= FMI(Warning)) status = answered(m, PASS_GET(m, read, sizeof read / sizeof *read, found, sizeof read / sizeof *read), "doStep");
    if (status > FMI(Warning)) return status;
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
    return answered(m, PASS_SET(m, &drive, 1, &sum, 1), "doStep");
}

static Status pass_step(Instance *m, double at, double length, int no_rollback);

/* A step of the host: one or more of the inner FMU, each with the correction held. */
static Status advance(Instance *m, double t, double length, int no_rollback) {
    Status status = FMI(OK), one;
    long i, count;
    if (m->s.phase != STEPPING) return fail(m, "doStep: called out of order");
    if (!isfinite(t) || !(length >= 0) || length / m->s.hold > MAX_SUBSTEPS) return fail(m, "doStep: time %g s or step size %g s is not usable", t, length);
    count = (long)ceil(length / m->s.hold - 1e-6);
    if (count < 1) count = 1;
    for (i = 0; i < count && !ENDED(m); i++) {
        const double at = t + i * length / count, end = i + 1 < count ? t + (i + 1) * length / count : t + length;
        one = length > 0 ? correct(m, at) : FMI(OK);
        if (one <= FMI(Warning)) {
            const Status stepped = pass_step(m, at, end - at, no_rollback);
            if (stepped > FMI(Warning)) fail(m, "doStep: the inner FMU fails at t = %g s", at);
            one = answered(m, stepped, "doStep");
        }
        if (one > FMI(Warning)) {
            m->s.phase = TERMINATED; /* part of the step is done: another state or a reset goes on from here */
            return one;
        }
        m->s.t = end;
        if (one > status) status = one;
    }
    return status;
}

/* ---- FMU state ------------------------------------------------------------ */

typedef struct {
    State s;
    unsigned long serial; /* of the instance it belongs to */
    void *inner;
} Saved;

#define POINTER(condition, call) do { if (!(condition)) return fail(m, call ": a pointer is NULL"); } while (0)
#define OF_THIS(state, call) do { \
    if (!is_alive(&states, state) || ((Saved *)(state))->serial != m->serial) \
        return fail(m, call ": this is no state of this instance, or it was freed"); \
} while (0)
#define STATES(call) do { if (!INNER_STATES) return fail(m, call ": the inner FMU does not give its state"); } while (0)
#define BYTES(call) do { if (!INNER_BYTES) return fail(m, call ": the inner FMU does not give its state as bytes"); } while (0)

static Saved *saved_for(Instance *m, void **state) { /* the one that is there, or a new one */
    Saved *made;
    if (is_alive(&states, *state) && ((Saved *)*state)->serial == m->serial) return *state;
    if (!(made = calloc(1, sizeof *made))) return NULL;
    made->serial = m->serial;
    if (born(&states, made)) return made;
    free(made);
    return NULL;
}

static Status kept(Instance *m, void **state, Saved *saved, Status status) {
    if (status <= FMI(Warning)) *state = saved;
    else if (saved != *state && dies(&states, saved)) free(saved);
    (void)m;
    return status;
}

static Status get_state(Instance *m, void **state) {
    Saved *saved;
    POINTER(state, "getFMUstate");
    STATES("getFMUstate");
    HAS(GetFMUstate, "getFMUstate");
    if (!(saved = saved_for(m, state))) return fail(m, "getFMUstate: out of memory");
    saved->s = m->s;
    return kept(m, state, saved, answered(m, inner_GetFMUstate(m->inner, &saved->inner), "getFMUstate"));
}

static Status set_state(Instance *m, void *state) {
    Status status;
    OF_THIS(state, "setFMUstate");
    HAS(SetFMUstate, "setFMUstate");
    status = answered(m, inner_SetFMUstate(m->inner, ((Saved *)state)->inner), "setFMUstate");
    if (status <= FMI(Warning)) m->s = ((Saved *)state)->s;
    return status;
}

static Status free_state(Instance *m, void **state) {
    Status status = FMI(OK);
    if (!state || !*state) return FMI(OK);
    OF_THIS(*state, "freeFMUstate");
    if (inner_FreeFMUstate) status = answered(m, inner_FreeFMUstate(m->inner, &((Saved *)*state)->inner), "freeFMUstate");
    if (dies(&states, *state)) free(*state);
    *state = NULL;
    return status;
}

static Status size_of_state(Instance *m, void *state, size_t *size) {
    Status status;
    OF_THIS(state, "serializedFMUstateSize");
    POINTER(size, "serializedFMUstateSize");
    BYTES("serializedFMUstateSize");
    HAS(SerializedFMUstateSize, "serializedFMUstateSize");
    status = answered(m, inner_SerializedFMUstateSize(m->inner, ((Saved *)state)->inner, size), "serializedFMUstateSize");
    *size += sizeof(State);
    return status;
}

static Status bytes_of_state(Instance *m, void *state, Byte bytes[], size_t size) {
    size_t needed = 0;
    Status status;
    OF_THIS(state, "serializeFMUstate");
    POINTER(bytes, "serializeFMUstate");
    HAS(SerializeFMUstate, "serializeFMUstate");
    status = size_of_state(m, state, &needed);
    if (status > FMI(Warning)) return status;
    if (size < needed) return fail(m, "serializeFMUstate: %lu bytes are too few", (unsigned long)size);
    memcpy(bytes, &((Saved *)state)->s, sizeof(State));
    return answered(m, inner_SerializeFMUstate(m->inner, ((Saved *)state)->inner, bytes + sizeof(State), size - sizeof(State)), "serializeFMUstate");
}

static Status state_of_bytes(Instance *m, const Byte bytes[], size_t size, void **state) {
    Saved *saved;
    POINTER(bytes && state, "deSerializeFMUstate");
    BYTES("deSerializeFMUstate");
    HAS(DeSerializeFMUstate, "deSerializeFMUstate");
    if (size <= sizeof(State) || memcmp(bytes, CORRECTED_GUID, strlen(CORRECTED_GUID)) != 0)
        return fail(m, "deSerializeFMUstate: these bytes are not a state of this FMU");
    if (!(saved = saved_for(m, state))) return fail(m, "deSerializeFMUstate: out of memory");
    memcpy(&saved->s, bytes, sizeof(State));
    return kept(m, state, saved, answered(m, inner_DeSerializeFMUstate(m->inner, bytes + sizeof(State), size - sizeof(State), &saved->inner), "deSerializeFMUstate"));
}
