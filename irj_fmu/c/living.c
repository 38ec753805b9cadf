/* Which handles are alive, so that one that is NULL, freed already or foreign is refused and never followed.
 *
 * Handles are only compared. Entries are reused and given back when the library goes: one thread may look while others
 * make and free instances.
 */
#ifndef LIVING_C /* a library round another wrapper includes it twice */
#define LIVING_C
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#define BUCKETS 256
#define STRANGERS_TOLD 100 /* lines on stderr; a host that goes on after so many does not read them */

typedef struct Entry {
    const void *handle;
    struct Entry *next;
} Entry;

typedef struct {
    Entry *first[BUCKETS];
} Living;

static Living instances, states;

static Entry **bucket(Living *kind, const void *handle) {
    const uintptr_t address = (uintptr_t)handle;
    return &kind->first[(address >> 4 ^ address >> 12) % BUCKETS];
}

static int is_alive(Living *kind, const void *handle) {
    Entry *e;
    if (!handle) return 0;
    for (e = __atomic_load_n(bucket(kind, handle), __ATOMIC_ACQUIRE); e; e = e->next)
        if (__atomic_load_n(&e->handle, __ATOMIC_ACQUIRE) == handle) return 1;
    return 0;
}

/* 0 where memory is out */
static int born(Living *kind, const void *handle) {
    Entry **first = bucket(kind, handle), *e;
    for (e = __atomic_load_n(first, __ATOMIC_ACQUIRE); e; e = e->next) {
        const void *none = NULL;
        if (__atomic_compare_exchange_n(&e->handle, &none, handle, 0, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE)) return 1;
    }
    if (!(e = malloc(sizeof *e))) return 0;
    e->handle = handle;
    e->next = __atomic_load_n(first, __ATOMIC_ACQUIRE);
    while (!__atomic_compare_exchange_n(first, &e->next, e, 0, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE)) {}
    return 1;
}

/* 0 where it was not alive: of two threads that free the same handle one is told so */
static int dies(Living *kind, const void *handle) {
    Entry *e;
    if (!handle) return 0;
    for (e = __atomic_load_n(bucket(kind, handle), __ATOMIC_ACQUIRE); e; e = e->next) {
        const void *same = handle;
        if (__atomic_compare_exchange_n(&e->handle, &same, NULL, 0, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE)) return 1;
    }
    return 0;
}

static void forget(Living *kind) {
    int i;
    for (i = 0; i < BUCKETS; i++)
        while (kind->first[i]) {
            Entry *e = kind->first[i];
            kind->first[i] = e->next;
            free(e);
        }
}

__attribute__((destructor)) static void forget_all(void) {
    forget(&instances);
    forget(&states);
}

/* A handle that is not alive has no logger. */
static void tell_stranger(const char *call) {
    static int told;
    if (__atomic_fetch_add(&told, 1, __ATOMIC_RELAXED) < STRANGERS_TOLD)
        fprintf(stderr, "%s: the instance is NULL, was freed already or is not of this FMU\n", call);
}
#endif
