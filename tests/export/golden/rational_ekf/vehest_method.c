/* vehest_method.c: RATTE, extended Kalman filter (rational_ekf, ratte), the method alone.
 * Extended Kalman filter of a single track (Di Biase, Lenzo & Timpone, IEEE Access 8, 2020): states are the sideslip angle beta [rad], the yaw
 * rate r [rad/s], their rates and logarithms of c1_front, c2_front, c1_rear, c2_rear; measured are r and a_y = u (beta' + r).
 * F = c2 mu alpha/(1 + q), q = alpha^2/(c1 (mu + 1)) of each axle. Covariances are kept as square roots,
 * P = L L' (Kaminski, Bryson & Schmidt 1971), which lose no digits of a precise sensor in float.
 */
#include "vehest_method.h"

enum { N = 8, M = 2, COLUMNS = 13 };

static const vehest_real TAU = 0.05; /* sampling time [s] */
static const vehest_real MASS = 982.0; /* [kg] */
static const vehest_real INERTIA = 1605.4145; /* about the vertical axis [kg m^2] */
static const vehest_real FRONT_ARM = 1.33; /* a_F [m] */
static const vehest_real REAR_ARM = 1.07; /* a_R [m] */
static const vehest_real SLOWEST = 3.0; /* wheels roll without slip below it [m/s] */
static const vehest_real SENSORS[M] = {0.5, 0.3}; /* standard deviations of r [rad/s] and a_y [m/s^2] */
static const vehest_real STEER_SPREAD = 0.022360679774997897; /* standard deviation of the steering angle over a step [rad] */
static const vehest_real TYRE_SPREAD = 0.10062305898749054; /* of logarithms of tyre parameters [1] */
static const vehest_real LARGEST[N] = {1.5, 5.0, 20.0, 100.0, 2.0124611797498106, 2.224859546128699, 1.0986122886681098, 1.3416407864998738}; /* what states are kept within */
static const vehest_real ROLLING[4] = {0.05, 0.2, 1.0, 2.0}; /* standard deviations of a motion that is only guessed */
static const vehest_real LARGEST_SIDESLIP = 0.5; /* beta from which on motion and tyres start anew [rad] */
static const vehest_real LOST = 1.0; /* standard deviation of beta from which on the motion is guessed anew [rad] */

/* Lateral force of an axle [N], and what it changes by: per slip [N/rad], per logarithm of a parameter [N]. */
typedef struct {
    vehest_real force, per_slip, per_log_c1;
} axle_force;

static void axle(vehest_real slip, vehest_real c1, vehest_real c2, vehest_real friction, axle_force *a)
{
    const vehest_real bend = slip * slip / (c1 * (friction + 1.0)); /* q */
    const vehest_real share = 1.0 / (1.0 + bend);

    a->force = c2 * friction * slip * share;
    a->per_slip = c2 * friction * (1.0 - bend) * share * share;
    a->per_log_c1 = a->force * bend * share;
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

static void clip(vehest_real mean[N])
{
    for (int i = 0; i < N; i++) {
        mean[i] = mean[i] < -LARGEST[i] ? -LARGEST[i] : mean[i];
        mean[i] = mean[i] > LARGEST[i] ? LARGEST[i] : mean[i];
    }
}

/* Wheels roll without slip: beta = a_R delta/L, r = u delta/L; tyre parameters are held. */
static void roll(vehest_method *m, vehest_real vx, vehest_real steer)
{
    const vehest_real turn = steer / (FRONT_ARM + REAR_ARM);
    vehest_real array[M + N][COLUMNS] = { {0.0} };

    m->mean[0] = REAR_ARM * turn;
    m->mean[1] = vx * turn;
    m->mean[2] = 0.0;
    m->mean[3] = 0.0;
    for (int i = 4; i < N; i++) { /* what is known of the tyres stays, apart from the motion */
        for (int j = 0; j < N; j++) {
            array[i - 4][j] = m->root[i][j];
        }
    }
    triangularise(N - 4, array);
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            m->root[i][j] = i >= 4 && j >= 4 ? array[i - 4][j - 4] : 0.0;
        }
    }
    for (int i = 0; i < 4; i++) {
        m->root[i][i] = ROLLING[i];
    }
}

/* Logarithms of tyre parameters as they were before the first sample. */
static void start_tyres(vehest_method *m)
{
    static const vehest_real TYRES[N - 4][N - 4] = {
    {0.7007997784655192, 0.0, 0.0, 0.0},
    {0.315995843674501, -0.6792169090853265, 0.0, 0.0},
    {0.5683849361650071, -0.0991655918140022, -0.13606349479533722, 0.0},
    {0.43033445220237176, 0.08698081432435043, -0.26822112840914913, -3.2959746043559335e-16}
}; /* root of their covariance */

    for (int i = 4; i < N; i++) {
        m->mean[i] = 0.0;
        for (int j = 4; j < N; j++) {
            m->root[i][j] = TYRES[i - 4][j - 4];
        }
    }
}

