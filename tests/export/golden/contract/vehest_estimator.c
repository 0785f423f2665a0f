/* vehest_estimator.c: Kinematic integration, weights set by hand under the contract of running online.
 */
#include "vehest_estimator.h"

#define C VEHEST_CHANNELS

/* What the method does with a sample. */
typedef enum { USE, WAIT, RESTART } flow_of_sample;

/* A sample as the method may see it. */
typedef struct {
    vehest_real row[C]; /* finite, or NaN in channels that the method can skip; whatever where it waits */
    bool measured[C]; /* what was believed */
    flow_of_sample flow;
} cleaned_sample;

static vehest_real smaller(vehest_real a, vehest_real b)
{
    return (b < a) ? b : a;
}

static vehest_real larger(vehest_real a, vehest_real b)
{
    return (b > a) ? b : a;
}

static bool is_nan(vehest_real x)
{
    return x != x;
}

static bool is_finite(vehest_real x)
{
    return VEHEST_ABS(x) < VEHEST_INFINITY; /* false for NaN */
}

/* One more, but never beyond what the type holds. */
static uint32_t counted(uint32_t n)
{
    return (n < UINT32_MAX) ? (n + 1U) : n;
}

/* Guard: what is believed of a sample (vehest.trust.guard). */

typedef struct {
    vehest_real low; /* [unit of the channel] */
    vehest_real high;
    vehest_real jump; /* largest change from one sample to the next */
    vehest_real lower_stop; /* between the stops alone it is expected to move */
    vehest_real upper_stop;
    uint32_t run; /* longest run of equal samples */
} guard_limits;

static const bool SKIPPABLE[C] = { false, false, false }; /* channels that the method can do without */

/* Limits at the method's rate. */
static const guard_limits LIMITS[C] = {
    { -40.0f, 120.0f, 30.0f, -VEHEST_INFINITY, VEHEST_INFINITY, 50U }, /* vx */
    { -4.0f, 4.0f, 1.0f, -VEHEST_INFINITY, VEHEST_INFINITY, 50U }, /* yaw_rate */
    { -40.0f, 40.0f, 10.0f, -VEHEST_INFINITY, VEHEST_INFINITY, 50U }, /* ay */
};
#define BRIDGED 50U /* samples that a gap may last */
#define PERSISTS 10U /* samples that a new level has to stand after a jump */

/* Limits at the bus's rate. */
static const guard_limits BUS_LIMITS[C] = {
    { -40.0f, 120.0f, 30.0f, -VEHEST_INFINITY, VEHEST_INFINITY, 250U }, /* vx */
    { -4.0f, 4.0f, 1.0f, -VEHEST_INFINITY, VEHEST_INFINITY, 250U }, /* yaw_rate */
    { -40.0f, 40.0f, 10.0f, -VEHEST_INFINITY, VEHEST_INFINITY, 250U }, /* ay */
};
#define BUS_BRIDGED 250U /* samples that a gap may last */
#define BUS_PERSISTS 50U /* samples that a new level has to stand after a jump */

static void guard_start(vehest_guard *guard)
{
    for (int32_t c = 0; c < C; c++) {
        guard->channel[c].believed = VEHEST_NAN;
        guard->channel[c].last = VEHEST_NAN;
        guard->channel[c].candidate = VEHEST_NAN;
        guard->channel[c].since = 0U;
        guard->channel[c].run = 0U;
        guard->channel[c].confirmed = 0U;
    }
    guard->waits = true;
}

/* Whether the car stands, as far as the last believed samples tell; false while nothing is known. */
static bool stands(const vehest_guard *guard)
{
    return (VEHEST_ABS(guard->channel[VEHEST_VX].believed) < 0.5f)
        && (VEHEST_ABS(guard->channel[VEHEST_YAW_RATE].believed) < 0.0500000007f);
}

