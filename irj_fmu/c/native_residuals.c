/* Residuals of the fault detector: identification.faults.residuals; bits and what they mean. */
#define MASK (FAULT_RING - 1)

enum { LINK_PARITY = 1, MOTOR_PARITY = 2, TORSION = 4, LINK_JUMP = 8, MOTOR_JUMP = 16, LINK = 32, MOTOR = 64 };

static const int residual_bit[RESIDUALS] = {
    LINK_PARITY, LINK_PARITY, LINK_PARITY, LINK_PARITY, MOTOR_PARITY, MOTOR_PARITY, MOTOR_PARITY, MOTOR_PARITY,
    LINK_JUMP, LINK, LINK, LINK, MOTOR_JUMP, MOTOR, MOTOR, MOTOR, TORSION, TORSION, TORSION};
static const int energy_at[3] = {0, 4, 16};

static int outside(double value, double limit) { return !(value >= -limit && value <= limit); }

static int index_of(int bit) {
    int i;
    for (i = 0; bit >> (i + 1); i++) {}
    return i;
}

static void invalidate(Fault *f, int parity, Count sample) {
    f->valid[parity] = sample;
    memset(f->energy, 0, sizeof f->energy);
}

/* One sample of the residuals; gives the bits of those over their limits. */
static int residuals(Fault *f, const double positions[4], const double rates[4], double torsion) {
    int bits = 0, i, j;
    for (i = 0; i < 4; i++) {
        const Count age = f->k - f->valid[i];
        double now;
        f->sums[i] += HALF_STEP * (rates[i] + f->last[i]);
        f->last[i] = rates[i];
        now = positions[i] - f->sums[i];
        f->ring[i][f->k & MASK] = now;
        for (j = 0; j < 4; j++) {
            const double value = age >= lag[j] ? now - f->ring[i][(f->k - lag[j]) & MASK] : 0;
            f->values[4 * i + j] = value;
            if (outside(value * f->scale[i], f->limits[4 * i + j])) bits |= residual_bit[4 * i + j];
        }
    }
    if (HAS_TORQUE) {
        const Count age = f->k - f->valid[4];
        const double weight = f->scale[4];
        double now;
        f->values[16] = torsion;
        f->sums[4] = now = f->sums[4] + HALF_STEP * (torsion + f->last[4]);
        f->last[4] = torsion;
        f->ring[4][f->k & MASK] = now;
        f->values[17] = age >= lag[1] ? (now - f->ring[4][(f->k - lag[1]) & MASK]) * MEAN_1 : 0;
        f->values[18] = age >= lag[2] ? (now - f->ring[4][(f->k - lag[2]) & MASK]) * MEAN_2 : 0;
        for (j = 16; j < RESIDUALS; j++)
            if (outside(f->values[j] * weight, f->limits[j])) bits |= TORSION;
    }
    for (i = 0; i < 3; i++) {
        const double value = f->values[energy_at[i]], grown = f->energy[i] + value * value * energy_inverse[i] - ENERGY_DRIFT;
        f->energy[i] = fmax(0, fmin(grown, ENERGY_TOP));
        if (grown > 0 && grown > energy_limit[i]) {
            bits |= residual_bit[energy_at[i]];
            f->energy[i] = ENERGY_LEFT * energy_limit[i];
        }
    }
    return bits;
}

