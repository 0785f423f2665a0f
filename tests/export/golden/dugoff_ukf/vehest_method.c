/* vehest_method.c: UKF with Dugoff tyres, without tyre forces (dugoff_ukf, dugoff_imu), the method alone.
 * Unscented Kalman filter of a single track on Dugoff's tyres (Bertipaglia et al. 2024): states are the lateral velocity v [m/s] and the yaw
 * rate r [rad/s]; measured are a_y, r.
 *     v' = (F_F cos(delta) + F_R)/m - u r,  r' = (l_F F_F cos(delta) - l_R F_R)/I    (Eq. 2), held over a sample
 *     F = C tan(alpha) f(lambda),  lambda = mu F_z/(2 C |tan(alpha)|)    (Eq. 9 at kappa = 0)
 */
#include "vehest_method.h"

enum { N = 2, M = 2, POINTS = 5 };

static const vehest_real SPREAD = 1.7320508075688772; /* of sigma points, in columns of the covariance's factor [1] */
static const vehest_real CENTRE_MEAN = 0.3333333333333333; /* weight of the mean point in means [1] */
static const vehest_real CENTRE_COVARIANCE = 0.3333333333333333; /* and in covariances [1] */
static const vehest_real OTHER = 0.16666666666666666; /* weight of each other point, in both [1] */
static const vehest_real MARGIN = 1e-06; /* smallest eigenvalue of a repaired covariance over its largest [1] */

static const vehest_real TAU = 0.01; /* sampling time [s] */
static const vehest_real MASS = 1970.0; /* [kg] */
static const vehest_real INERTIA = 3498.0; /* about the vertical axis [kg m^2] */
static const vehest_real FRONT_ARM = 1.47; /* l_F [m] */
static const vehest_real REAR_ARM = 1.41; /* l_R [m] */
static const vehest_real TRANSFER = 0.18055555555555558; /* h/L: load that an acceleration shifts [1] */
static const vehest_real LOAD_FRONT = 4.8028125; /* at rest, per mass [m/s^2] */
static const vehest_real LOAD_REAR = 5.007187500000001; /* [m/s^2] */
static const vehest_real SLOWEST = 3.0; /* wheels roll without slip below it, and nothing counts as measured [m/s] */
static const vehest_real ROLLING[N] = { 0.25, 0.04000000000000001 }; /* variances of a motion that nobody knows, and of a car that rolls */
static const vehest_real PROCESS[N] = { 0.25, 0.09 }; /* variances of a step */
static const vehest_real SENSORS[2][2] = {
    { 0.010000000000000002, 0.2025 },
    { 0.010000000000000002, 0.2025 }
}; /* variances of measurements, where the car is linear and where not */

/* What all points share of a sample. */
typedef struct {
    vehest_real vx, tangent, cosine, load_front, load_rear; /* [m/s], of the steering angle [1], [N] */
} settled;

static void settle(const vehest_real inputs[3], settled *at)
{
    const vehest_real front = LOAD_FRONT - inputs[2] * TRANSFER, rear = LOAD_REAR + inputs[2] * TRANSFER;

    at->vx = inputs[0] > SLOWEST ? inputs[0] : SLOWEST;
    at->tangent = VEHEST_TAN(inputs[1]);
    at->cosine = VEHEST_COS(inputs[1]);
    at->load_front = MASS * (front > 0.1 * LOAD_FRONT ? front : 0.1 * LOAD_FRONT);
    at->load_rear = MASS * (rear > 0.1 * LOAD_REAR ? rear : 0.1 * LOAD_REAR);
}

/* Eq. 9: lateral force of an axle [N] from the tangent of its slip angle; axle: C [N/rad], mu_0 [1], e_r [s/m]. */
static vehest_real axle_force(vehest_real tangent, vehest_real load, vehest_real vx, const vehest_real axle[3])
{
    const vehest_real slide = VEHEST_ABS(tangent);
    vehest_real share = 1.0 - axle[2] * vx * slide, half, ratio;

    share = share < 0.2 ? 0.2 : share;
    half = axle[1] * share * load / (2.0 * axle[0]);
    if (half >= 1.0 * slide) {
        return axle[0] * tangent;
    }
    ratio = half / slide;
    return axle[0] * tangent * (ratio * (2.0 - ratio));
}