/* Believe one value or not; jumped: set where a jump is believed after all. */
static bool believe(vehest_guard_channel *own, const guard_limits *limits, vehest_real x, bool still, uint32_t bridged, uint32_t persists, bool *jumped)
{
    bool believed = (x >= limits->low) && (x <= limits->high); /* false for NaN */
    if (believed) {
        own->run = (x == own->last) ? counted(own->run) : 0U;
        own->last = x;
        if ((own->run > limits->run) && (x > limits->lower_stop) && (x < limits->upper_stop) && !still) {
            believed = false;
        } else if ((own->since <= bridged) && (VEHEST_ABS(x - own->believed) > limits->jump)) { /* from what is not long gone */
            own->confirmed = (VEHEST_ABS(x - own->candidate) <= limits->jump) ? counted(own->confirmed) : 1U;
            own->candidate = x;
            believed = (own->confirmed >= persists);
            *jumped = *jumped || believed;
        } else {
            /* nothing against it */
        }
    }
    if (believed) {
        own->believed = x;
        own->since = 0U;
        own->candidate = VEHEST_NAN;
        own->confirmed = 0U;
    } else {
        own->since = counted(own->since);
    }
    return believed;
}

/* Decide what is believed of a row, and what the method does with it. */
static void guard_step(
    vehest_guard *guard,
    const guard_limits limits[C],
    uint32_t bridged,
    uint32_t persists,
    bool remembers,
    const vehest_real row[C],
    cleaned_sample *cleaned)
{
    const bool still = stands(guard);
    bool jumped = false;
    bool any_skippable = false;
    uint32_t most_needed = 0U;
    uint32_t least_skippable = UINT32_MAX;
    for (int32_t c = 0; c < C; c++) {
        vehest_guard_channel *const own = &guard->channel[c];
        const bool believed = believe(own, &limits[c], row[c], still, bridged, persists, &jumped);
        const uint32_t missing = is_nan(own->believed) ? UINT32_MAX : own->since;
        const vehest_real bridge = SKIPPABLE[c] ? VEHEST_NAN : own->believed;
        cleaned->measured[c] = believed;
        cleaned->row[c] = believed ? row[c] : bridge;
        if (SKIPPABLE[c]) {
            any_skippable = true;
            least_skippable = (missing < least_skippable) ? missing : least_skippable;
        } else {
            most_needed = (missing > most_needed) ? missing : most_needed;
        }
    }
    if ((most_needed > bridged) || (any_skippable && (least_skippable > bridged))) {
        cleaned->flow = WAIT;
    } else {
        cleaned->flow = (guard->waits || (jumped && remembers)) ? RESTART : USE;
    }
    guard->waits = (cleaned->flow == WAIT);
}

/* Front end: from the bus's rate to the method's, causally and without aliasing (vehest.trust.front_end).
 * Slow signals come 10.2 ms late.
 */

#define PHASE_STEP 1U /* a row is due each time the phase has gone through PHASE_OF in such steps */
#define PHASE_OF 5U

#define SECTIONS 2

typedef struct {
    vehest_real b0;
    vehest_real b1;
    vehest_real b2;
    vehest_real a1;
    vehest_real a2;
} section;

/* Butterworth low-pass of fourth order at 40.0 Hz. */
static const section LOW_PASS[SECTIONS] = {
    { 0.00223489176f, 0.00446978351f, 0.00223489176f, -1.21281207f, 0.384004176f },
    { 1.0f, 2.0f, 1.0f, -1.47979891f, 0.688676953f },
};

static void front_end_start(vehest_front_end *front)
{
    guard_start(&front->guard);
    for (int32_t c = 0; c < C; c++) {
        front->held[c] = VEHEST_NAN;
        for (int32_t s = 0; s < SECTIONS; s++) {
            front->memory[s][c][0] = VEHEST_NAN;
            front->memory[s][c][1] = VEHEST_NAN;
        }
    }
    front->phase = PHASE_OF - PHASE_STEP; /* the first sample is passed on */
}

