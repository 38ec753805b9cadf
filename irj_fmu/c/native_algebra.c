/* Small dense least squares in fixed memory: Householder QR, one-sided Jacobi SVD.
 *
 * Sources: Golub and Van Loan, Matrix Computations, sections 5.2 and 8.6.3.
 */
#define COLUMNS (N_THETA + 1)

/* Reduce rows of [A | b] to a triangle in place: that of A, the head of Q'b, and below it the length of the rest. */
static void triangularise(double a[][COLUMNS], int rows) {
    double sums[COLUMNS];
    int i, j, k;
    for (k = 0; k < COLUMNS && k < rows - 1; k++) {
        double size = 0, head = 0, tail;
        for (i = k; i < rows; i++) size = fmax(size, fabs(a[i][k]));
        if (size == 0) continue;
        for (i = k; i < rows; i++) head += (a[i][k] / size) * (a[i][k] / size);
        head = a[k][k] > 0 ? -size * sqrt(head) : size * sqrt(head); /* the new diagonal entry */
        a[k][k] -= head;
        tail = -a[k][k] * head; /* half the squared length of the reflector */
        for (j = k + 1; j < COLUMNS; j++) sums[j] = 0;
        for (i = k; i < rows; i++)
            for (j = k + 1; j < COLUMNS; j++) sums[j] += a[i][k] * a[i][j];
        for (j = k + 1; j < COLUMNS; j++) sums[j] /= tail;
        for (i = k; i < rows; i++) {
            for (j = k + 1; j < COLUMNS; j++) a[i][j] -= a[i][k] * sums[j];
            if (i > k) a[i][k] = 0;
        }
        a[k][k] = head;
    }
}

typedef struct { /* A = U diag(s) V' of an (N_THETA x n) matrix: u holds U diag(s) column by column, s falls */
    int n;
    double u[N_THETA][N_THETA], v[N_THETA][N_THETA], s[N_THETA];
} Svd;

/* Singular values of the columns `chosen` of a triangle. u and v hold columns as their rows. */
static void decompose(Svd *d, double a[][COLUMNS], const int chosen[], int n) {
    int i, j, k, sweep, turned = 1;
    d->n = n;
    for (j = 0; j < n; j++)
        for (i = 0; i < N_THETA; i++) {
            d->u[j][i] = i <= chosen[j] ? a[i][chosen[j]] : 0;
            d->v[j][i] = i == j;
        }
    for (sweep = 0; sweep < 60 && turned; sweep++) {
        turned = 0;
        for (j = 0; j < n - 1; j++)
            for (k = j + 1; k < n; k++) {
                double alpha = 0, beta = 0, gamma = 0, zeta, t, c, s;
                for (i = 0; i < N_THETA; i++) {
                    alpha += d->u[j][i] * d->u[j][i];
                    beta += d->u[k][i] * d->u[k][i];
                    gamma += d->u[j][i] * d->u[k][i];
                }
                if (fabs(gamma) <= 3e-15 * sqrt(alpha * beta)) continue;
                turned = 1;
                zeta = (beta - alpha) / (2 * gamma);
                t = (zeta > 0 ? 1 : -1) / (fabs(zeta) + sqrt(1 + zeta * zeta));
                c = 1 / sqrt(1 + t * t);
                s = c * t;
                for (i = 0; i < N_THETA; i++) {
                    const double p = d->u[j][i], q = d->u[k][i], x = d->v[j][i], y = d->v[k][i];
                    d->u[j][i] = c * p - s * q; d->u[k][i] = s * p + c * q;
                    d->v[j][i] = c * x - s * y; d->v[k][i] = s * x + c * y;
                }
            }
    }
    for (j = 0; j < n; j++) {
        double sum = 0;
        for (i = 0; i < N_THETA; i++) sum += d->u[j][i] * d->u[j][i];
        d->s[j] = sqrt(sum);
    }
    for (j = 0; j < n - 1; j++) { /* the largest first */
        int top = j;
        for (k = j + 1; k < n; k++) if (d->s[k] > d->s[top]) top = k;
        if (top == j) continue;
        for (i = 0; i < N_THETA; i++) {
            double swap = d->u[j][i]; d->u[j][i] = d->u[top][i]; d->u[top][i] = swap;
            swap = d->v[j][i]; d->v[j][i] = d->v[top][i]; d->v[top][i] = swap;
        }
        { const double swap = d->s[j]; d->s[j] = d->s[top]; d->s[top] = swap; }
    }
}

/* Smallest x with A x = b in the least-squares sense; singular values under `limit` times the largest count as zero. */
static void solve(const Svd *d, double a[][COLUMNS], double limit, double x[N_THETA]) {
    int i, j;
    for (i = 0; i < d->n; i++) x[i] = 0;
    for (j = 0; j < d->n; j++) {
        double sum = 0;
        if (d->s[j] <= limit * d->s[0] || d->s[j] == 0) continue;
        for (i = 0; i < N_THETA; i++) sum += d->u[j][i] * a[i][N_THETA];
        sum /= d->s[j] * d->s[j];
        for (i = 0; i < d->n; i++) x[i] += sum * d->v[j][i];
    }
}

/* The same for all columns of a triangle. */
static void solve_all(double a[][COLUMNS], double limit, double x[N_THETA]) {
    static const Svd empty;
    Svd d = empty;
    int all[N_THETA], i;
    for (i = 0; i < N_THETA; i++) all[i] = i;
    decompose(&d, a, all, N_THETA);
    solve(&d, a, limit, x);
}