/* Forces of both axles across the body, F_F cos(delta) and F_R [N], at a state. */
static void forces_at(const vehest_real state[N], const settled *at, vehest_real *front, vehest_real *rear)
{
    static const vehest_real FRONT[3] = { 0.45, 0.25, 0.05 }, REAR[3] = { 0.4, 0.2, 0.55 };
    const vehest_real course_front = (state[0] + FRONT_ARM * state[1]) / at->vx;
    const vehest_real course_rear = (state[0] - REAR_ARM * state[1]) / at->vx;
    const vehest_real across = 1.0 + at->tangent * course_front;
    const vehest_real cosine = across > 0.05 ? across : 0.05;

    *front = axle_force((at->tangent - course_front) / cosine, at->load_front, at->vx, FRONT) * at->cosine;
    *rear = axle_force(-course_rear, at->load_rear, at->vx, REAR);
}

/* Lower factor L of a symmetric matrix, L L' = a; false where it is not positive definite, or not finite. */
static bool cholesky_n(vehest_real a[N][N], vehest_real lower[N][N])
{
    for (int j = 0; j < N; j++) {
        vehest_real total = a[j][j];
        for (int k = 0; k < j; k++) {
            total -= lower[j][k] * lower[j][k];
        }
        if (!(total > 0.0)) {
            return false;
        }
        lower[j][j] = VEHEST_SQRT(total);
        if (!VEHEST_IS_FINITE(lower[j][j])) {
            return false;
        }
        for (int i = 0; i < N; i++) {
            if (i < j) {
                lower[i][j] = 0.0;
            } else if (i > j) {
                total = a[i][j];
                for (int k = 0; k < j; k++) {
                    total -= lower[i][k] * lower[j][k];
                }
                lower[i][j] = total / lower[j][j];
                if (!VEHEST_IS_FINITE(lower[i][j])) {
                    return false;
                }
            }
        }
    }
    return true;
}

static bool finite_n(vehest_real a[N][N])
{
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            if (!VEHEST_IS_FINITE(a[i][j])) {
                return false;
            }
        }
    }
    return true;
}

static void lose_n(vehest_real a[N][N])
{
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            a[i][j] = VEHEST_NAN;
        }
    }
}

/* Add to the eigenvalues of a symmetric matrix what MARGIN needs, and factorise; eigenvalues by Jacobi's rotations. */
static bool lifted_n(vehest_real a[N][N], vehest_real lower[N][N])
{
    vehest_real w[N][N], smallest, largest = 0.0;

    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            w[i][j] = a[i][j];
        }
    }
    for (int sweep = 0; sweep < 30; sweep++) { /* few are needed: convergence is quadratic */
        vehest_real off = 0.0;
        for (int p = 0; p < N; p++) {
            for (int q = p + 1; q < N; q++) {
                vehest_real theta, t, c, s;
                off += VEHEST_ABS(w[p][q]);
                if (!(VEHEST_ABS(w[p][q]) > 0.0)) {
                    continue;
                }
                theta = (w[q][q] - w[p][p]) / (2.0 * w[p][q]); /* cot(2 phi) */
                t = 1.0 / (VEHEST_ABS(theta) + VEHEST_SQRT(theta * theta + 1.0));
                t = theta < 0.0 ? -t : t;
                c = 1.0 / VEHEST_SQRT(t * t + 1.0);
                s = t * c;
                for (int k = 0; k < N; k++) { /* columns */
                    const vehest_real first = w[k][p], second = w[k][q];
                    w[k][p] = c * first - s * second;
                    w[k][q] = s * first + c * second;
                }
                for (int k = 0; k < N; k++) { /* rows */
                    const vehest_real first = w[p][k], second = w[q][k];
                    w[p][k] = c * first - s * second;
                    w[q][k] = s * first + c * second;
                }
                w[p][q] = 0.0;
                w[q][p] = 0.0;
            }
        }
        if (!(off > 0.0)) {
            break;
        }
    }
    smallest = w[0][0];
    for (int i = 0; i < N; i++) {
        smallest = w[i][i] < smallest ? w[i][i] : smallest;
        largest = VEHEST_ABS(w[i][i]) > largest ? VEHEST_ABS(w[i][i]) : largest;
    }
    for (int i = 0; i < N; i++) {
        a[i][i] += MARGIN * largest - smallest;
    }
    return cholesky_n(a, lower);
}