/* Second-order sections, direct form II transposed; one whose memory is NaN starts as if its value had always stood. */
static vehest_real low_passed(vehest_front_end *front, int32_t c, vehest_real value)
{
    vehest_real x = value;
    for (int32_t s = 0; s < SECTIONS; s++) {
        const section *const own = &LOW_PASS[s];
        vehest_real *const memory = front->memory[s][c];
        vehest_real y;
        if (is_nan(memory[0])) {
            const vehest_real steady = ((own->b0 + own->b1 + own->b2) / (1.0f + own->a1 + own->a2)) * x;
            memory[1] = (own->b2 * x) - (own->a2 * steady);
            memory[0] = ((own->b1 * x) - (own->a1 * steady)) + memory[1];
        }
        y = (own->b0 * x) + memory[0];
        memory[0] = ((own->b1 * x) - (own->a1 * y)) + memory[1];
        memory[1] = (own->b2 * x) - (own->a2 * y);
        x = y;
    }
    return x;
}

/* Take a row, in place; returns whether one is due for the method. What was not measured is NaN then. */
static bool front_end_step(vehest_front_end *front, vehest_real row[C])
{
    cleaned_sample cleaned;
    bool waits;
    bool due;
    guard_step(&front->guard, BUS_LIMITS, BUS_BRIDGED, BUS_PERSISTS, false, row, &cleaned);
    waits = (cleaned.flow == WAIT);
    for (int32_t c = 0; c < C; c++) {
        vehest_real value = cleaned.measured[c] ? cleaned.row[c] : front->held[c];
        front->held[c] = value;
        if (waits) {
            for (int32_t s = 0; s < SECTIONS; s++) {
                front->memory[s][c][0] = VEHEST_NAN;
                front->memory[s][c][1] = VEHEST_NAN;
            }
        } else if (!is_nan(value)) {
            value = low_passed(front, c, value);
        } else {
            /* nothing to filter yet */
        }
        row[c] = (cleaned.measured[c] && !waits) ? value : VEHEST_NAN;
    }
    front->phase += PHASE_STEP;
    due = (front->phase >= PHASE_OF);
    if (due) {
        front->phase -= PHASE_OF;
    }
    return due;
}

/* Clock: which samples repeat, which are missing, whether time stamps can be trusted (vehest.trust.clock).
 * While the clock stands still the calls measure time, at the input rate.
 */

#define FAULT_CALLS 100U /* of stamps that do not advance or are uneven, after which the clock is not trusted */
#define RECOVERY_CALLS 500U /* of even stamps, after which it is trusted again */
#define MAX_MISSING 251 /* missing samples that are replaced; longer gaps end all that is known, too */
#define CLOCK_STOPPED 33
#define CLOCK_JUMPED 34
#define CLOCK_UNEVEN 35
#define REPEATED (-1) /* the sample is not new: pass it over */
#define STOPPED (-2) /* the sample is not new: count it as missing */

static void clock_start(vehest_clock *clock)
{
    clock->last = (double)NAN;
    clock->previous = (double)NAN;
    clock->stalled = 0U;
    clock->uneven = 0U;
    clock->recovering = 0U;
    clock->fault = 0;
}

static void clock_suspect(vehest_clock *clock, int32_t fault)
{
    clock->fault = fault;
    clock->recovering = RECOVERY_CALLS;
}

static void clock_recover(vehest_clock *clock)
{
    clock->uneven -= (clock->uneven > 0U) ? 1U : 0U;
    clock->recovering -= (clock->recovering > 0U) ? 1U : 0U;
    if (clock->recovering == 0U) {
        clock->fault = 0;
    }
}

static void clock_count_uneven(vehest_clock *clock)
{
    clock->uneven += (clock->uneven < FAULT_CALLS) ? 1U : 0U;
    if (clock->uneven == FAULT_CALLS) {
        clock_suspect(clock, CLOCK_UNEVEN);
    }
}

