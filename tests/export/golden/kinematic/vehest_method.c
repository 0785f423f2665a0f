/* vehest_method.c: Kinematic integration (kinematic, kinematic), the method alone.
 * dv/dt = a_y - u r - v / T with T = 0.3 s; between samples the acceleration is held.
 */
#include "vehest_method.h"

void vehest_method_start(vehest_method *m)
{
    m->v = 0.0;
}

bool vehest_method_step(vehest_method *m, const vehest_real sample[VEHEST_CHANNELS], vehest_method_output *output)
{
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
    if (VEHEST_IS_NAN(sample[VEHEST_AY])) {
        return false; /* cannot do without this channel */
    }
    /* v+ = exp(-tau/T) v + (1 - exp(-tau/T)) T (a_y - u r) */
    m->v = 0.9672161004820059 * m->v + 0.00983516985539823 * (sample[VEHEST_AY] - sample[VEHEST_VX] * sample[VEHEST_YAW_RATE]);
    output->vy = m->v;
    return true;
}