/* Lower factor L of a symmetric matrix, L L' = a; false where it is not positive definite, or not finite. */
static bool cholesky_m(vehest_real a[M][M], vehest_real lower[M][M])
{
    for (int j = 0; j < M; j++) {
        vehest_real total = a[j][j];
        for (int k = 0; k < j; k++) {
            total -= lower[j][k] * lower[j][k];
        }
        if (!(total > 0.0)) {
            return false;
        }
        lower[j][j] = VEHEST_SQRT(total);
        if (!VEHEST_IS_FINITE(lower[j][j])) {
            return false;
        }
        for (int i = 0; i < M; i++) {
            if (i < j) {
                lower[i][j] = 0.0;
            } else if (i > j) {
                total = a[i][j];
                for (int k = 0; k < j; k++) {
                    total -= lower[i][k] * lower[j][k];
                }
                lower[i][j] = total / lower[j][j];
                if (!VEHEST_IS_FINITE(lower[i][j])) {
                    return false;
                }
            }
        }
    }
    return true;
}

static bool finite_m(vehest_real a[M][M])
{
    for (int i = 0; i < M; i++) {
        for (int j = 0; j < M; j++) {
            if (!VEHEST_IS_FINITE(a[i][j])) {
                return false;
            }
        }
    }
    return true;
}

static void lose_m(vehest_real a[M][M])
{
    for (int i = 0; i < M; i++) {
        for (int j = 0; j < M; j++) {
            a[i][j] = VEHEST_NAN;
        }
    }
}

/* Add to the eigenvalues of a symmetric matrix what MARGIN needs, and factorise; eigenvalues by Jacobi's rotations. */
static bool lifted_m(vehest_real a[M][M], vehest_real lower[M][M])
{
    vehest_real w[M][M], smallest, largest = 0.0;

    for (int i = 0; i < M; i++) {
        for (int j = 0; j < M; j++) {
            w[i][j] = a[i][j];
        }
    }
    for (int sweep = 0; sweep < 30; sweep++) { /* few are needed: convergence is quadratic */
        vehest_real off = 0.0;
        for (int p = 0; p < M; p++) {
            for (int q = p + 1; q < M; q++) {
                vehest_real theta, t, c, s;
                off += VEHEST_ABS(w[p][q]);
                if (!(VEHEST_ABS(w[p][q]) > 0.0)) {
                    continue;
                }
                theta = (w[q][q] - w[p][p]) / (2.0 * w[p][q]); /* cot(2 phi) */
                t = 1.0 / (VEHEST_ABS(theta) + VEHEST_SQRT(theta * theta + 1.0));
                t = theta < 0.0 ? -t : t;
                c = 1.0 / VEHEST_SQRT(t * t + 1.0);
                s = t * c;
                for (int k = 0; k < M; k++) { /* columns */
                    const vehest_real first = w[k][p], second = w[k][q];
                    w[k][p] = c * first - s * second;
                    w[k][q] = s * first + c * second;
                }
                for (int k = 0; k < M; k++) { /* rows */
                    const vehest_real first = w[p][k], second = w[q][k];
                    w[p][k] = c * first - s * second;
                    w[q][k] = s * first + c * second;
                }
                w[p][q] = 0.0;
                w[q][p] = 0.0;
            }
        }
        if (!(off > 0.0)) {
            break;
        }
    }
    smallest = w[0][0];
    for (int i = 0; i < M; i++) {
        smallest = w[i][i] < smallest ? w[i][i] : smallest;
        largest = VEHEST_ABS(w[i][i]) > largest ? VEHEST_ABS(w[i][i]) : largest;
    }
    for (int i = 0; i < M; i++) {
        a[i][i] += MARGIN * largest - smallest;
    }
    return cholesky_m(a, lower);
}

/* Sigma points: the mean, and mean +- SPREAD columns of the covariance's factor; a covariance that is not positive definite is repaired, in place. */
static void draw(vehest_real mean[N], vehest_real cov[N][N], vehest_real points[POINTS][N])
{
    vehest_real factor[N][N];

    if (!cholesky_n(cov, factor)) {
        if (!(finite_n(cov) && lifted_n(cov, factor))) {
            lose_n(cov);
            lose_n(factor);
        }
    }
    for (int i = 0; i < N; i++) {
        points[0][i] = mean[i];
        for (int j = 0; j < N; j++) {
            const vehest_real offset = SPREAD * factor[i][j];
            points[1 + j][i] = mean[i] + offset;
            points[1 + N + j][i] = mean[i] - offset;
        }
    }
}

