/* vehest_method.c: Zero (v = 0) (zero, zero), the method alone.
 * v = 0.
 */
#include "vehest_method.h"

void vehest_method_start(vehest_method *m)
{
    m->none = 0;
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
    (void)m;
    output->vy = 0.0;
    return true;
}
