/* Memory of a native estimator; sizes come from native_config.h, which irj_fmu.estimator.native_tables writes.
 *
 * State is everything that changes from step to step: one copy of it is one FMU state. Nothing here is allocated after
 * fmi2Instantiate.
 */
#define DIM(n) ((n) > 0 ? (n) : 1)
#define MAX_TEXT 512
#define SENSORS 6
#define BITS 7

enum { DRIVE, Q_M, W_M, Q_L, W_L, TAU };
enum { NO_EVENT, ARMED, SENSOR, DROPOUT, CURRENT_OR_FRICTION, PLANT, RECOVERED };

typedef enum { INSTANTIATED = 1, INITIALIZING, STEPPING, TERMINATED } Phase;
typedef long long Count;

typedef struct { /* the last samples and the points of the nonlinear laws; RowMaker */
    double history[2 * WINDOW][SOURCES]; /* each sample twice, so that the last WINDOW lie in one piece */
    double recent[TAPS][SOURCES], tap[TAPS][SOURCES]; /* last readings, oldest first, and their weights; Alignment */
    double zero; /* taken off the link position */
    double ring[POINTS][DIM(N_NEEDED)], speed[POINTS][2];
    double before[DIM(N_COORDINATES)], held[DIM(N_MEMORY)], started;
    double signals[N_SIGNALS];
    Count made;
    int end, since, any, lead;
} Rows;

typedef struct { /* Watch */
    double rows[WATCH][SENSORS], noise[SENSORS];
    int count, bad[SENSORS], looks[SENSORS], constant[SENSORS], scaled[SENSORS];
} Watch;

typedef struct { /* rows of the first window */
    double y[COLLECT][N_BALANCES], h[COLLECT][N_BALANCES][N_THETA], shares[COLLECT][2];
    int count;
} FirstWindow;

typedef struct { /* RecursiveLeastSquares */
    double fast[N_FAST], slow[N_SLOW], config[N_CONFIG];
    int running;
} Recursion;

typedef struct { /* Grid */
    Count count;
    double start, time, readings[SENSORS];
    int valid[SENSORS];
} Grid;

typedef struct { /* Pulse */
    int still, failed, jumped, any;
    Count same;
    double speed, share, time, before[SENSORS];
} Pulse;

typedef struct { /* Guard */
    int on_probation, on[N_BALANCES];
    Count back, explained, next, doubt, until, held_for, over[N_BALANCES];
    double quick[N_BALANCES], fresh[N_BALANCES], trial[N_BALANCES], own[N_BALANCES], theta[N_THETA];
    double sums[N_BALANCES][GUARD_SUMS];
    Recursion kept[3];
} Guard;

typedef struct { /* StructuredRule and Residuals */
    double observer[DIM(N_OBSERVER)], used[SENSORS], gain[5 * DIM(N_OBSERVER)], gate[5], gates[5];
    double limits[RESIDUALS], values[RESIDUALS], scale[5], energy[3], sums[5], last[5];
    double ring[5][FAULT_RING];
    Count valid[5], k, opened, plant_rest, gate_until, first[BITS], latest[BITS], event_sample;
    double peak, low[SENSORS], high[SENSORS], margin;
    Count there;
    int failed[SENSORS], lost[SENSORS], good[SENSORS], latched, muted, cut, event;
} Fault;

typedef struct {
    char guid[40];
    Phase phase;
    int changed, configured, reset_before, fault, plant_alarm;
    double start, last, uneven, expected; /* of the sample grid */
    double last_good[SENSORS], readings[SENSORS];
    Count samples, n_rows;
    int lost[SOURCES];
    double theta[N_THETA], sigma[N_THETA], scale[N_THETA];
    double residual[N_BALANCES], floor[N_BALANCES], ratio[N_BALANCES], square[N_BALANCES], torque[N_BALANCES];
    double score[SENSORS];
    double warm_up, drift, alarm_drift, floor_share;
    double off[N_THETA], heard[DIM(HEARD)][SOURCES]; /* what the readings are freed of, and those of the first window; Calibration */
    unsigned char told[DIM(HEARD / STRIDE)];
    int n_heard, deaf;
    int collect, room, detect;
    double first_level[N_BALANCES];
    Count strained;
    int reoptimise;
    double real[N_VARIABLES];
    int whole[N_VARIABLES];
    char text[DIM(N_TEXTS)][MAX_TEXT];
    Rows rows;
    Watch watch;
    FirstWindow window;
    Recursion rls;
    Grid grid;
    Pulse pulse;
    Guard guard;
    Fault detector;
} State;

typedef struct { /* RowCheck: what a row says before the recursion takes it */
    double error[N_BALANCES], weighted[3 * N_BALANCES], square[N_BALANCES], torque[N_BALANCES], least[N_BALANCES];
    double y[N_BALANCES], h[N_BALANCES * N_THETA], signals[3 * N_BALANCES];
} Checked;

typedef struct {
    State s;
    Checked checked;
    fmi2CallbackFunctions host;
    char *name;
    int logging;
    unsigned char told[N_VARIABLES + 64];
    const double *arg[SZ_ARG];
    double *res[SZ_RES];
    double w[DIM(SZ_W)];
    casadi_int iw[DIM(SZ_IW)];
    /* results and work space within one call */
    double fast_next[N_FAST], slow_next[N_SLOW], theta_next[N_THETA];
    double observed[DIM(N_OBSERVED)];
    double raw[NEW_POINTS * N_SIGNALS], smooth[NEW_POINTS * N_SIGNALS], laws[NEW_POINTS * DIM(N_NEEDED)];
    double before_next[DIM(N_COORDINATES)], held_next[DIM(N_MEMORY)];
    double y[N_BALANCES], h[N_BALANCES * N_THETA];
    double weight[COLLECT][N_BALANCES], triangle[N_BALANCES][N_THETA + 1][N_THETA + 1];
    double matrix[COLLECT + N_BALANCES * (N_THETA + 1)][N_THETA + 1];
    double sorted[COLLECT > WATCH ? COLLECT : WATCH], fourth[WATCH];
} Twin;
