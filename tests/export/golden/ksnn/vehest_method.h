/* vehest_method.h: KS-NN nonlinear no bias, P = 2, Q = 2 (ksnn, nonlinear_no_bias_p2_q2), the method alone.
 *
 * It works at 20.0 Hz. An estimate holds 1 sampling interval after its sample.
 * The KS-NN is patented by its authors (PCT/IT2023/050058). Using it in a product may need their licence;
 * the licence of this software grants none.
 */
#ifndef VEHEST_METHOD_H
#define VEHEST_METHOD_H

#include "vehest_types.h"

/* All that is remembered from one sample to the next. */
typedef struct {
    struct {
        vehest_real omega;     /* yaw rate [rad/s] */
        vehest_real speed;     /* forward velocity u_m [m/s] */
        vehest_real forced;    /* beta_1 tau (a_y - u_m omega) [m/s] */
        vehest_real thrust;    /* tau a_x [m/s] */
        vehest_real gamma[2];  /* gamma_1, gamma_2 [1] */
        vehest_real beta;      /* beta_2 [1] */
        vehest_real weight[2]; /* w_1 of f_1 [s/rad] and of f_2 [1] */
        vehest_real share[2];  /* of the local models that are active [1] */
        int32_t model;         /* the first of them */
    } window[30];    /* the last samples, as a ring */
    int32_t next;              /* where the next sample goes: the oldest one */
    int32_t count;             /* samples in the window */
} vehest_method;

/* What the method says after a sample; NaN where it has no such quantity, or none yet. */
typedef struct {
    vehest_real vy;          /* lateral velocity [m/s] */
    vehest_real vx;          /* forward velocity [m/s] */
    vehest_real yaw_rate;    /* yaw rate [rad/s] */
    vehest_real vy_variance; /* variance of the lateral velocity [m^2/s^2] */
} vehest_method_output;

/* As before the first sample. */
void vehest_method_start(vehest_method *m);

/* Take a sample: channels in the order of vehest_types.h, SI units.
 * False: the method is lost, its output means nothing; start it anew. */
bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output);

#endif