/* Count a sample whose time is not known as the next one at the input rate. */
static void clock_assume_next(vehest_clock *clock)
{
    clock->last += (double)1.0f / (double)VEHEST_INPUT_RATE_HZ;
    clock->previous = clock->last;
}

static void clock_unstamped(vehest_clock *clock)
{
    clock_assume_next(clock);
    clock_recover(clock);
}

/* Take a stamp that is a number after others [s]. */
static int32_t clock_compare(vehest_clock *clock, double time)
{
    const double gap = time - clock->last;
    const double interval = (time - clock->previous) * (double)VEHEST_INPUT_RATE_HZ;
    const bool is_reset = (gap <= -(double)1.0f);
    const bool advances = (gap > ((double)0.5f / (double)VEHEST_INPUT_RATE_HZ));
    const bool is_even = advances && (interval >= (double)0.6f) && (interval <= (double)1.6f);
    int32_t missing = 0;
    clock->previous = time;
    if (advances) {
        const double before = rint(gap * (double)VEHEST_INPUT_RATE_HZ) - (double)1.0f; /* this one */
        missing = (before < (double)MAX_MISSING) ? (int32_t)before : MAX_MISSING;
        missing = (missing > 0) ? missing : 0;
    }
    if (advances || is_reset) {
        clock->stalled = 0U;
    } else {
        clock->stalled += (clock->stalled < FAULT_CALLS) ? 1U : 0U;
    }
    if (is_even) {
        clock_recover(clock);
    } else if ((interval < (double)0.0f) || (interval > (double)0.0f)) { /* the same stamp again is a repeated sample */
        clock_count_uneven(clock);
    } else {
        /* nothing speaks for or against it */
    }
    if (is_reset || (missing == MAX_MISSING)) {
        clock_suspect(clock, CLOCK_JUMPED);
    }
    if (clock->stalled == FAULT_CALLS) {
        clock_suspect(clock, CLOCK_STOPPED);
        missing = STOPPED;
    } else if (advances || is_reset) {
        clock->last = time;
    } else {
        missing = REPEATED;
    }
    return missing;
}

/* Take the stamp of a sample [s]; returns how many are missing before it, REPEATED or STOPPED. */
static int32_t clock_missing_before(vehest_clock *clock, double time)
{
    int32_t missing = 0;
    if (!(fabs(time) < (double)INFINITY)) { /* true for NaN */
        clock_assume_next(clock);
        clock_count_uneven(clock);
    } else if (clock->last < (double)INFINITY) { /* false for NaN, before the first stamp */
        missing = clock_compare(clock, time);
    } else {
        clock->last = time;
        clock->previous = time;
    }
    return missing;
}

/* Watch: bound, bridge and judge what the method says (vehest.trust.watch). */

#define INTERVAL 0.00999999978f /* [s] */
#define TOP_SPEED 120.0f /* [m/s] */
#define LARGEST_TAN 1.0f /* |v|/max(u, 1 m/s) that is believed */

static void watch_start(vehest_watch *watch)
{
    watch->vy = VEHEST_NAN;
    watch->speed = 0.0f;
    watch->spinning = 0.0f;
    watch->beyond = 0.0f;
    watch->since_start = 0U;
    watch->lost = false;
}

/* The largest |v| that is believed, from the speed and, while the car spins, from the speed before. */
static vehest_real bound_of(vehest_watch *watch, vehest_real u, vehest_real yaw_rate, vehest_real ay)
{
    const bool spins = VEHEST_ABS(ay - (u * yaw_rate)) > 4.0f; /* [m/s2]; false where one is not known */
    const vehest_real unknown = is_nan(u) ? TOP_SPEED : 0.0f;
    const vehest_real remembered = (watch->speed > 0.0f) ? (watch->speed * 0.996672213f) : unknown; /* exp(-INTERVAL / 3.0 s) */
    const vehest_real speed = is_nan(u) ? remembered : smaller(VEHEST_ABS(u), TOP_SPEED);
    watch->spinning = spins ? smaller(watch->spinning + INTERVAL, 0.600000024f) : larger(watch->spinning - INTERVAL, 0.0f);
    watch->speed = larger(speed, remembered);
    return LARGEST_TAN * larger((watch->spinning > 0.0f) ? watch->speed : speed, 1.0f);
}