/* x- = f(x),  L- L-' = A L (A L)' + tau B Lambda B' (Eqs. 28 to 45): from the last sample to this one. */
static void predict(vehest_method *m)
{
    const vehest_real speed = m->vx > SLOWEST ? m->vx : SLOWEST;
    const vehest_real turn = m->mean[1] / speed;
    const vehest_real along = 1.0 / (MASS * speed);
    const vehest_real c1_front = 0.5 * VEHEST_EXP(m->mean[4]);
    const vehest_real c2_front = 0.3 * VEHEST_EXP(m->mean[5]);
    const vehest_real c1_rear = 0.1 * VEHEST_EXP(m->mean[6]);
    const vehest_real c2_rear = 0.45 * VEHEST_EXP(m->mean[7]);
    const vehest_real friction = 1.0;
    vehest_real per_rate[N], per_turn[N]; /* rows of A for beta' and r' */
    vehest_real array[M + N][COLUMNS] = { {0.0} };
    vehest_real rate, acceleration;
    axle_force front, rear;

    axle(m->steer - m->mean[0] - FRONT_ARM * turn, c1_front, c2_front, friction, &front);
    axle(-m->mean[0] + REAR_ARM * turn, c1_rear, c2_rear, friction, &rear);
    per_rate[0] = -(front.per_slip + rear.per_slip) * along;
    per_rate[1] = (REAR_ARM * rear.per_slip - FRONT_ARM * front.per_slip) / speed * along - 1.0;
    per_rate[2] = 0.0;
    per_rate[3] = 0.0;
    per_turn[0] = (REAR_ARM * rear.per_slip - FRONT_ARM * front.per_slip) / INERTIA;
    per_turn[1] = -(FRONT_ARM * FRONT_ARM * front.per_slip + REAR_ARM * REAR_ARM * rear.per_slip) / (INERTIA * speed);
    per_turn[2] = 0.0;
    per_turn[3] = 0.0;
    per_rate[4] = front.per_log_c1 * along;
    per_turn[4] = FRONT_ARM * front.per_log_c1 / INERTIA;
    per_rate[5] = front.force * along;
    per_turn[5] = FRONT_ARM * front.force / INERTIA;
    per_rate[6] = rear.per_log_c1 * along;
    per_turn[6] = -(REAR_ARM * rear.per_log_c1) / INERTIA;
    per_rate[7] = rear.force * along;
    per_turn[7] = -(REAR_ARM * rear.force) / INERTIA;
    rate = (front.force + rear.force) * along - m->mean[1];
    acceleration = (FRONT_ARM * front.force - REAR_ARM * rear.force) / INERTIA;
    m->mean[0] += TAU * m->mean[2];
    m->mean[1] += TAU * m->mean[3];
    m->mean[2] = rate;
    m->mean[3] = acceleration;

    for (int j = 0; j < N; j++) { /* A L: beta and r are moved by their rates, tyre parameters stay */
        array[0][j] = m->root[0][j] + TAU * m->root[2][j];
        array[1][j] = m->root[1][j] + TAU * m->root[3][j];
        for (int i = j; i < N; i++) {
            array[2][j] += per_rate[i] * m->root[i][j];
            array[3][j] += per_turn[i] * m->root[i][j];
        }
        for (int i = 4; i < N; i++) {
            array[i][j] = m->root[i][j];
        }
    }
    array[2][N] = STEER_SPREAD * front.per_slip * along; /* B of the steering angle */
    array[3][N] = STEER_SPREAD * FRONT_ARM * front.per_slip / INERTIA;
    for (int i = 4; i < N; i++) { /* tyre parameters wander */
        array[i][N + i - 3] = TYRE_SPREAD;
    }
    triangularise(N, array);
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            m->root[i][j] = array[i][j];
        }
    }
    clip(m->mean);
}

/* The measurement y = (r, a_y), NaN what was not measured: (R^(1/2), H L-; 0, L-) becomes (S^(1/2), 0; K S^(1/2), L). */
static void update(vehest_method *m, const vehest_real y[M], vehest_real vx)
{
    const vehest_real expected[M] = {m->mean[1], vx * (m->mean[2] + m->mean[1])};
    vehest_real array[M + N][COLUMNS] = { {0.0} }, innovation[M];

    for (int i = 0; i < M; i++) {
        bool known = !VEHEST_IS_NAN(y[i]);
        for (int j = 0; j < N; j++) { /* H L: rows of r and of u (beta' + r) */
            array[i][M + j] = i == 0 ? m->root[1][j] : vx * (m->root[2][j] + m->root[1][j]);
        }
        array[i][i] = known ? SENSORS[i] : 1.0;
        innovation[i] = known ? y[i] - expected[i] : 0.0;
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
    clip(m->mean);
}

void vehest_method_start(vehest_method *m)
{
    for (int i = 0; i < N; i++) {
        m->mean[i] = 0.0;
        for (int j = 0; j < N; j++) {
            m->root[i][j] = 0.0;
        }
    }
    for (int i = 0; i < 4; i++) {
        m->root[i][i] = ROLLING[i];
    }
    start_tyres(m);
    m->vx = 0.0;
    m->steer = 0.0;
    m->started = false;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    const vehest_real y[M] = {sample[VEHEST_YAW_RATE], sample[VEHEST_AY]};
    const vehest_real vx = sample[VEHEST_VX];       /* [m/s] */
    const vehest_real steer = sample[VEHEST_STEER]; /* [rad] */
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
    if (vx < SLOWEST) {
        roll(m, vx, steer);
    } else {
        if (m->started) {
            predict(m);
            if (!(VEHEST_ABS(m->mean[0]) < LARGEST_SIDESLIP)) { /* the tyres are taken to be the reason */
                roll(m, vx, steer);
                start_tyres(m);
            } else if (!(VEHEST_ABS(m->root[0][0]) < LOST)) {
                roll(m, vx, steer);
            }
        }
        update(m, y, vx);
    }
    m->vx = vx;
    m->steer = steer;
    m->started = true;
    tangent = VEHEST_TAN(m->mean[0]); /* v = u tan(beta) */
    slope = vx * (1.0 + tangent * tangent) * m->root[0][0];
    output->vy = vx * tangent;
    output->yaw_rate = m->mean[1];
    output->vy_variance = slope * slope;
    return true;
}
