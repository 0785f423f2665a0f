/* vehest_method.c: Data sheet (data_sheet, data_sheet), the method alone.
 * Steady cornering of a linear single track from a data sheet.
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
    /* v = r (l_r - u^2 / (c g)), l_r in m and c g in m/s^2 per rad */
    output->vy = r * (1.35 - (u * u) / 98.10000000000001);
    return true;
}