/* Pass on the method's value or what stands for it; returns its marks. */
static uint8_t watch_step(vehest_watch *watch, vehest_real said, vehest_real u, vehest_real yaw_rate, vehest_real ay, flow_of_sample flow)
{
    const bool begins = (flow == RESTART) || (watch->lost && (flow != WAIT));
    uint32_t marks = 0U;
    vehest_real told = VEHEST_NAN;
    vehest_real bound;
    bool lost = false;
    watch->since_start = begins ? 0U : counted(watch->since_start);
    watch->lost = watch->lost && (flow == WAIT);
    if (begins) {
        marks |= VEHEST_STARTED;
        watch->beyond = 0.0f;
    }
    bound = bound_of(watch, u, yaw_rate, ay);
    if (watch->spinning > 0.300000012f) {
        marks |= VEHEST_SPINNING;
    }
    if (flow != WAIT) {
        if (!is_finite(said)) {
            lost = true;
        } else if (VEHEST_ABS(said) > bound) {
            watch->beyond += INTERVAL;
            marks |= VEHEST_CLIPPED;
            told = (said < 0.0f) ? -bound : bound;
            lost = (watch->beyond > 0.300000012f);
        } else {
            told = said;
            watch->beyond = 0.0f;
        }
    }
    if (is_nan(told)) {
        told = watch->vy * 0.990049839f; /* exp(-INTERVAL / 1.0 s) */
        if (VEHEST_ABS(told) > bound) {
            told = (told < 0.0f) ? -bound : bound;
        }
        marks |= VEHEST_EXTRAPOLATED;
    }
    watch->vy = told;
    watch->lost = watch->lost || lost;
    return (uint8_t)marks;
}

/* Verdict: what follows from health, and what is said of the estimate (vehest.trust.verdict). */

#define MISSING 1
#define SPIN 13
#define NO_ESTIMATE 30
#define BEYOND_SPEED 31

static const int32_t NUMBER[C] = { 1, 2, 4 }; /* of the channels in reasons */

#define FREE 0
#define OUTSIDE 12
#define PERSISTENT 200U /* samples of accusation after which a fault is persistent */

/* Take accused channels out of the sample, and have the method start anew after faults. */
static void isolate(vehest_state *state, uint8_t status, int32_t reason, cleaned_sample *cleaned)
{
    const int32_t kind = reason / 10000;
    const int32_t accused = (reason % 10000) / 100;
    const bool at_fault = (status == VEHEST_INVALID) && (kind != FREE) && (kind != MISSING) && (kind != OUTSIDE) && (kind != SPIN);
    if (at_fault) {
        bool needed = true;
        state->at_fault = counted(state->at_fault);
        for (int32_t c = 0; c < C; c++) {
            if (SKIPPABLE[c] && (NUMBER[c] == accused)) {
                cleaned->row[c] = VEHEST_NAN;
                cleaned->measured[c] = false;
                needed = false;
            }
        }
        if (needed) {
            state->needed_at_fault = counted(state->needed_at_fault);
        }
    } else if (status == VEHEST_VALID) {
        if ((cleaned->flow == USE) && (state->at_fault >= PERSISTENT)) {
            cleaned->flow = RESTART;
        }
        state->at_fault = 0U;
        state->needed_at_fault = 0U;
    } else {
        /* nothing changes */
    }
}

