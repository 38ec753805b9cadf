/* What both wrappers of a native estimator hold: its parts, its start, and which variable may be set when. */
#include "native_state.h"
#include "native_algebra.c"
#include "native_calibration.c"
#include "native_rows.c"
#include "native_watch.c"
#include "native_guard.c"
#include "native_window.c"
#include "native_residuals.c"
#include "native_fault.c"
#include "native_estimator.c"

enum { REAL, INTEGER, BOOLEAN, STRING };
enum { WRITABLE = 1, PARAMETER = 2, FIXED = 4 };

static void restart(State *s) {
    memset(s, 0, sizeof *s);
    memcpy(s->guid, NATIVE_GUID, strlen(NATIVE_GUID));
    s->phase = INSTANTIATED;
    s->start = NAN;
    s->uneven = -INFINITY;
    memcpy(s->real, start_real, sizeof s->real);
    memcpy(s->whole, start_whole, sizeof s->whole);
    memcpy(s->detector.limits, fault_limit, sizeof s->detector.limits);
    s->detector.margin = 1;
}

static int may_set(Twin *m, unsigned v) { /* 0: the value stays, and the log says so */
    const int about = access[v];
    if (m->s.phase < STEPPING || (about & WRITABLE && !(about & FIXED))) return 1;
    tell(m, v, "variable %u cannot be set after initialization; it keeps its value", v);
    return 0;
}

/* 0 where the text is none or too long. */
static int take_text(State *s, unsigned v, const char *given) {
    char *place = s->text[text_of[v]];
    if (!given || strlen(given) >= MAX_TEXT) return 0;
    if (strcmp(place, given) != 0) s->changed = 1;
    strcpy(place, given);
    return 1;
}
