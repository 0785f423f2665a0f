/* vehest_method.c: Learned UKF, Pacejka's tyres, learnt through the filter (learned_ukf, pc_u), the method alone.
 * Unscented Kalman filter of a planar car whose dynamics and noise were learnt (Wegrzynowski et al. 2024): states are vx [m/s], vy [m/s],
 * yaw rate [rad/s], rim speed [m/s] and friction [1]; measured are a_x, a_y, yaw rate and rim speed; inputs are steering angle and current.
 * Dynamics: pacejka; noise: constant.
 */
#include "vehest_method.h"

enum { N = 5, M = 4, POINTS = 11 };

static const vehest_real SPREAD = 1.7320508075688772; /* of sigma points, in columns of the covariance's factor [1] */
static const vehest_real CENTRE_MEAN = -0.6666666666666666; /* weight of the mean point in means [1] */
static const vehest_real CENTRE_COVARIANCE = -0.6666666666666666; /* and in covariances [1] */
static const vehest_real OTHER = 0.16666666666666666; /* weight of each other point, in both [1] */
static const vehest_real MARGIN = 1e-06; /* smallest eigenvalue of a repaired covariance over its largest [1] */
static const vehest_real LOWER[N] = {0.05, -VEHEST_INFINITY, -VEHEST_INFINITY, -VEHEST_INFINITY, 0.05}; /* smallest possible states */

static const vehest_real TAU = 0.01; /* sampling time [s] */
static const vehest_real MASS = 5.1; /* [kg] */
static const vehest_real REAR_ARM = 1.6487212707001282; /* centre of gravity to rear axle [m] */
static const vehest_real FRONT_ARM = -1.3187212707001281; /* to front axle [m] */
static const vehest_real INERTIA = 1.3498588075760032; /* about the vertical axis [kg m^2] */
static const vehest_real DRAG[3] = {1.4918246976412703, 1.3498588075760032, 1.5683121854901687}; /* [N, N s/m, N s^2/m^2] */
static const vehest_real POWERTRAIN = 1.1051709180756477; /* inertia [kg m^2] */
static const vehest_real TORQUE = 1.6487212707001282; /* [N m/A] */
static const vehest_real VISCOUS = 1.7332530178673953; /* [N s] */
static const vehest_real COULOMB = 1.7332530178673953; /* [N m] */
static const vehest_real RADIUS = 0.05; /* of the wheels [m] */
static const vehest_real FRICTION = 1.0512710963760241; /* learnt once, and not the state's [1] */
static const vehest_real FRONT_LOAD = 249.96113301332758; /* at rest [N] */
static const vehest_real REAR_LOAD = -199.93013301332758; /* [N] */
static const vehest_real CURVES[3][3] = {
    {1.4190675485932571, 1.4190675485932571, 1.4190675485932571},
    {1.7332530178673953, 1.7332530178673953, 1.7332530178673953},
    {1.6487212707001282, 1.6487212707001282, 1.6487212707001282}
}; /* Pacejka's B, C, D along, and across at front and rear axle [1] */

/* What all points share of a sample: steering angle [rad], its sine and cosine [1], current [A]. */
typedef struct {
    vehest_real steer, sine, cosine, current;
} drive;

static void drive_of(const vehest_real inputs[2], drive *u)
{
    u->steer = inputs[0];
    u->sine = VEHEST_SIN(inputs[0]);
    u->cosine = VEHEST_COS(inputs[0]);
    u->current = inputs[1];
}

/* Pacejka's curve, sin(C atan(B slip)), for a peak of 1. */
static vehest_real curve_of(vehest_real slip, const vehest_real curve[3])
{
    return VEHEST_SIN(curve[1] * VEHEST_ATAN(curve[0] * slip));
}

static vehest_real sign_of(vehest_real x)
{
    if (x > 0.0) {
        return 1.0;
    }
    return x < 0.0 ? -1.0 : x;
}

