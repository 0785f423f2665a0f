/* vehest_types.h: the type of numbers, and the channels of a sample.
 *
 * Axes are those of ISO 8855 (x forward, y left, z up), units are SI, angles are radians.
 * Do not compile with -ffast-math or -ffinite-math-only: NaN stands for what was not measured.
 */
#ifndef VEHEST_TYPES_H
#define VEHEST_TYPES_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

typedef double vehest_real;

#define VEHEST_SQRT(x) sqrt(x)
#define VEHEST_ABS(x) fabs(x)
#define VEHEST_FLOOR(x) floor(x)
#define VEHEST_EXP(x) exp(x)
#define VEHEST_LOG(x) log(x)
#define VEHEST_LOG10(x) log10(x)
#define VEHEST_LOG1P(x) log1p(x)
#define VEHEST_POW(x, y) pow(x, y)
#define VEHEST_SIN(x) sin(x)
#define VEHEST_COS(x) cos(x)
#define VEHEST_TAN(x) tan(x)
#define VEHEST_ATAN(x) atan(x)
#define VEHEST_ATAN2(y, x) atan2(y, x)
#define VEHEST_TANH(x) tanh(x)

#define VEHEST_NAN ((vehest_real)NAN)
#define VEHEST_INFINITY ((vehest_real)INFINITY)
#define VEHEST_IS_NAN(x) ((x) != (x))
#define VEHEST_IS_FINITE(x) (((x) - (x)) == 0.0)

/* A sample: one value a channel, in this order and these units. */
#define VEHEST_VX 0 /* [m/s] measured forward velocity at the centre of gravity */
#define VEHEST_YAW_RATE 1 /* [rad/s] measured yaw rate, positive in a left turn */
#define VEHEST_AY 2 /* [m/s^2] measured lateral acceleration at the centre of gravity, positive to the left */
#define VEHEST_AX 3 /* [m/s^2] measured longitudinal acceleration at the centre of gravity */
#define VEHEST_CHANNELS 4

#endif
