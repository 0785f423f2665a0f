/* vehest_estimator.h: Kinematic integration, weights set by hand under the contract of running online.
 *
 * What is received passes guard, health, method, watch, bands and verdict, in this order, as in vehest.trust.contract.
 *
 *     static vehest_state state;                    a fixed size, no pointers; may lie anywhere
 *     vehest_estimate estimate;
 *     vehest_start(&state);
 *     every 1/500.0 s:
 *         vehest_sample sample = {.vx = ...};      NaN in what was not measured
 *         (void)vehest_step(&state, &sample, &estimate);
 */
#ifndef VEHEST_ESTIMATOR_H
#define VEHEST_ESTIMATOR_H

#include "vehest_method.h"
#include "vehest_types.h"
#include "vehest_health.h"

#define VEHEST_INPUT_RATE_HZ 500.0f /* at which vehest_step is called [Hz] */
#define VEHEST_RATE_HZ 100.0f /* of the method, whose estimates are as many a second [Hz] */
#define VEHEST_HORIZON_STEPS 0 /* intervals of the method's rate after its sample, for which an estimate holds */
#define VEHEST_WARM_UP_STEPS 0 /* samples after a start for which there may be no estimate */

/* What was received at one instant; NaN in what was not measured. */
typedef struct {
    vehest_real vx; /* [m/s] measured forward velocity at the centre of gravity */
    vehest_real yaw_rate; /* [rad/s] measured yaw rate, positive in a left turn */
    vehest_real ay; /* [m/s^2] measured lateral acceleration at the centre of gravity, positive to the left */
} vehest_sample;

/* Health of an estimate. */
#define VEHEST_VALID 0U
#define VEHEST_DEGRADED 1U
#define VEHEST_INVALID 2U

/* Marks of an estimate, which add up. */
#define VEHEST_EXTRAPOLATED 1U /* there is no estimate, vy fades from the last one */
#define VEHEST_CLIPPED 2U /* the method's value was beyond what the speed allows, vy is the bound */
#define VEHEST_SPINNING 4U /* the car spins */
#define VEHEST_STARTED 8U /* the method started anew at this sample */

typedef struct {
    vehest_real vy; /* [m/s] lateral velocity at the centre of gravity, positive to the left; NaN before the first estimate */
    vehest_real sideslip; /* [rad] atan2(vy, vx), 0 at standstill; NaN while no speed is known */
    vehest_real vx; /* [m/s] the method's own forward velocity; NaN where it has none */
    vehest_real yaw_rate; /* [rad/s] the method's own yaw rate; NaN where it has none */
    vehest_real band_vy; /* [m/s] half width of the calibrated 90 % band of vy; NaN where there is none */
    vehest_real band_sideslip; /* [rad] the same of sideslip */
    int32_t reason; /* why it is not valid: 10000 kind + 100 channel + partner, 0 if it is; kinds and numbers of channels: README.md */
    uint8_t health; /* VEHEST_VALID, VEHEST_DEGRADED or VEHEST_INVALID */
    uint8_t marks;
} vehest_estimate;

/* What follows is the state. Its parts are those of the functions that use them; read nothing from it. */

typedef struct {
    vehest_real believed; /* last value that was; NaN: none yet */
    vehest_real last; /* last value within the range */
    vehest_real candidate; /* level after a jump, not believed yet */
    uint32_t since; /* samples since one was believed */
    uint32_t run; /* equal values in a row */
    uint32_t confirmed; /* how often the candidate was */
} vehest_guard_channel;

typedef struct {
    vehest_guard_channel channel[VEHEST_CHANNELS];
    bool waits;
} vehest_guard;

typedef struct {
    vehest_guard guard; /* at the bus's rate */
    vehest_real memory[2][VEHEST_CHANNELS][2]; /* of the second-order sections; NaN: starts with the next value */
    vehest_real held[VEHEST_CHANNELS];
    uint32_t phase;
} vehest_front_end;

typedef struct {
    vehest_real vy; /* last value passed on; NaN: none yet */
    vehest_real speed; /* that is remembered [m/s] */
    vehest_real spinning; /* [s] */
    vehest_real beyond; /* the bound [s] */
    uint32_t since_start; /* samples */
    bool lost; /* whether the method was at the last sample */
} vehest_watch;

typedef struct {
    double last; /* stamp of the last sample that was used [s]; NaN: none yet */
    double previous; /* stamp of the last call [s] */
    uint32_t stalled; /* calls since a stamp advanced */
    uint32_t uneven; /* uneven intervals less even ones */
    uint32_t recovering; /* even samples until the clock is trusted again */
    int32_t fault; /* kind of reason why it is not trusted; 0 while it is */
} vehest_clock;

typedef struct {
    vehest_front_end front_end;
    vehest_guard guard;
    vehest_health health;
    uint32_t at_fault; /* samples at which a channel was accused since health was last valid */
    uint32_t needed_at_fault; /* of these, those at which a channel was accused that is needed */
    vehest_method method;
    bool fresh; /* whether the method has seen nothing since its start */
    vehest_watch watch;
    vehest_real vx; /* last speed that was known [m/s]; NaN: none yet */
    vehest_clock clock; /* of vehest_step_at */
    vehest_estimate last;
} vehest_state;

/* Bring a state to where it was before its first sample. */
void vehest_start(vehest_state *state);

/* Take what was received at one instant; call it VEHEST_INPUT_RATE_HZ times a second, without a sample by vehest_missing.
 *
 * Returns whether there is a new estimate; between two of them, estimate is the last one.
 */
bool vehest_step(vehest_state *state, const vehest_sample *sample, vehest_estimate *estimate);

/* The same where nothing was received. */
bool vehest_missing(vehest_state *state, vehest_estimate *estimate);

/* The same by the sample's time [s], from any zero: repeated samples are passed over, missing ones bridged.
 * For buses without a fixed clock. The estimate is VEHEST_INVALID where time stamps stand still, go back or are uneven
 * for 0.2 s or jump, until they have been even for 1.0 s. While the clock stands still, calls measure time: call it once a sample.
 */
bool vehest_step_at(vehest_state *state, double time, const vehest_sample *sample, vehest_estimate *estimate);

#endif
