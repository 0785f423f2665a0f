/* vehest_method.h: Learned UKF, Pacejka's tyres, learnt through the filter (learned_ukf, pc_u), the method alone.
 *
 * It works at 100.0 Hz. An estimate holds at the time of its sample.
 */
#ifndef VEHEST_METHOD_H
#define VEHEST_METHOD_H

#include "vehest_types.h"

/* All that is remembered from one sample to the next. */
typedef struct {
    vehest_real mean[5];   /* vx [m/s], vy [m/s], yaw rate [rad/s], rim speed [m/s], friction [1] */
    vehest_real cov[5][5]; /* their covariance */
    vehest_real inputs[2]; /* steering angle [rad] and motor current [A] of the last sample, held where they are missing */
    bool started;
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

/* Take a sample: channels in the order of vehest_types.h, SI units, NaN in a skippable channel was not measured.
 * False: the method is lost, its output means nothing; start it anew. */
bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output);

#endif