/* What an accelerometer reads, a_x and a_y [m/s^2], and the rates of yaw rate [rad/s^2] and rim speed [m/s^2]. */
static void motion(const vehest_real x[N], const drive *u, vehest_real out[4])
{
    const vehest_real along = x[0] + 1e-06;
    const vehest_real slip_front = VEHEST_ATAN((x[1] + FRONT_ARM * x[2]) / along) - u->steer; /* [rad] */
    const vehest_real slip_rear = VEHEST_ATAN((x[1] - REAR_ARM * x[2]) / along);               /* [rad] */
    const vehest_real ratio = (x[3] - x[0]) / along;                                           /* [1] */
    vehest_real rear_x, front_x, rear_y, front_y, sideways, drag; /* [N] */
    const vehest_real pull = FRICTION * CURVES[0][2] * curve_of(ratio, CURVES[0]);

    rear_x = REAR_LOAD * pull;
    front_x = FRONT_LOAD * pull;
    rear_y = -FRICTION * CURVES[2][2] * REAR_LOAD * curve_of(slip_rear, CURVES[2]);
    front_y = -FRICTION * CURVES[1][2] * FRONT_LOAD * curve_of(slip_front, CURVES[1]);
    sideways = front_x * u->sine + front_y * u->cosine;
    drag = DRAG[0] * sign_of(x[0]) + DRAG[1] * x[0] + DRAG[2] * x[0] * x[0];
    out[0] = (rear_x + front_x * u->cosine - front_y * u->sine - drag) / MASS;
    out[1] = (sideways + rear_y) / MASS;
    out[2] = (sideways * FRONT_ARM - rear_y * REAR_ARM) / INERTIA;
    out[3] = RADIUS / POWERTRAIN * (TORQUE * u->current - RADIUS * (front_x + rear_x) - VISCOUS * x[3] - COULOMB * sign_of(x[3]));
}

/* One sample later, by the Runge-Kutta method; the friction stays. */
static void advance(vehest_real x[N], const drive *u)
{
    vehest_real at[N], rates[4], out[4], total[4] = {0.0, 0.0, 0.0, 0.0};

    for (int i = 0; i < N; i++) {
        at[i] = x[i];
    }
    for (int stage = 0; stage < 4; stage++) {
        motion(at, u, out);
        rates[0] = out[0] + at[1] * at[2]; /* dvx/dt = a_x + vy r */
        rates[1] = out[1] - at[0] * at[2]; /* dvy/dt = a_y - vx r */
        rates[2] = out[2];
        rates[3] = out[3];
        for (int i = 0; i < 4; i++) {
            total[i] += stage == 0 || stage == 3 ? rates[i] : 2.0 * rates[i];
            at[i] = x[i] + (stage == 2 ? TAU : 0.5 * TAU) * rates[i];
        }
    }
    for (int i = 0; i < 4; i++) {
        x[i] += TAU / 6.0 * total[i];
    }
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
        for (int s = 0; s < POINTS; s++) {
            points[s][i] = points[s][i] < LOWER[i] ? LOWER[i] : points[s][i];
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
        mean[i] = mean[i] < LOWER[i] ? LOWER[i] : mean[i];
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
    vehest_real tried[N][N];
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
    if (!(definite && cholesky_n(left, tried)) && finite_m(S) && finite_n(cov)) {
        /* the negative weight of the mean point took their definiteness: without it */
        definite = joint(spread, deviation, 0.0, known, noise, cross, S, factor);
        if (definite) {
            posterior(cov, cross, factor, gain, left);
        }
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
        mean[i] = mean[i] < LOWER[i] ? LOWER[i] : mean[i];
        for (int j = 0; j < N; j++) {
            cov[i][j] = left[i][j];
        }
    }
}

/* Covariance of a step. */
static void process_noise(vehest_real out[N][N])
{
    static const vehest_real CONSTANT[N][N] = {
    {0.0030251000000000006, 0.008662500000000002, 0.00041250000000000005, 0.015125000000000003, 0.00495},
    {0.008662500000000002, 0.0324626, 0.0064312499999999995, 0.058625000000000003, 0.0168},
    {0.00041250000000000005, 0.0064312499999999995, 0.00455635, 0.0148125, 0.0065249999999999996},
    {0.015125000000000003, 0.058625000000000003, 0.0148125, 0.1743751, 0.058875},
    {0.00495, 0.0168, 0.0065249999999999996, 0.058875, 0.03307510000000001}
};

    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            out[i][j] = CONSTANT[i][j];
        }
    }
}

