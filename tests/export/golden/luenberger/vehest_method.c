/* vehest_method.c: Luenberger (luenberger, luenberger), the method alone.
 * Kinematic observer with both poles at -alpha |omega| (Farrelly & Wellstead 1996; Da Lio et al. 2023, Appendix A), by implicit Euler:
 * (I - tau A) x+ = x + tau b,  A = [[0, -alpha^2 omega], [omega, -2 alpha |omega|]],
 * b = [a_y + (alpha^2 - 1) omega u_m, a_x + 2 alpha |omega| u_m].
 */
#include "vehest_method.h"

static const vehest_real TAU = 0.01;   /* sampling time [s] */
static const vehest_real ALPHA = 0.4; /* gain [1] */
static const vehest_real STILL = 0.1; /* |yaw rate| below which the state is reset [rad/s] */

void vehest_method_start(vehest_method *m)
{
    m->v = 0.0;
    m->u = VEHEST_NAN;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    const vehest_real omega = sample[VEHEST_YAW_RATE]; /* [rad/s] */
    const vehest_real speed = sample[VEHEST_VX];       /* [m/s] */
    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    if (VEHEST_IS_NAN(sample[VEHEST_YAW_RATE])) {
        return false; /* cannot do without this channel */
    }
    if (VEHEST_IS_NAN(sample[VEHEST_VX])) {
        return false; /* cannot do without this channel */
    }
    if (VEHEST_IS_NAN(sample[VEHEST_AY])) {
        return false; /* cannot do without this channel */
    }
    if (VEHEST_IS_NAN(sample[VEHEST_AX])) {
        return false; /* cannot do without this channel */
    }
    if (VEHEST_IS_NAN(m->u)) {
        m->u = speed;
    }
    if (VEHEST_ABS(omega) < STILL) {
        m->v = 0.0; /* nothing is observable without turning */
        m->u = speed;
    } else {
        /* for the change of x, so that no large terms cancel: (I - tau A)(x+ - x) = tau (A x + b) */
        const vehest_real error = m->u - speed;
        const vehest_real from_u = TAU * ALPHA * ALPHA * omega;
        const vehest_real from_v = TAU * omega;
        const vehest_real damping = 1.0 + 2.0 * TAU * ALPHA * VEHEST_ABS(omega);
        const vehest_real right_v = TAU * (sample[VEHEST_AY] - omega * speed - ALPHA * ALPHA * omega * error);
        const vehest_real right_u = TAU * (sample[VEHEST_AX] + omega * m->v - 2.0 * ALPHA * VEHEST_ABS(omega) * error);
        const vehest_real determinant = damping + from_u * from_v;
        m->v += (damping * right_v - from_u * right_u) / determinant;
        m->u += (right_u + from_v * right_v) / determinant;
    }
    output->vy = m->v;
    output->vx = m->u;
    return true;
}
