/* vehest_method.c: LSTM, 5 states (lstm, states_5), the method alone.
 * Long short-term memory over the last 30 samples, from h = c = 0 (Hochreiter & Schmidhuber 1997), with o the elementwise product:
 *     i, f, o = s(W x + U h + b),  g = tanh(W_g x + U_g h + b_g),  c+ = f o c + i o g,  h+ = o o tanh(c+)
 * x is standardised, s the logistic function. W x + b of a sample is computed once, when it comes in.
 */
#include "vehest_method.h"

enum { WINDOW = 30, GATES = 4, STATES = 5 };

static const vehest_real INPUT_MEAN[VEHEST_CHANNELS] = {0.15, 0.5, 0.3, 0.1}; /* SI */
static const vehest_real INPUT_SCALE[VEHEST_CHANNELS] = {0.2, 0.55, 0.35, 0.15}; /* SI */
/* gates: i, f, o, g */
static const vehest_real W[GATES][STATES][VEHEST_CHANNELS] = {
    {
        {0.25, 0.05, 0.4, 0.2},
        {0.55, 0.35, 0.15, 0.5},
        {0.3, 0.1, 0.45, 0.25},
        {0.05, 0.4, 0.2, 0.55},
        {0.35, 0.15, 0.5, 0.3}
    },
    {
        {0.1, 0.45, 0.25, 0.05},
        {0.4, 0.2, 0.55, 0.35},
        {0.15, 0.5, 0.3, 0.1},
        {0.45, 0.25, 0.05, 0.4},
        {0.2, 0.55, 0.35, 0.15}
    },
    {
        {0.5, 0.3, 0.1, 0.45},
        {0.25, 0.05, 0.4, 0.2},
        {0.55, 0.35, 0.15, 0.5},
        {0.3, 0.1, 0.45, 0.25},
        {0.05, 0.4, 0.2, 0.55}
    },
    {
        {0.35, 0.15, 0.5, 0.3},
        {0.1, 0.45, 0.25, 0.05},
        {0.4, 0.2, 0.55, 0.35},
        {0.15, 0.5, 0.3, 0.1},
        {0.45, 0.25, 0.05, 0.4}
    }
};
static const vehest_real U[GATES][STATES][STATES] = {
    {
        {0.25, 0.05, 0.4, 0.2, 0.55},
        {0.35, 0.15, 0.5, 0.3, 0.1},
        {0.45, 0.25, 0.05, 0.4, 0.2},
        {0.55, 0.35, 0.15, 0.5, 0.3},
        {0.1, 0.45, 0.25, 0.05, 0.4}
    },
    {
        {0.2, 0.55, 0.35, 0.15, 0.5},
        {0.3, 0.1, 0.45, 0.25, 0.05},
        {0.4, 0.2, 0.55, 0.35, 0.15},
        {0.5, 0.3, 0.1, 0.45, 0.25},
        {0.05, 0.4, 0.2, 0.55, 0.35}
    },
    {
        {0.15, 0.5, 0.3, 0.1, 0.45},
        {0.25, 0.05, 0.4, 0.2, 0.55},
        {0.35, 0.15, 0.5, 0.3, 0.1},
        {0.45, 0.25, 0.05, 0.4, 0.2},
        {0.55, 0.35, 0.15, 0.5, 0.3}
    },
    {
        {0.1, 0.45, 0.25, 0.05, 0.4},
        {0.2, 0.55, 0.35, 0.15, 0.5},
        {0.3, 0.1, 0.45, 0.25, 0.05},
        {0.4, 0.2, 0.55, 0.35, 0.15},
        {0.5, 0.3, 0.1, 0.45, 0.25}
    }
};
static const vehest_real B[GATES][STATES] = {
    {0.1, 0.45, 0.25, 0.05, 0.4},
    {0.2, 0.55, 0.35, 0.15, 0.5},
    {0.3, 0.1, 0.45, 0.25, 0.05},
    {0.4, 0.2, 0.55, 0.35, 0.15}
};
static const vehest_real READ_OUT[STATES] = {0.3, 0.1, 0.45, 0.25, 0.05};
static const vehest_real READ_OUT_BIAS = 0.2;
static const vehest_real OUTPUT_MEAN = 0.2;  /* [m/s] */
static const vehest_real OUTPUT_SCALE = 0.25; /* [m/s] */

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

/* One step of the cell, in place. */
static void advance(vehest_real driven[GATES][STATES], vehest_real h[STATES], vehest_real c[STATES])
{
    vehest_real gate[4 * STATES]; /* i, f, o, g */

    for (int g = 0; g < GATES; g++) {
        for (int i = 0; i < STATES; i++) {
            vehest_real total = driven[g][i];
            for (int j = 0; j < STATES; j++) {
                total += U[g][i][j] * h[j];
            }
            gate[g * STATES + i] = total;
        }
    }
    for (int i = 0; i < 3 * STATES; i++) {
        gate[i] = sigmoid_of(gate[i]);
    }
    for (int i = 0; i < STATES; i++) {
        c[i] = gate[STATES + i] * c[i] + gate[i] * tanh_of(gate[3 * STATES + i]);
        h[i] = gate[2 * STATES + i] * tanh_of(c[i]);
    }
}

void vehest_method_start(vehest_method *m)
{
    m->next = 0;
    m->count = 0;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    vehest_real x[VEHEST_CHANNELS], h[STATES], c[STATES];
    vehest_real total = READ_OUT_BIAS;
    int32_t at;

    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    for (int i = 0; i < VEHEST_CHANNELS; i++) {
        x[i] = (sample[i] - INPUT_MEAN[i]) / INPUT_SCALE[i];
    }
    for (int g = 0; g < GATES; g++) { /* W x + b */
        for (int i = 0; i < STATES; i++) {
            vehest_real driven = B[g][i];
            for (int j = 0; j < VEHEST_CHANNELS; j++) {
                driven += W[g][i][j] * x[j];
            }
            m->driven[m->next][g][i] = driven;
        }
    }
    m->next = m->next + 1 < WINDOW ? m->next + 1 : 0;
    m->count = m->count < WINDOW ? m->count + 1 : WINDOW;
    if (m->count < WINDOW) {
        return true; /* vy stays NaN until the window is full */
    }

    for (int i = 0; i < STATES; i++) {
        h[i] = 0.0;
        c[i] = 0.0;
    }
    at = m->next; /* the oldest sample */
    for (int k = 0; k < WINDOW; k++) { /* the cell over the window */
        advance(m->driven[at], h, c);
        at = at + 1 < WINDOW ? at + 1 : 0;
    }
    for (int i = 0; i < STATES; i++) {
        total += READ_OUT[i] * h[i];
    }
    output->vy = total * OUTPUT_SCALE + OUTPUT_MEAN;
    return true;
}