/* Covariance of measurements. */
static void observation_noise(vehest_real out[M][M])
{
    static const vehest_real CONSTANT[M][M] = {
    {0.0036000999999999997, 0.0033000000000000004, 0.0052499999999999995, 0.0018},
    {0.0033000000000000004, 0.06428135000000001, 0.009143749999999999, 0.02206875},
    {0.0052499999999999995, 0.009143749999999999, 0.027562599999999996, 0.011418749999999998},
    {0.0018, 0.02206875, 0.011418749999999998, 0.010968849999999999}
};

    for (int i = 0; i < M; i++) {
        for (int j = 0; j < M; j++) {
            out[i][j] = CONSTANT[i][j];
        }
    }
}

void vehest_method_start(vehest_method *m)
{
    for (int i = 0; i < N; i++) {
        m->mean[i] = 0.0;
        for (int j = 0; j < N; j++) {
            m->cov[i][j] = 0.0;
        }
    }
    m->inputs[0] = 0.0;
    m->inputs[1] = 0.0;
    m->started = false;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    static const vehest_real INITIAL[N][N] = {
    {0.2530251, 0.008662500000000002, 0.00041250000000000005, 0.015125000000000003, 0.00495},
    {0.008662500000000002, 0.1224626, 0.0064312499999999995, 0.058625000000000003, 0.0168},
    {0.00041250000000000005, 0.0064312499999999995, 0.014556350000000003, 0.0148125, 0.0065249999999999996},
    {0.015125000000000003, 0.058625000000000003, 0.0148125, 0.18437510000000001, 0.058875},
    {0.00495, 0.0168, 0.0065249999999999996, 0.058875, 0.03307510000000001}
}; /* of a start that nobody hands over */
    const vehest_real y[M] = {sample[VEHEST_AX], sample[VEHEST_AY], sample[VEHEST_YAW_RATE], RADIUS * sample[VEHEST_MOTOR_SPEED]};
    vehest_real points[POINTS][N], expected[POINTS][M], process[N][N], noise[M][M];
    drive u;

    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    for (int i = 0; i < VEHEST_CHANNELS; i++) { /* infinite values are no measurements */
        if (!VEHEST_IS_NAN(sample[i]) && !VEHEST_IS_FINITE(sample[i])) {
            return false;
        }
    }
    if (m->started) { /* from the last sample to this one */
        process_noise(process);
        drive_of(m->inputs, &u);
        draw(m->mean, m->cov, points);
        for (int s = 0; s < POINTS; s++) {
            advance(points[s], &u);
        }
        moments(points, process, m->mean, m->cov);
    } else { /* from what is measured */
        const vehest_real rim = VEHEST_IS_NAN(y[3]) ? 0.0 : y[3];
        m->mean[0] = rim > LOWER[0] ? rim : LOWER[0];
        m->mean[2] = VEHEST_IS_NAN(y[2]) ? 0.0 : y[2];
        m->mean[3] = rim;
        m->mean[4] = 0.6;
        for (int i = 0; i < N; i++) {
            for (int j = 0; j < N; j++) {
                m->cov[i][j] = INITIAL[i][j];
            }
        }
    }
    m->inputs[0] = VEHEST_IS_NAN(sample[VEHEST_STEER]) ? m->inputs[0] : sample[VEHEST_STEER];
    m->inputs[1] = VEHEST_IS_NAN(sample[VEHEST_MOTOR_CURRENT]) ? m->inputs[1] : sample[VEHEST_MOTOR_CURRENT];
    observation_noise(noise);
    drive_of(m->inputs, &u);
    draw(m->mean, m->cov, points);
    for (int s = 0; s < POINTS; s++) { /* what is expected at the points */
        motion(points[s], &u, expected[s]);
        expected[s][2] = points[s][2];
        expected[s][3] = points[s][3];
    }
    update(m->mean, m->cov, points, expected, y, noise);
    m->started = true;
    output->vx = m->mean[0];
    output->vy = m->mean[1];
    output->yaw_rate = m->mean[2];
    output->vy_variance = m->cov[1][1];
    return true;
}