/* Weighted mean and covariance of what became of the points, plus noise. */
static void moments(vehest_real moved[POINTS][N], vehest_real noise[N][N], vehest_real mean[N], vehest_real cov[N][N])
{
    vehest_real deviation[POINTS][N];

    for (int i = 0; i < N; i++) {
        vehest_real total = 0.0;
        for (int s = 1; s < POINTS; s++) {
            total += moved[s][i];
        }
        mean[i] = CENTRE_MEAN * moved[0][i] + OTHER * total;
        for (int s = 0; s < POINTS; s++) {
            deviation[s][i] = moved[s][i] - mean[i];
        }
    }
    for (int i = 0; i < N; i++) {
        for (int j = 0; j <= i; j++) {
            vehest_real total = 0.0;
            for (int s = 1; s < POINTS; s++) {
                total += deviation[s][i] * deviation[s][j];
            }
            total = OTHER * total + CENTRE_COVARIANCE * deviation[0][i] * deviation[0][j];
            cov[i][j] = total + 0.5 * (noise[i][j] + noise[j][i]);
            cov[j][i] = cov[i][j];
        }
    }
}

/* Covariance of states with what is expected, and S of that with noise, with its factor; whether S is positive definite. */
static bool joint(vehest_real spread[POINTS][M], vehest_real deviation[POINTS][N], vehest_real centre, const bool known[M],
                  vehest_real noise[M][M], vehest_real cross[N][M], vehest_real S[M][M], vehest_real factor[M][M])
{
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < M; j++) {
            vehest_real total = 0.0;
            for (int s = 1; s < POINTS; s++) {
                total += deviation[s][i] * spread[s][j];
            }
            cross[i][j] = OTHER * total + centre * deviation[0][i] * spread[0][j];
        }
    }
    for (int i = 0; i < M; i++) {
        for (int j = 0; j <= i; j++) {
            vehest_real total = 0.0;
            for (int s = 1; s < POINTS; s++) {
                total += spread[s][i] * spread[s][j];
            }
            total = OTHER * total + centre * spread[0][i] * spread[0][j];
            if (known[i] && known[j]) {
                total += 0.5 * (noise[i][j] + noise[j][i]);
            } else if (i == j) {
                total += 1.0;
            }
            S[i][j] = total;
            S[j][i] = total;
        }
    }
    return cholesky_m(S, factor);
}

/* K = cross S^-1, by the factor of S, and the covariance that is left, P - K cross'. */
static void posterior(vehest_real cov[N][N], vehest_real cross[N][M], vehest_real factor[M][M], vehest_real gain[N][M], vehest_real left[N][N])
{
    for (int i = 0; i < N; i++) {
        vehest_real whitened[M];
        for (int j = 0; j < M; j++) {
            vehest_real total = cross[i][j];
            for (int c = 0; c < j; c++) {
                total -= factor[j][c] * whitened[c];
            }
            whitened[j] = total / factor[j][j];
        }
        for (int j = M - 1; j >= 0; j--) {
            vehest_real total = whitened[j];
            for (int c = j + 1; c < M; c++) {
                total -= factor[c][j] * gain[i][c];
            }
            gain[i][j] = total / factor[j][j];
        }
    }
    for (int i = 0; i < N; i++) {
        for (int j = 0; j <= i; j++) {
            vehest_real total = 0.5 * (cov[i][j] + cov[j][i]);
            for (int c = 0; c < M; c++) {
                total -= 0.5 * (gain[i][c] * cross[j][c] + gain[j][c] * cross[i][c]);
            }
            left[i][j] = total;
            left[j][i] = total;
        }
    }
}

/* The state given a measurement y, NaN what was not measured, of which `expected` holds at the points. */
static void update(vehest_real mean[N], vehest_real cov[N][N], vehest_real points[POINTS][N], vehest_real expected[POINTS][M],
                   const vehest_real y[M], vehest_real noise[M][M])
{
    vehest_real spread[POINTS][M], deviation[POINTS][N], innovation[M], cross[N][M], S[M][M], factor[M][M], gain[N][M], left[N][N];
    bool known[M], definite;

    for (int i = 0; i < M; i++) {
        vehest_real total = 0.0, centre;
        for (int s = 1; s < POINTS; s++) {
            total += expected[s][i];
        }
        centre = CENTRE_MEAN * expected[0][i] + OTHER * total;
        known[i] = !VEHEST_IS_NAN(y[i]);
        innovation[i] = known[i] ? y[i] - centre : 0.0;
        for (int s = 0; s < POINTS; s++) {
            spread[s][i] = known[i] ? expected[s][i] - centre : 0.0;
        }
    }
    for (int s = 0; s < POINTS; s++) {
        for (int i = 0; i < N; i++) {
            deviation[s][i] = points[s][i] - mean[i];
        }
    }
    definite = joint(spread, deviation, CENTRE_COVARIANCE, known, noise, cross, S, factor);
    if (definite) {
        posterior(cov, cross, factor, gain, left);
    }
    if (!definite) {
        if (!(finite_m(S) && lifted_m(S, factor))) {
            lose_m(factor);
        }
        posterior(cov, cross, factor, gain, left);
    }
    for (int i = 0; i < N; i++) { /* x = x- + K e */
        for (int c = 0; c < M; c++) {
            mean[i] += gain[i][c] * innovation[c];
        }
        for (int j = 0; j < N; j++) {
            cov[i][j] = left[i][j];
        }
    }
}

