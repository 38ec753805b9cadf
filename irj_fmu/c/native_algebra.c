/* Small dense least squares in fixed memory: Householder QR.
 *
 * Source: Golub and Van Loan, Matrix Computations, sections 3.1 and 5.2.
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

/* x of the triangle [R | b] with R x = b. */
static void back_substitute(double a[][COLUMNS], double x[N_THETA]) {
    int i, j;
    for (i = N_THETA - 1; i >= 0; i--) {
        double sum = a[i][N_THETA];
        for (j = i + 1; j < N_THETA; j++) sum -= a[i][j] * x[j];
        x[i] = sum / a[i][i];
    }
}
