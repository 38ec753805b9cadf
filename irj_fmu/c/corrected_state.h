/* Headers, law and state of both wrappers of a corrected FMU; before it stand the FMI header and corrected_config.h. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

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