/* From the last sample to this one, with the variances of the step. */
static void predict(vehest_method *m, const vehest_real process[N])
{
    vehest_real points[POINTS][N], noise[N][N] = { {0.0} };
    const vehest_real turn = m->last[0] * m->last[1] / (FRONT_ARM + REAR_ARM);
    settled at;

    settle(m->last, &at);
    draw(m->mean, m->cov, points);
    for (int s = 0; s < POINTS; s++) {
        vehest_real front, rear, v = points[s][0];
        if (m->last[0] < SLOWEST) { /* wheels roll without slip */
            points[s][0] = REAR_ARM * turn;
            points[s][1] = turn;
            continue;
        }
        forces_at(points[s], &at, &front, &rear);
        v += TAU * ((front + rear) / MASS - at.vx * points[s][1]);
        points[s][1] += TAU * (FRONT_ARM * front - REAR_ARM * rear) / INERTIA;
        points[s][0] = v;
    }
    for (int i = 0; i < N; i++) {
        noise[i][i] = process[i];
    }
    moments(points, noise, m->mean, m->cov);
}

void vehest_method_start(vehest_method *m)
{
    for (int i = 0; i < N; i++) {
        m->mean[i] = 0.0;
        for (int j = 0; j < N; j++) {
            m->cov[i][j] = i == j ? ROLLING[i] : 0.0;
        }
    }
    for (int i = 0; i < 3; i++) {
        m->last[i] = 0.0;
    }
    m->started = false;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    const vehest_real inputs[3] = {sample[VEHEST_VX], sample[VEHEST_STEER], sample[VEHEST_AX]};
    const bool slow = inputs[0] < SLOWEST;
    vehest_real points[POINTS][N], expected[POINTS][M], y[M], noise[M][M] = { {0.0} };
    settled at;
    int sensors = 0;

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
    if (VEHEST_IS_NAN(sample[VEHEST_AX])) {
        return false; /* cannot do without this channel */
    }
    for (int i = 0; i < VEHEST_CHANNELS; i++) { /* infinite values are no measurements */
        if (!VEHEST_IS_NAN(sample[i]) && !VEHEST_IS_FINITE(sample[i])) {
            return false;
        }
    }
    y[0] = sample[VEHEST_AY];
    y[1] = sample[VEHEST_YAW_RATE];
    for (int i = 0; i < 2; i++) {
        noise[i][i] = SENSORS[sensors][i];
    }
    if (m->started) {
        predict(m, m->last[0] < SLOWEST ? ROLLING : PROCESS);
    } else if (slow) {
        m->mean[1] = inputs[0] * inputs[1] / (FRONT_ARM + REAR_ARM);
        m->mean[0] = REAR_ARM * m->mean[1];
    }
    settle(inputs, &at);
    draw(m->mean, m->cov, points);
    for (int s = 0; s < POINTS; s++) { /* what is expected at the points (Eq. 4) */
        vehest_real front, rear;
        forces_at(points[s], &at, &front, &rear);
        expected[s][0] = (front + rear) / MASS;
        expected[s][1] = points[s][1];
    }
    for (int i = 0; i < M && slow; i++) {
        y[i] = VEHEST_NAN; /* nothing counts as measured */
    }
    update(m->mean, m->cov, points, expected, y, noise);
    for (int i = 0; i < 3; i++) {
        m->last[i] = inputs[i];
    }
    m->started = true;
    output->vy = m->mean[0];
    output->yaw_rate = m->mean[1];
    output->vy_variance = m->cov[0][0];
    return true;
}
