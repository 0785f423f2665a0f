/* vehest_method.c: Static map (static_map, static_map), the method alone.
 * Steady cornering of a linear single track, its two numbers by least squares.
 */
#include "vehest_method.h"

void vehest_method_start(vehest_method *m)
{
    m->none = 0;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
    const vehest_real u = sample[VEHEST_VX];       /* [m/s] */
    const vehest_real r = sample[VEHEST_YAW_RATE]; /* [rad/s] */
    output->vy = VEHEST_NAN;
    output->vx = VEHEST_NAN;
    output->yaw_rate = VEHEST_NAN;
    output->vy_variance = VEHEST_NAN;
    if (VEHEST_IS_NAN(sample[VEHEST_VX])) {
        return false; /* cannot do without this channel */
    }
    if (VEHEST_IS_NAN(sample[VEHEST_YAW_RATE])) {
        return false; /* cannot do without this channel */
    }
    (void)m;
    /* v = r (b - k u^2), b in m and k in s^2/m */
    output->vy = r * (0.25 - (0.25) * (u * u));
    return true;
}
