/* vehest_method.c: KS-NN nonlinear no bias, P = 2, Q = 2 (ksnn, nonlinear_no_bias_p2_q2), the method alone.
 * Kinematics-structured neural network (Da Lio, Piccinini & Biral, IEEE T-ITS 2023): over the last 30 samples, from v = 0 and u^ = u_m,
 *     v+  = gamma_1 v + beta_1 tau (a_y - u_m omega) - omega f_1(u^ - u_m)     (Eq. 7a)
 *     u^+ = gamma_2 u^ + beta_2 tau (a_x + v omega) - f_2(u^ - u_m)            (Eq. 7b)
 *     f(e) = w_1 e + sum_j w_3j tanh(w_2j e)                     (Eq. 8)
 * with coefficients of 2 local models blended by |omega| (Eq. 9), once for every sample, when it comes in.
 * The KS-NN is patented by its authors (PCT/IT2023/050058). Using it in a product may need their licence;
 * the licence of this software grants none.
 */
#include "vehest_method.h"

enum { WINDOW = 30, LOCAL = 2, HIDDEN = 2, ACTIVE = 2 };

static const vehest_real TAU = 0.05; /* sampling time [s] */
static const vehest_real PER_WIDTH = 4.0; /* local models per yaw rate [s/rad] */
/* gamma_1, gamma_2, beta_1, beta_2, w_1 of f_1 and of f_2 of every local model */
static const vehest_real LINEAR[LOCAL][6] = {
    { 0.45, 0.25, 0.4, 0.2, 0.3, 0.1 },
    { 0.05, 0.4, 0.55, 0.35, 0.45, 0.25 }
};
/* w_2, w_3 of every local model, feedback function and neuron */
static const vehest_real NEURON[LOCAL][2][HIDDEN][2] = {
    {
        {
            { 0.3, 0.3 },
            { 0.1, 0.1 }
        },
        {
            { 0.45, 0.45 },
            { 0.25, 0.25 }
        }
    },
    {
        {
            { 0.05, 0.05 },
            { 0.4, 0.4 }
        },
        {
            { 0.2, 0.2 },
            { 0.55, 0.55 }
        }
    }
};

/* tanh(x) by Lambert's continued fraction at x/4, then tanh(2y) = 2t/(1 + t^2) twice (Abramowitz & Stegun 4.5.70, 4.5.24);
 * error below 1e-15. */
static inline vehest_real tanh_of(vehest_real x)
{
    /* NaN stays NaN; tanh(19.0) is 1 but for rounding */
    const vehest_real above = x < -19.0 ? -19.0 : x;
    const vehest_real y = 0.25 * (above > 19.0 ? 19.0 : above);
    const vehest_real s = y * y;
    const vehest_real numerator = y * (34459425.0 + s * (4729725.0 + s * (135135.0 + s * (990.0 + s))));
    const vehest_real denominator = 34459425.0 + s * (16216200.0 + s * (945945.0 + s * (13860.0 + s * 45.0)));
    const vehest_real first = numerator / denominator;
    const vehest_real second = 2.0 * first / (1.0 + first * first);
    return 2.0 * second / (1.0 + second * second);
}

/* Put a sample into the window, with the coefficients of Eq. 9. */
static void keep(vehest_method *m, vehest_real omega, vehest_real speed, vehest_real ay, vehest_real ax)
{
    const int32_t own = m->next;
    vehest_real row[6] = {0.0};
    vehest_real position = VEHEST_ABS(omega) * PER_WIDTH; /* along the local models, 0 ... LOCAL - 1 */

    position = position < 1.0 ? position : 1.0;
    for (int p = 0; p < LOCAL; p++) { /* Eq. 9: triangles along |omega| */
        const vehest_real away = VEHEST_ABS(position - (vehest_real)p);
        const vehest_real phi = away < 1.0 ? 1.0 - away : 0.0;
        for (int i = 0; i < 6; i++) {
            row[i] += phi * LINEAR[p][i];
        }
    }
    m->window[own].omega = omega;
    m->window[own].speed = speed;
    m->window[own].forced = row[2] * (TAU * (ay - speed * omega));
    m->window[own].thrust = TAU * ax;
    m->window[own].gamma[0] = row[0];
    m->window[own].gamma[1] = row[1];
    m->window[own].beta = row[3];
    m->window[own].weight[0] = row[4];
    m->window[own].weight[1] = row[5];
    m->window[own].model = 0;
    while (m->window[own].model < LOCAL - 2 && position >= (vehest_real)(m->window[own].model + 1)) {
        m->window[own].model++; /* at most LOCAL - 2 times */
    }
    m->window[own].share[1] = position - (vehest_real)m->window[own].model;
    m->window[own].share[0] = 1.0 - m->window[own].share[1];
    m->next = own + 1 < WINDOW ? own + 1 : 0;
    m->count = m->count < WINDOW ? m->count + 1 : WINDOW;
}

/* v one step after a full window, from v = 0 and u^ = u_m at its oldest sample. */
static vehest_real network_of(const vehest_method *m)
{
    int32_t at = m->next;
    vehest_real v = 0.0, u = m->window[at].speed;

    for (int k = 0; k < WINDOW; k++) { /* Eqs. 7 and 8 */
        const vehest_real error = u - m->window[at].speed;
        const vehest_real thrust = m->window[at].thrust + TAU * v * m->window[at].omega;
        vehest_real f1 = m->window[at].weight[0] * error;
        vehest_real f2 = m->window[at].weight[1] * error;
        for (int side = 0; side < ACTIVE; side++) {
            const vehest_real (*neurons)[HIDDEN][2] = NEURON[m->window[at].model + side];
            vehest_real inner[2 * HIDDEN];
            vehest_real sum[2] = {0.0, 0.0};
            for (int i = 0; i < 2; i++) {
                for (int j = 0; j < HIDDEN; j++) {
                    inner[i * HIDDEN + j] = neurons[i][j][0] * error;
                }
            }
            for (int i = 0; i < 2 * HIDDEN; i++) {
                inner[i] = tanh_of(inner[i]);
            }
            for (int i = 0; i < 2; i++) {
                for (int j = 0; j < HIDDEN; j++) {
                    sum[i] += neurons[i][j][1] * inner[i * HIDDEN + j];
                }
            }
            f1 += m->window[at].share[side] * sum[0];
            f2 += m->window[at].share[side] * sum[1];
        }
        v = m->window[at].gamma[0] * v + m->window[at].forced - m->window[at].omega * f1;
        u = m->window[at].gamma[1] * u + m->window[at].beta * thrust - f2;
        at = at + 1 < WINDOW ? at + 1 : 0;
    }
    return v;
}

void vehest_method_start(vehest_method *m)
{
    m->next = 0;
    m->count = 0;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    keep(m, sample[VEHEST_YAW_RATE], sample[VEHEST_VX], sample[VEHEST_AY], sample[VEHEST_AX]);
    output->vy = m->count < WINDOW ? VEHEST_NAN : network_of(m); /* NaN until the window is full */
    return true;
}
