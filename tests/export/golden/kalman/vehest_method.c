/* vehest_method.c: Kalman filter (kalman, kalman), the method alone.
 * Kalman filter of a linear single track (Leanza, Reina & Blanco-Claraco 2021): states are the sideslip angle beta [rad] and the yaw rate
 * r [rad/s]; measured are a_y and r, the steering angle is a noisy input.
 * Covariances are kept as square roots, P = L L' (Kaminski, Bryson & Schmidt 1971), which lose no digits of a precise sensor in float.
 */
#include "vehest_method.h"

enum { N = 2, M = 2, COLUMNS = 4 };

static const vehest_real TAU = 0.01; /* sampling time [s] */
static const vehest_real MASS = 982.0; /* [kg] */
static const vehest_real INERTIA = 1605.4145; /* about the vertical axis [kg m^2] */
static const vehest_real SUM = 190000.0; /* C_f + C_r [N/rad] */
static const vehest_real MOMENT = -35300.000000000015; /* l_f C_f - l_r C_r [N m/rad] */
static const vehest_real DAMPING = 261211.0; /* l_f^2 C_f + l_r^2 C_r [N m^2/rad] */
static const vehest_real FRONT = 70000.0; /* C_f [N/rad] */
static const vehest_real FRONT_ARM = 1.33; /* l_f [m] */
static const vehest_real SLOWEST = 3.0; /* the model is held at this speed below it [m/s] */
static const vehest_real STEER_LEVEL = 450.0; /* standard deviation of the input [rad] */
static const vehest_real SENSORS[M] = {0.3, 0.05}; /* standard deviations of a_y [m/s^2] and r [rad/s] */

/* The model at one forward speed: x+ = A x + B delta + w;  a_y = C x + D delta. */
typedef struct {
    vehest_real A[N][N], B[2], C[N], D;
} track;

static void track_at(vehest_real vx, track *t)
{
    const vehest_real u = vx > SLOWEST ? vx : SLOWEST;

    for (int i = 0; i < N; i++) {
        t->C[i] = 0.0;
        for (int j = 0; j < N; j++) {
            t->A[i][j] = 0.0;
        }
    }
    /* forward Euler: A = I + tau A_c, B = tau B_c */
    t->A[0][0] = 1.0 + TAU * (-SUM / (MASS * u));
    t->A[0][1] = TAU * -(1.0 + MOMENT / (MASS * u * u));
    t->A[1][0] = TAU * -(MOMENT / INERTIA);
    t->A[1][1] = 1.0 + TAU * (-DAMPING / (INERTIA * u));
    t->B[0] = TAU * (FRONT / (MASS * u));
    t->B[1] = TAU * (FRONT_ARM * FRONT / INERTIA);
    t->C[0] = -SUM / MASS;
    t->C[1] = -MOMENT / (MASS * u);
    t->D = FRONT / MASS;
}

/* Householder reflections from the right make the first `rows` rows lower triangular; the product a a' stays. */
static void triangularise(int rows, vehest_real a[M + N][COLUMNS])
{
    for (int i = 0; i < rows; i++) {
        vehest_real beyond = 0.0, length, first;
        for (int j = i + 1; j < COLUMNS; j++) {
            beyond += a[i][j] * a[i][j];
        }
        if (!(beyond > 0.0)) {
            continue;
        }
        length = VEHEST_SQRT(a[i][i] * a[i][i] + beyond);
        first = a[i][i] > 0.0 ? a[i][i] + length : a[i][i] - length; /* of the vector v = row -+ length e_i to reflect along */
        length = a[i][i] > 0.0 ? -length : length;
        for (int r = i + 1; r < rows; r++) {
            vehest_real along = a[r][i] * first;
            for (int j = i + 1; j < COLUMNS; j++) {
                along += a[r][j] * a[i][j];
            }
            along = 2.0 * along / (first * first + beyond);
            a[r][i] -= along * first;
            for (int j = i + 1; j < COLUMNS; j++) {
                a[r][j] -= along * a[i][j];
            }
        }
        a[i][i] = length;
        for (int j = i + 1; j < COLUMNS; j++) {
            a[i][j] = 0.0;
        }
    }
}

