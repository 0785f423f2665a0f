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

typedef float vehest_real;

#define VEHEST_SQRT(x) sqrtf(x)
#define VEHEST_ABS(x) fabsf(x)
#define VEHEST_FLOOR(x) floorf(x)
#define VEHEST_EXP(x) expf(x)
#define VEHEST_LOG(x) logf(x)
#define VEHEST_LOG10(x) log10f(x)
#define VEHEST_LOG1P(x) log1pf(x)
#define VEHEST_POW(x, y) powf(x, y)
#define VEHEST_SIN(x) sinf(x)
#define VEHEST_COS(x) cosf(x)
#define VEHEST_TAN(x) tanf(x)
#define VEHEST_ATAN(x) atanf(x)
#define VEHEST_ATAN2(y, x) atan2f(y, x)
#define VEHEST_TANH(x) tanhf(x)

#define VEHEST_NAN ((vehest_real)NAN)
#define VEHEST_INFINITY ((vehest_real)INFINITY)
#define VEHEST_IS_NAN(x) ((x) != (x))
#define VEHEST_IS_FINITE(x) (((x) - (x)) == 0.0f)

/* A sample: one value a channel, in this order and these units. */
#define VEHEST_VX 0 /* [m/s] measured forward velocity at the centre of gravity */
#define VEHEST_YAW_RATE 1 /* [rad/s] measured yaw rate, positive in a left turn */
#define VEHEST_AY 2 /* [m/s^2] measured lateral acceleration at the centre of gravity, positive to the left */
#define VEHEST_CHANNELS 3

#endif
