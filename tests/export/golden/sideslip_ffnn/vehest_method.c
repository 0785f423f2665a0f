/* vehest_method.c: Feed-forward network, without tyre forces (sideslip_ffnn, imu), the method alone.
 * Two hidden layers with rectifiers, each sample by itself (Bertipaglia et al. 2024, Section IV-C): the sideslip angle beta [rad] of scaled
 * inputs, and v = u tan(beta).
 */
#include "vehest_method.h"

enum { MEMBERS = 1, INPUTS = 5, FIRST = 8, SECOND = 4, OUTPUTS = 1 };

static const vehest_real INPUT_LOW[INPUTS] = {0.1, 0.45, 0.25, 0.05, 0.4}; /* SI */
static const vehest_real INPUT_SPAN[INPUTS] = {0.15, 0.5, 0.3, 0.1, 0.45}; /* SI */
static const vehest_real W1[MEMBERS][INPUTS][FIRST] = {
    {
        {0.05, 0.4, 0.2, 0.55, 0.35, 0.15, 0.5, 0.3},
        {0.1, 0.45, 0.25, 0.05, 0.4, 0.2, 0.55, 0.35},
        {0.15, 0.5, 0.3, 0.1, 0.45, 0.25, 0.05, 0.4},
        {0.2, 0.55, 0.35, 0.15, 0.5, 0.3, 0.1, 0.45},
        {0.25, 0.05, 0.4, 0.2, 0.55, 0.35, 0.15, 0.5}
    }
};
static const vehest_real B1[MEMBERS][FIRST] = {
    {0.5, 0.3, 0.1, 0.45, 0.25, 0.05, 0.4, 0.2}
};
static const vehest_real W2[MEMBERS][FIRST][SECOND] = {
    {
        {0.05, 0.4, 0.2, 0.55},
        {0.35, 0.15, 0.5, 0.3},
        {0.1, 0.45, 0.25, 0.05},
        {0.4, 0.2, 0.55, 0.35},
        {0.15, 0.5, 0.3, 0.1},
        {0.45, 0.25, 0.05, 0.4},
        {0.2, 0.55, 0.35, 0.15},
        {0.5, 0.3, 0.1, 0.45}
    }
};
static const vehest_real B2[MEMBERS][SECOND] = {
    {0.5, 0.3, 0.1, 0.45}
};
static const vehest_real W3[MEMBERS][SECOND][OUTPUTS] = {
    {
        {0.05},
        {0.4},
        {0.2},
        {0.55}
    }
};
static const vehest_real B3[MEMBERS][OUTPUTS] = {
    {0.5}
};

/* Outputs of one member: h = relu(W x + b) twice, then W h + b, of inputs scaled to 0 ... 1. Rows of a layer that a rectifier shut add nothing. */
static void network_of(const vehest_real measured[INPUTS], int member, vehest_real out[OUTPUTS])
{
    vehest_real first[FIRST], second[SECOND];

    for (int j = 0; j < FIRST; j++) {
        first[j] = 0.0;
    }
    for (int i = 0; i < INPUTS; i++) {
        const vehest_real x = (measured[i] - INPUT_LOW[i]) / INPUT_SPAN[i];
        for (int j = 0; j < FIRST; j++) {
            first[j] += x * W1[member][i][j];
        }
    }
    for (int j = 0; j < SECOND; j++) {
        second[j] = 0.0;
    }
    for (int i = 0; i < FIRST; i++) {
        const vehest_real x = first[i] + B1[member][i];
        if (!(x <= 0.0)) { /* NaN passes */
            for (int j = 0; j < SECOND; j++) {
                second[j] += x * W2[member][i][j];
            }
        }
    }
    for (int j = 0; j < OUTPUTS; j++) {
        out[j] = B3[member][j];
    }
    for (int i = 0; i < SECOND; i++) {
        const vehest_real x = second[i] + B2[member][i];
        if (!(x <= 0.0)) {
            for (int j = 0; j < OUTPUTS; j++) {
                out[j] += x * W3[member][i][j];
            }
        }
    }
}

static const vehest_real UNIT = 0.4; /* of the network's output [rad] */
static const vehest_real STEEPEST = 1.5; /* beyond which no angle is believed [rad] */

void vehest_method_start(vehest_method *m)
{
    m->none = 0;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    vehest_real y[OUTPUTS], beta;

    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    (void)m;
    network_of(sample, 0, y);
    beta = y[0] * UNIT;
    beta = beta < -STEEPEST ? -STEEPEST : beta;
    beta = beta > STEEPEST ? STEEPEST : beta;
    output->vy = sample[VEHEST_VX] * VEHEST_TAN(beta);
    return true;
}