/* Add to health what guard and watch know. */
static void conclude(vehest_estimate *estimate, const cleaned_sample *cleaned)
{
    for (int32_t c = 0; c < C; c++) {
        if (!SKIPPABLE[c] && !cleaned->measured[c] && (estimate->reason == 0)) {
            estimate->health = (estimate->health > VEHEST_DEGRADED) ? estimate->health : (uint8_t)VEHEST_DEGRADED;
            estimate->reason = (MISSING * 10000) + (NUMBER[c] * 100);
        }
    }
    if (((estimate->marks & VEHEST_SPINNING) != 0U) && (estimate->health == VEHEST_VALID)) {
        estimate->health = VEHEST_DEGRADED;
        estimate->reason = SPIN * 10000;
    }
    if ((estimate->marks & VEHEST_CLIPPED) != 0U) {
        estimate->health = VEHEST_INVALID;
        estimate->reason = (estimate->reason == 0) ? (BEYOND_SPEED * 10000) : estimate->reason;
    }
    if (((estimate->marks & VEHEST_EXTRAPOLATED) != 0U) || (cleaned->flow == WAIT) || !is_finite(estimate->vy)) {
        estimate->health = VEHEST_INVALID;
        estimate->reason = (estimate->reason == 0) ? (NO_ESTIMATE * 10000) : estimate->reason;
    }
}

/* Bands: half width = q s(x) w(x) (vehest.trust.bands). */

#define TERMS 8
#define FIRST_FEATURE 2 /* from which on terms have a domain */
#define LOWEST_SPEED 1.0f /* [m/s] below which an error of vy says no more of sideslip */
#define PI 3.14159274f

static const vehest_real WEIGHT_VY[TERMS] = { 1.20000005f, 0.00999999978f, 9.99999975e-06f, 0.0f, 0.00100000005f, 0.00100000005f, 0.0f, 0.0199999996f }; /* P, 1, vx, ax, ay, yaw rate vx, steer vx, vy */
static const vehest_real WEIGHT_SIDESLIP[TERMS] = { 1.20000005f, 0.00999999978f, 9.99999975e-06f, 0.0f, 0.00100000005f, 0.00100000005f, 0.0f, 0.0199999996f };
static const vehest_real LARGEST[TERMS] = { 0.0f, 0.0f, 20.0f, 3.0f, 5.0f, 5.0f, 1.0f, 0.5f }; /* 99.9th percentile of each in training */
#define TOO_WIDE 32
static const vehest_real WIDEST = 0.104719758f; /* [rad] half width of the band of sideslip, beyond which an estimate is invalid */
static const vehest_real WIDER[3] = { 1.0f, 2.0f, 4.0f }; /* while valid, degraded, invalid */

/* Half widths from what the method read, its estimate and its own variance. */
static void find_bands(const cleaned_sample *cleaned, vehest_real variance, vehest_estimate *estimate)
{
    const vehest_real vx = cleaned->row[VEHEST_VX];
    vehest_real term[TERMS];
    vehest_real squared_vy = 0.0f;
    vehest_real squared_sideslip = 0.0f;
    vehest_real wider = 1.0f;
    term[0] = (variance >= 0.0f) ? VEHEST_SQRT(variance) : VEHEST_NAN;
    term[1] = 1.0f;
    term[2] = vx;
    term[3] = VEHEST_NAN;
    term[4] = cleaned->row[VEHEST_AY];
    term[5] = cleaned->row[VEHEST_YAW_RATE] * vx;
    term[6] = VEHEST_NAN * vx;
    term[7] = estimate->vy;
    for (int32_t j = 0; j < TERMS; j++) { /* s^2 is a weighted sum of squares, w the farthest beyond the training */
        vehest_real size = VEHEST_ABS(term[j]);
        if (!is_finite(size)) {
            size = LARGEST[j];
        }
        if ((j >= FIRST_FEATURE) && (LARGEST[j] > 0.0f) && ((size / LARGEST[j]) > wider)) {
            wider = size / LARGEST[j];
        }
        squared_vy += WEIGHT_VY[j] * size * size;
        squared_sideslip += WEIGHT_SIDESLIP[j] * size * size;
    }
    estimate->band_vy = 1.75f * wider * VEHEST_SQRT(larger(squared_vy, 0.00039999999f));
    estimate->band_sideslip = PI;
    if (is_finite(vx)) {
        const vehest_real speed = larger(VEHEST_ABS(vx), LOWEST_SPEED);
        const vehest_real scale = VEHEST_SQRT(larger(squared_sideslip / (speed * speed), 9.99999997e-07f));
        estimate->band_sideslip = smaller(1.75f * wider * scale, PI);
    }
}