/* x- = A x + B delta,  L- L-' = A L (A L)' + Q: from the last sample to this one. */
static void predict(vehest_method *m)
{
    track t;
    vehest_real array[M + N][COLUMNS] = { {0.0} }, mean[N];

    track_at(m->vx, &t);
    for (int i = 0; i < N; i++) { /* (A L, Q^(1/2)), and the mean */
        mean[i] = i < 2 ? t.B[i] * m->steer : 0.0;
        for (int j = 0; j < N; j++) {
            mean[i] += t.A[i][j] * m->mean[j];
            for (int c = j; c < N; c++) {
                array[i][j] += t.A[i][c] * m->root[c][j];
            }
        }
    }
    array[0][N] = STEER_LEVEL * t.B[0]; /* the steering angle's noise */
    array[1][N] = STEER_LEVEL * t.B[1];
    triangularise(N, array);
    for (int i = 0; i < N; i++) {
        m->mean[i] = mean[i];
        for (int j = 0; j < N; j++) {
            m->root[i][j] = array[i][j];
        }
    }
}

/* The measurement y = (a_y, r), NaN what was not measured: (R^(1/2), H L; 0, L-) becomes (S^(1/2), 0; K S^(1/2), L). */
static void update(vehest_method *m, const vehest_real y[M], vehest_real vx, vehest_real steer)
{
    track t;
    vehest_real array[M + N][COLUMNS] = { {0.0} }, innovation[M];

    track_at(vx, &t);
    for (int i = 0; i < M; i++) {
        vehest_real error = y[i] - (i == 0 ? t.D * steer : 0.0);
        bool known = !VEHEST_IS_NAN(y[i]);
        for (int j = 0; j < N; j++) { /* H x and H L */
            error -= (i == 0 ? t.C[j] : (j == 1 ? 1.0 : 0.0)) * m->mean[j];
            for (int c = j; c < N; c++) {
                array[i][M + j] += (i == 0 ? t.C[c] : (c == 1 ? 1.0 : 0.0)) * m->root[c][j];
            }
        }
        array[i][i] = known ? SENSORS[i] : 1.0;
        innovation[i] = known ? error : 0.0;
        for (int j = 0; j < N && !known; j++) {
            array[i][M + j] = 0.0;
        }
    }
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            array[M + i][M + j] = m->root[i][j];
        }
    }
    triangularise(M + N, array);
    innovation[0] /= array[0][0]; /* S^(-1/2) e */
    innovation[1] = (innovation[1] - array[1][0] * innovation[0]) / array[1][1];
    for (int i = 0; i < N; i++) { /* x = x- + K e */
        m->mean[i] += array[M + i][0] * innovation[0] + array[M + i][1] * innovation[1];
        for (int j = 0; j < N; j++) {
            m->root[i][j] = array[M + i][M + j];
        }
    }
}

void vehest_method_start(vehest_method *m)
{
    for (int i = 0; i < N; i++) {
        m->mean[i] = 0.0;
        for (int j = 0; j < N; j++) {
            m->root[i][j] = 0.0;
        }
    }
    m->root[0][0] = 100.0; /* [rad] */
    m->root[1][1] = 100.0; /* [rad/s] */
    m->vx = 0.0;
    m->steer = 0.0;
    m->started = false;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    const vehest_real y[M] = {sample[VEHEST_AY], sample[VEHEST_YAW_RATE]};
    const vehest_real vx = sample[VEHEST_VX]; /* [m/s] */
    vehest_real tangent, slope;
    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    if (VEHEST_IS_NAN(sample[VEHEST_VX])) {
        return false; /* cannot do without this channel */
    }
    if (VEHEST_IS_NAN(sample[VEHEST_STEER])) {
        return false; /* cannot do without this channel */
    }
    for (int i = 0; i < VEHEST_CHANNELS; i++) { /* infinite values are no measurements */
        if (!VEHEST_IS_NAN(sample[i]) && !VEHEST_IS_FINITE(sample[i])) {
            return false;
        }
    }
    if (m->started) {
        predict(m);
    }
    update(m, y, vx, sample[VEHEST_STEER]);
    m->vx = vx;
    m->steer = sample[VEHEST_STEER];
    m->started = true;
    tangent = VEHEST_TAN(m->mean[0]); /* v = u tan(beta) */
    slope = vx * (1.0 + tangent * tangent) * m->root[0][0];
    output->vy = vx * tangent;
    output->yaw_rate = m->mean[1];
    output->vy_variance = slope * slope;
    return true;
}
