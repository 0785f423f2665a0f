/* vehest_method.c: Velocity GRU, 8 states (velocity_gru, states_8), the method alone.
 * Gated recurrent units over all samples so far, a dense read-out, a leaky rectifier (Srinivasan et al., IEEE RA-L 5 (4), 2020); o is the
 * elementwise product, s the logistic function, inputs and outputs are standardised:
 *     r, z = s(W x + b + U h + d),  n = tanh(W_n x + b_n + r o (U_n h + d_n)),  h+ = n + z o (h - n),  y = leaky(V h+ + e)
 */
#include "vehest_method.h"

enum { INPUTS = 4, OUTPUTS = 2, GATES = 3, STATES = 8 };

static const int SEEN[INPUTS] = {VEHEST_VX, VEHEST_YAW_RATE, VEHEST_AY, VEHEST_AX};
static const vehest_real INPUT_MEAN[INPUTS] = {0.15, 0.5, 0.3, 0.1}; /* SI */
static const vehest_real INPUT_SCALE[INPUTS] = {0.2, 0.55, 0.35, 0.15}; /* SI */
static const vehest_real OUTPUT_MEAN[OUTPUTS] = {0.2, 0.55}; /* vx, vy [SI] */
static const vehest_real OUTPUT_SCALE[OUTPUTS] = {0.25, 0.05}; /* [SI] */
/* gates: r, z, n, one after another */
static const vehest_real W[INPUTS][GATES * STATES] = {
    {0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15, 0.45, 0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15, 0.45, 0.2,
        0.5},
    {0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15, 0.45, 0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15, 0.45, 0.2, 0.5, 0.25, 0.55,
        0.3},
    {0.35, 0.1, 0.4, 0.15, 0.45, 0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15, 0.45, 0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35,
        0.1},
    {0.15, 0.45, 0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15, 0.45, 0.2, 0.5, 0.25, 0.55, 0.3, 0.05, 0.35, 0.1, 0.4, 0.15,
        0.45}
};
static const vehest_real U[STATES][GATES * STATES] = {
    {0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2,
        0.25},
    {0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55,
        0.05},
    {0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35,
        0.4},
    {0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15,
        0.2},
    {0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5,
        0.55},
    {0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3,
        0.35},
    {0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1,
        0.15},
    {0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45,
        0.5}
};
static const vehest_real B[GATES * STATES] = {0.1, 0.45, 0.25, 0.05, 0.4, 0.2, 0.55, 0.35, 0.15, 0.5, 0.3, 0.1, 0.45, 0.25, 0.05, 0.4, 0.2, 0.55, 0.35, 0.15, 0.5, 0.3, 0.1,
    0.45};
static const vehest_real D[GATES * STATES] = {0.1, 0.45, 0.25, 0.05, 0.4, 0.2, 0.55, 0.35, 0.15, 0.5, 0.3, 0.1, 0.45, 0.25, 0.05, 0.4, 0.2, 0.55, 0.35, 0.15, 0.5, 0.3, 0.1,
    0.45};
static const vehest_real READ_OUT[OUTPUTS][STATES] = {
    {0.4, 0.2, 0.55, 0.35, 0.15, 0.5, 0.3, 0.1},
    {0.45, 0.25, 0.05, 0.4, 0.2, 0.55, 0.35, 0.15}
};
static const vehest_real READ_OUT_BIAS[OUTPUTS] = {0.3, 0.1};

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

/* 1/(1 + exp(-x)) = (1 + tanh(x/2))/2. */
static inline vehest_real sigmoid_of(vehest_real x)
{
    return 0.5 + 0.5 * tanh_of(0.5 * x);
}

void vehest_method_start(vehest_method *m)
{
    for (int i = 0; i < STATES; i++) {
        m->h[i] = 0.0;
    }
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    vehest_real x[INPUTS], driven[GATES * STATES], recurrent[GATES * STATES], y[OUTPUTS];

    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    for (int i = 0; i < INPUTS; i++) {
        x[i] = (sample[SEEN[i]] - INPUT_MEAN[i]) / INPUT_SCALE[i];
    }
    for (int i = 0; i < GATES * STATES; i++) {
        driven[i] = B[i];
        recurrent[i] = D[i];
    }
    for (int j = 0; j < INPUTS; j++) { /* W x + b */
        for (int i = 0; i < GATES * STATES; i++) {
            driven[i] += W[j][i] * x[j];
        }
    }
    for (int j = 0; j < STATES; j++) { /* U h + d */
        for (int i = 0; i < GATES * STATES; i++) {
            recurrent[i] += U[j][i] * m->h[j];
        }
    }
    for (int i = 0; i < STATES; i++) { /* the cell */
        const vehest_real reset = sigmoid_of(driven[i] + recurrent[i]);
        const vehest_real update = sigmoid_of(driven[STATES + i] + recurrent[STATES + i]);
        const vehest_real candidate = tanh_of(driven[2 * STATES + i] + reset * recurrent[2 * STATES + i]);
        m->h[i] = candidate + update * (m->h[i] - candidate);
    }
    for (int i = 0; i < OUTPUTS; i++) { /* the read-out */
        y[i] = READ_OUT_BIAS[i];
        for (int j = 0; j < STATES; j++) {
            y[i] += READ_OUT[i][j] * m->h[j];
        }
        y[i] = y[i] < 0.0 ? 0.3 * y[i] : y[i];
        y[i] = y[i] * OUTPUT_SCALE[i] + OUTPUT_MEAN[i];
    }
    output->vx = y[0];
    output->vy = y[1];
    return true;
}