/* Widen the band of an estimate that is not valid, and make one invalid whose band is too wide; vx is the speed that goes with it. */
static void widen(vehest_real vx, vehest_estimate *estimate)
{
    const vehest_real wider = WIDER[estimate->health];
    estimate->band_vy *= wider;
    estimate->band_sideslip = smaller(estimate->band_sideslip * wider, PI);
    if ((estimate->marks & VEHEST_EXTRAPOLATED) != 0U) {
        const vehest_real reach = VEHEST_ABS(estimate->vy) + 0.5f;
        const vehest_real speed = larger(VEHEST_ABS(vx), 1.0f);
        estimate->band_vy = larger(estimate->band_vy, reach);
        if (is_finite(speed)) {
            estimate->band_sideslip = larger(estimate->band_sideslip, smaller(VEHEST_ATAN(reach / speed), PI));
        }
    }
    if (estimate->band_sideslip > WIDEST) {
        estimate->health = VEHEST_INVALID;
        estimate->reason = (estimate->reason == 0) ? (TOO_WIDE * 10000) : estimate->reason;
    }
}

/* What the method says of a sample; returns whether it failed. */
static bool run_method(vehest_state *state, const cleaned_sample *cleaned, vehest_method_output *output)
{
    bool failed = false;
    if (cleaned->flow != WAIT) {
        if ((cleaned->flow == RESTART) && !state->fresh) {
            vehest_method_start(&state->method);
        }
        state->fresh = false;
        failed = !vehest_method_step(&state->method, cleaned->row, output);
    }
    if ((cleaned->flow == WAIT) || failed) {
        output->vy = VEHEST_NAN;
        output->vx = VEHEST_NAN;
        output->yaw_rate = VEHEST_NAN;
        output->vy_variance = VEHEST_NAN;
    }
    return failed;
}

/* One row at the method's rate: from what was received to the estimate. */
static void step_row(vehest_state *state, const vehest_real row[C])
{
    vehest_estimate *const estimate = &state->last;
    cleaned_sample sample;
    const cleaned_sample *const cleaned = &sample;
    vehest_method_output output;
    vehest_real vx;
    bool failed;
    estimate->health = VEHEST_VALID;
    estimate->reason = 0;
    guard_step(&state->guard, LIMITS, BRIDGED, PERSISTS, true, row, &sample);
    estimate->health = vehest_health_step(&state->health, row, cleaned->measured, &estimate->reason);
    isolate(state, estimate->health, estimate->reason, &sample);
    if (state->clock.fault != 0) {
        estimate->health = VEHEST_INVALID;
        estimate->reason = state->clock.fault * 10000;
    }
    failed = run_method(state, cleaned, &output);
    vx = ((cleaned->flow != WAIT) || cleaned->measured[VEHEST_VX]) ? cleaned->row[VEHEST_VX] : VEHEST_NAN;
    vx = is_nan(vx) ? output.vx : vx;
    estimate->marks = watch_step(
        &state->watch, output.vy, vx,
        ((cleaned->flow != WAIT) || cleaned->measured[VEHEST_YAW_RATE]) ? cleaned->row[VEHEST_YAW_RATE] : VEHEST_NAN,
        ((cleaned->flow != WAIT) || cleaned->measured[VEHEST_AY]) ? cleaned->row[VEHEST_AY] : VEHEST_NAN,
        cleaned->flow);
    if (state->watch.lost || failed) {
        if (!state->fresh) {
            vehest_method_start(&state->method);
        }
        state->fresh = true;
    }
    state->vx = is_nan(vx) ? state->vx : vx;
    estimate->vy = state->watch.vy;
    estimate->sideslip = is_nan(state->vx) ? VEHEST_NAN : VEHEST_ATAN2(estimate->vy, state->vx);
    if (((state->vx * state->vx) + (estimate->vy * estimate->vy)) < 0.00999999978f) { /* standstill */
        estimate->sideslip = 0.0f;
    }
    estimate->vx = output.vx;
    estimate->yaw_rate = output.yaw_rate;
    conclude(estimate, cleaned);
    if (is_finite(estimate->vy)) {
        find_bands(cleaned, output.vy_variance, estimate);
        widen(state->vx, estimate);
    } else {
        estimate->band_vy = VEHEST_NAN;
        estimate->band_sideslip = VEHEST_NAN;
    }
}

