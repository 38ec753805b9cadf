/* The log of an FMI 3.0 host behind a library that logs through FMI 2.0's callbacks.
 *
 * Before it stand fmi2FunctionTypes.h or fmi2Functions.h, fmi3Functions.h, stdarg.h and stdio.h. The componentEnvironment of the
 * callbacks is a Sink, or something that begins with one. The statuses of both standards have the same numbers up to fatal.
 */

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Sink;

/* what has '%' doubled for hosts that take a text as a format is a text again */
static void relay(fmi2ComponentEnvironment sink, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...) {
    const Sink *to = sink;
    char text[2048];
    va_list values;
    (void)name;
    va_start(values, message);
    vsnprintf(text, sizeof text, message, values);
    va_end(values);
    if (to->log) to->log(to->environment, (fmi3Status)status, category, text);
}