static bool step_received(vehest_state *state, vehest_real row[C], vehest_estimate *estimate)
{
    const bool due = front_end_step(&state->front_end, row);
    if (due) {
        step_row(state, row);
    }
    *estimate = state->last;
    return due;
}

void vehest_start(vehest_state *state)
{
    front_end_start(&state->front_end);
    guard_start(&state->guard);
    vehest_health_start(&state->health);
    state->at_fault = 0U;
    state->needed_at_fault = 0U;
    vehest_method_start(&state->method);
    state->fresh = true;
    watch_start(&state->watch);
    state->vx = VEHEST_NAN;
    clock_start(&state->clock);
    state->last.vy = VEHEST_NAN;
    state->last.sideslip = VEHEST_NAN;
    state->last.vx = VEHEST_NAN;
    state->last.yaw_rate = VEHEST_NAN;
    state->last.band_vy = VEHEST_NAN;
    state->last.band_sideslip = VEHEST_NAN;
    state->last.reason = NO_ESTIMATE * 10000;
    state->last.health = VEHEST_INVALID;
    state->last.marks = 0U;
}

static bool step_sample(vehest_state *state, const vehest_sample *sample, vehest_estimate *estimate)
{
    vehest_real row[C];
    row[VEHEST_VX] = sample->vx;
    row[VEHEST_YAW_RATE] = sample->yaw_rate;
    row[VEHEST_AY] = sample->ay;
    return step_received(state, row, estimate);
}

static bool step_missing(vehest_state *state, vehest_estimate *estimate)
{
    vehest_real row[C];
    for (int32_t c = 0; c < C; c++) {
        row[c] = VEHEST_NAN;
    }
    return step_received(state, row, estimate);
}

bool vehest_step(vehest_state *state, const vehest_sample *sample, vehest_estimate *estimate)
{
    clock_unstamped(&state->clock);
    return step_sample(state, sample, estimate);
}

bool vehest_missing(vehest_state *state, vehest_estimate *estimate)
{
    clock_unstamped(&state->clock);
    return step_missing(state, estimate);
}

bool vehest_step_at(vehest_state *state, double time, const vehest_sample *sample, vehest_estimate *estimate)
{
    const int32_t missing = clock_missing_before(&state->clock, time);
    bool due = false;
    if (missing == STOPPED) {
        due = step_missing(state, estimate);
    } else if (missing != REPEATED) {
        for (int32_t n = 0; n < missing; n++) {
            due = step_missing(state, estimate) || due;
        }
        due = step_sample(state, sample, estimate) || due;
    } else {
        /* the last estimate again */
    }
    if (state->clock.fault != 0) { /* between two estimates, too */
        state->last.health = VEHEST_INVALID;
        state->last.reason = state->clock.fault * 10000;
    }
    *estimate = state->last;
    return due;
}
