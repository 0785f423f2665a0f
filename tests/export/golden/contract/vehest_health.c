/* vehest_health.c: statistics of each sample against their limits, status and reason.
 *
 * With features phi(x) of yaw rate and speed, channels x become y = x - W phi(x), of which an autoregression predicts the next sample; e is
 * its error, in units of the noise at that speed, S its covariance. A fault that adds b to channel i moves y by J b, J = dy/dx_i, and
 * the innovations by h b. An offset is looked for by its likelihood ratio over exponentially forgotten samples,
 * z = sum(l^j h' S^-1 e) / sqrt(sum(l^2j h' S^-1 h)), which is N(0, 1) without a fault (Willsky & Jones, IEEE Trans. Automatic Control
 * 21 (1), 1976; windows replaced by forgetting). The source of every line is vehest.trust.health_kernel.
 */
#include "vehest_health.h"

#include <string.h>

#define C VEHEST_CHANNELS
#define P VEHEST_HEALTH_LAGS
#define R VEHEST_HEALTH_RELATIONS
#define FEATURES VEHEST_HEALTH_FEATURES
#define INSTANT_FEATURES 6 /* those that relations which hold for each sample may use */
#define LEVELS 5 /* speeds at which the noise is known */
#define STATISTICS VEHEST_HEALTH_STATISTICS

/* Where statistics of a kind begin. */
#define AT_JUMP 0
#define AT_STEP C
#define AT_OFFSET (2 * C)
#define AT_RUN (3 * C)
#define AT_SHARE (4 * C)
#define AT_DOMAIN (5 * C)
#define AT_SLIP (6 * C)
#define AT_RELATION (7 * C)

/* Kinds of reasons. */
#define FREE 0
#define FROZEN 2
#define HELD 3
#define JUMP 4
#define OFFSET 7
#define SIGN 9
#define UNIT 10
#define CONTRADICTION 11
#define OUTSIDE 12
#define MISSING 1
#define SPIN 13
#define LOCKED 14
#define DROPOUT 15
#define NONE (-1)

#define VALID 0U
#define DEGRADED 1U
#define INVALID 2U

static const vehest_real PLAUSIBLE = 1000.0f; /* times the largest size in training, beyond which a value counts as not measured */
static const vehest_real CLIP = 4.0f; /* standard deviations */
static const vehest_real STEP_CLIP = 8.0f; /* the same for steps and for the energy */
static const vehest_real CALM = 0.300000012f; /* of the mean energy: least energy of a calm stretch */
static const vehest_real CAP = 2.0f; /* times its limit, beyond which a statistic remembers no more */
static const vehest_real CLEARLY = 1.5f; /* times its limit, from which on an estimate is invalid */
static const vehest_real CLEAR = 0.949999988f; /* times its limit, below which a statistic has to stay */
static const vehest_real REVERSED = -0.5f; /* correlation below which a relation is one of the wrong sign */
static const vehest_real HOLDS = 0.699999988f; /* correlation above which it holds */
static const vehest_real LARGER = 2.5f; /* factor, either way, that makes it one of the wrong unit */

#define ROWS_HOLD 100U
#define ROWS_BRIDGED 50
#define ROWS_SPIN 30U
#define ROWS_SETTLE 50U

static const vehest_real LEAST_SPEED = 2.0f; /* standstill: below this speed, */
static const vehest_real STILL_YAW_RATE = 0.0500000007f; /* this yaw rate */
static const vehest_real STILL_AY = 0.5f; /* and this lateral acceleration */
static const vehest_real STEP = 0.00999999978f; /* sampling interval [s] */
static const vehest_real SPIN_YAW_RATE = 0.800000012f;
static const vehest_real SPIN_TURNING = 12.0f; /* yaw rate times speed */
static const vehest_real FORGET_SHARE = 0.0198013261f; /* of the share of equal samples */
static const vehest_real FORGET_AX = 0.0487705767f;

static const vehest_real USUAL[C] = { 20.0f, 0.0f, 0.0f }; /* medians */
static const vehest_real LARGEST[C] = { 40.0f, 0.600000024f, 9.0f }; /* sizes in training */
static const vehest_real DEVIATION[C] = { 0.0500000007f, 0.00999999978f, 0.200000003f }; /* of the innovations */
static const vehest_real CONSTANT[C] = { 0.100000001f, 0.0f, 0.00999999978f }; /* of the autoregression */
static const bool MODELLED[C] = { true, true, true }; /* by the autoregression */
static const bool RESTS[C] = { false, false, false }; /* whether a channel may stand still while the car moves */
static const vehest_real STOP[2][C] = {
    { -VEHEST_INFINITY, -VEHEST_INFINITY, -VEHEST_INFINITY },
    { VEHEST_INFINITY, VEHEST_INFINITY, VEHEST_INFINITY }
}; /* lower and upper, between which alone a channel is expected to move */
static const int32_t GAP_LIMIT[C] = { 0, 0, 2 }; /* longest gap in training, in rows */
static const int32_t CODE[C] = { 1, 2, 4 }; /* numbers of the channels in reasons */
static const vehest_real SPEEDS[LEVELS] = { 5.0f, 10.0f, 20.0f, 30.0f, 40.0f }; /* at which the noise is known */
static const vehest_real NOISE_LEVEL[LEVELS][C] = {
    { 0.5f, 0.5f, 0.5f },
    { 0.800000012f, 0.800000012f, 0.800000012f },
    { 1.0f, 1.0f, 1.0f },
    { 1.20000005f, 1.20000005f, 1.20000005f },
    { 1.5f, 1.5f, 1.5f }
};
static const vehest_real INSTANT[C][FEATURES] = {
    { 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f },
    { 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f },
    { 0.0500000007f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f }
}; /* W */
static const vehest_real LAG[P][C][C] = {
    {
        { 0.99000001f, 0.0f, 0.0f },
        { 0.0f, 0.899999976f, 0.100000001f },
        { 0.0f, 0.0f, 0.800000012f }
    }
}; /* A of channel m on i: [lag][m][i] */
static const vehest_real PRECISION[C][C] = {
    { 400.0f, 0.0f, 0.0f },
    { 0.0f, 10000.0f, 10.0f },
    { 0.0f, 10.0f, 25.0f }
}; /* S^-1 */
static const vehest_real SETTLED_GAIN[C][C] = {
    { 0.00999999978f, 0.0f, 0.0f },
    { 0.0f, 0.100000001f, -0.100000001f },
    { 0.0f, 0.0f, 0.200000003f }
}; /* 1 - sum of A of channel m on j: [m][j] */
static const vehest_real STEP_WEIGHT[P][C][C] = {
    {
        { 400.0f, 0.0f, 0.0f },
        { 0.0f, 10000.0f, 10.0f },
        { 0.0f, 10.0f, 25.0f }
    }
}; /* of an innovation some samples ago on a step in a channel */
static const vehest_real STEP_POWER[C][C] = {
    { 400.0f, 0.0f, 0.0f },
    { 0.0f, 10000.0f, 10.0f },
    { 0.0f, 10.0f, 25.0f }
};
static const vehest_real HEALTHY[C] = { 0.00999999978f, 0.0f, 0.0199999996f }; /* offsets of healthy drives */
static const vehest_real HEAVIEST[C] = { 10.0f, 20.0f, 30.0f }; /* largest weight of one sample in an offset */
static const vehest_real FORGET_ENERGY = 0.0198013261f;
static const vehest_real FORGET_OFFSET = 0.00249687769f;
static const vehest_real FORGET_SHORT = 0.0392105617f; /* of relations, for signs and units */
static const vehest_real FORGET_RELATION = 0.00995016657f;
static const vehest_real RELATION[R][FEATURES] = {
    { 0.0500000007f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f }
};
static const vehest_real RATE_GAIN[R] = { 0.0f }; /* of du/dt */
static const int32_t TARGET[R] = { 2 }; /* channels that relations explain */
static const int32_t VERSUS[R] = { 1 }; /* channels that they are held against */
static const int32_t INVOLVED[R][C] = {
    { 1, 1, 1 }
}; /* 2: by a small term */
static const vehest_real LIMIT[STATISTICS] = {
    4.0f, 4.25f, 4.5f, 4.75f, 5.0f, 5.25f, 5.5f, 5.75f, 6.0f, 6.25f, 6.5f, 6.75f, 7.0f, 7.25f, 7.5f, 7.75f, 8.0f, 8.25f, 8.5f, 8.75f,
    9.0f, 9.25f
};
static const vehest_real INVERSE[STATISTICS] = {
    0.25f, 0.235294119f, 0.222222224f, 0.210526317f, 0.200000003f, 0.190476194f, 0.181818187f, 0.173913047f, 0.166666672f,
    0.159999996f, 0.15384616f, 0.148148149f, 0.142857149f, 0.137931034f, 0.13333334f, 0.129032254f, 0.125f, 0.121212125f,
    0.117647059f, 0.114285715f, 0.111111112f, 0.108108111f
}; /* of the limits */
static const vehest_real PRIORITY[STATISTICS] = { 2.0f, 2.0f, 2.0f, 2.0f, 2.0f, 2.0f, 4.0f, 4.0f, 4.0f, 8.0f, 8.0f, 8.0f, 7.0f, 7.0f, 7.0f, 1.0f, 1.0f, 1.0f, 9.0f, 9.0f, 9.0f, 3.0f }; /* of reasons */
static const int32_t KIND[STATISTICS] = { 4, 4, 4, 4, 4, 4, 7, 7, 7, 2, 2, 2, 3, 3, 3, 12, 12, 12, 14, 14, 14, 11 };
static const int32_t ACCUSED[STATISTICS] = { 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 2 }; /* channels */
static const int32_t PARTNER[STATISTICS] = { -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 1 }; /* channels; -1: none */

typedef struct {
    int32_t kind;
    int32_t channel;
    int32_t partner; /* NONE if there is none */
} suspicion;

static vehest_real smaller(vehest_real a, vehest_real b)
{
    return (b < a) ? b : a;
}

static vehest_real larger(vehest_real a, vehest_real b)
{
    return (b > a) ? b : a;
}

/* One more, but never beyond what the type holds. */
static uint32_t counted(uint32_t n)
{
    return (n < UINT32_MAX) ? (n + 1U) : n;
}

void vehest_health_start(vehest_health *health)
{
    (void)memset(health, 0, sizeof(*health)); /* all bits 0 are the number 0 */
    for (int32_t i = 0; i < C; i++) {
        health->energy[i] = 1.0f;
    }
}

/* Take a row; returns the channel that has been missing for longest beyond its limit, NONE if none has.
 * The last value stands for one that was not measured. A channel that is back has P rows to settle in.
 */
static int32_t receive(vehest_health *h, const vehest_real row[C], const bool measured[C])
{
    const bool first = (h->rows == 0U);
    int32_t longest = 0;
    int32_t absent = NONE;
    for (int32_t i = 0; i < C; i++) {
        const vehest_real value = row[i];
        const bool known = measured[i] && (VEHEST_ABS(value) <= (PLAUSIBLE * LARGEST[i])); /* false for NaN */
        if (first) {
            h->last[i] = known ? value : USUAL[i];
        }
        if (known) {
            const bool same = (value > STOP[0][i]) && (value < STOP[1][i]) && (value == h->last[i]) && !first;
            h->run[i] = same ? counted(h->run[i]) : 0U;
            h->share[i] += FORGET_SHARE * ((same ? 1.0f : 0.0f) - h->share[i]);
            h->last[i] = value;
            if (h->gap[i] > 0) {
                h->gap[i] = -P;
            } else if (h->gap[i] < 0) {
                h->gap[i]++;
            } else {
                /* it was not missing */
            }
        } else {
            const int32_t before = (h->gap[i] > 0) ? h->gap[i] : 0;
            h->gap[i] = (before < INT32_MAX) ? (before + 1) : before;
            if ((h->gap[i] - GAP_LIMIT[i]) > longest) {
                longest = h->gap[i] - GAP_LIMIT[i];
                absent = i;
            }
        }
        h->x[i] = h->last[i];
    }
    return absent;
}

/* Features with their derivatives, y = x - W phi(x), and the noise at this speed; returns whether the car stands. */
static bool describe(vehest_health *h)
{
    const vehest_real yaw_rate = h->x[1];
    const vehest_real u = h->x[0];
    const vehest_real ay = h->x[2];
    const vehest_real ax = 0.0f;
    const vehest_real speed = VEHEST_ABS(u);
    const vehest_real w = larger(speed, LEAST_SPEED);
    const vehest_real turning = u * yaw_rate;
    const vehest_real bent = 0.03f * turning * turning;
    int32_t at = 0;
    vehest_real share = 0.0f;
    h->feature[0] = 1.0f;
    h->feature[1] = yaw_rate;
    h->feature[2] = u;
    h->feature[3] = turning;
    h->feature[4] = 0.01f * turning * turning * turning;
    h->feature[5] = yaw_rate / w;
    h->feature[6] = ay;
    h->feature[7] = ay / (w * w);
    h->feature[8] = 0.01f * ay * ay * ay;
    h->feature[9] = yaw_rate * yaw_rate;
    h->feature[10] = u * u;
    h->feature[11] = ax;
    h->by_yaw_rate[0] = 0.0f;
    h->by_yaw_rate[1] = 1.0f;
    h->by_yaw_rate[2] = 0.0f;
    h->by_yaw_rate[3] = u;
    h->by_yaw_rate[4] = bent * u;
    h->by_yaw_rate[5] = 1.0f / w;
    h->by_speed[0] = 0.0f;
    h->by_speed[1] = 0.0f;
    h->by_speed[2] = 1.0f;
    h->by_speed[3] = yaw_rate;
    h->by_speed[4] = bent * yaw_rate;
    h->by_speed[5] = (speed > LEAST_SPEED) ? (-yaw_rate / (u * speed)) : 0.0f;
    while ((at < (LEVELS - 2)) && (speed > SPEEDS[at + 1])) {
        at++;
    }
    if (SPEEDS[at + 1] > SPEEDS[at]) {
        share = smaller(larger((speed - SPEEDS[at]) / (SPEEDS[at + 1] - SPEEDS[at]), 0.0f), 1.0f);
    }
    for (int32_t i = 0; i < C; i++) {
        vehest_real total = h->x[i];
        h->level[i] = ((1.0f - share) * NOISE_LEVEL[at][i]) + (share * NOISE_LEVEL[at + 1][i]);
        for (int32_t f = 0; f < INSTANT_FEATURES; f++) {
            total -= INSTANT[i][f] * h->feature[f];
        }
        h->y[i] = total;
    }
    h->drift += 0.00999999978f * (h->y[2] - (h->drift / 4.0f));
    h->drift = smaller(larger(h->drift, -speed), speed);
    h->feature[12] = h->drift * yaw_rate;
    return (speed < LEAST_SPEED) && (VEHEST_ABS(yaw_rate) < STILL_YAW_RATE) && (VEHEST_ABS(ay) < STILL_AY);
}

/* Whether channel i was measured, and so was what its relation is made of, for long enough to be predicted. */
static bool usable(const vehest_health *h, int32_t i)
{
    bool found = (h->rows >= ROWS_SETTLE) && MODELLED[i] && (h->gap[i] == 0);
    for (int32_t f = 1; f < INSTANT_FEATURES; f++) {
        if (INSTANT[i][f] != 0.0f) {
            if ((h->by_yaw_rate[f] != 0.0f) && (h->gap[1] != 0)) {
                found = false;
            }
            if ((h->by_speed[f] != 0.0f) && (h->gap[0] != 0)) {
                found = false;
            }
        }
    }
    return found;
}

/* Innovations, scaled and clipped, and their scores S^-1 e; zero where nothing can be predicted. */
static void predict(vehest_health *h)
{
    for (int32_t i = 0; i < C; i++) {
        h->error[i] = CONSTANT[i];
    }
    for (int32_t lag = 0; lag < P; lag++) { /* y = c + A_1 y_1 + ... + A_p y_p */
        for (int32_t m = 0; m < C; m++) {
            for (int32_t i = 0; i < C; i++) {
                h->error[i] += LAG[lag][m][i] * h->past_y[lag][m];
            }
        }
    }
    for (int32_t lag = P - 1; lag > 0; lag--) {
        for (int32_t i = 0; i < C; i++) {
            h->innovation[lag][i] = h->innovation[lag - 1][i];
        }
    }
    for (int32_t i = 0; i < C; i++) {
        vehest_real own;
        if (usable(h, i)) {
            h->error[i] = h->y[i] - h->error[i];
        } else {
            if ((h->gap[i] > 0) && (h->rows >= (uint32_t)P)) {
                h->y[i] = h->error[i];
            }
            h->error[i] = 0.0f;
        }
        own = h->error[i] / h->level[i];
        h->scaled[i] = own;
        h->clipped[i] = smaller(larger(own, -CLIP * DEVIATION[i]), CLIP * DEVIATION[i]);
        h->innovation[0][i] = smaller(larger(own, -STEP_CLIP * DEVIATION[i]), STEP_CLIP * DEVIATION[i]);
    }
    for (int32_t i = 0; i < C; i++) { /* S^-1 e, and the sum over a step that began P samples ago */
        vehest_real score = 0.0f;
        vehest_real clipped = 0.0f;
        vehest_real stepped = 0.0f;
        for (int32_t j = 0; j < C; j++) {
            score += PRECISION[i][j] * h->scaled[j];
            clipped += PRECISION[i][j] * h->clipped[j];
        }
        for (int32_t lag = 0; lag < P; lag++) {
            for (int32_t j = 0; j < C; j++) {
                stepped += STEP_WEIGHT[lag][i][j] * h->innovation[lag][j];
            }
        }
        h->score[i] = score;
        h->clipped_score[i] = clipped;
        h->stepped[i] = stepped;
    }
}

/* Jumps out of what has been usual for half a second. */
static void look_at_innovations(vehest_health *h)
{
    for (int32_t i = 0; i < C; i++) {
        const vehest_real z = MODELLED[i] ? (VEHEST_ABS(h->score[i]) / VEHEST_SQRT(PRECISION[i][i])) : 0.0f;
        const vehest_real normed = h->innovation[0][i] / DEVIATION[i];
        const vehest_real jump = z / VEHEST_SQRT(CALM + h->energy[i]);
        h->ratio[i] = z;
        h->statistic[AT_JUMP + i] = jump;
        if (i == 1) {
            h->since_jump = (jump > LIMIT[i]) ? 0U : counted(h->since_jump);
        }
        h->energy[i] += FORGET_ENERGY * ((normed * normed) - h->energy[i]);
    }
}

/* J = dy/dx_i. */
static void find_slope(vehest_health *h, int32_t i)
{
    for (int32_t m = 0; m < C; m++) {
        vehest_real total = (m == i) ? 1.0f : 0.0f;
        if (i == 1) {
            for (int32_t f = 1; f < INSTANT_FEATURES; f++) {
                total -= INSTANT[m][f] * h->by_yaw_rate[f];
            }
        }
        if (i == 0) {
            for (int32_t f = 1; f < INSTANT_FEATURES; f++) {
                total -= INSTANT[m][f] * h->by_speed[f];
            }
        }
        h->slope[m] = total;
    }
}

/* A step in channel i that began P samples ago. */
static void look_for_step(vehest_health *h, int32_t i, bool counts)
{
    vehest_real step = 0.0f;
    vehest_real power = 0.0f;
    for (int32_t m = 0; m < C; m++) {
        if (h->slope[m] != 0.0f) {
            const vehest_real own = h->slope[m] / h->level[m];
            step += own * h->stepped[m];
            for (int32_t j = 0; j < C; j++) {
                power += own * STEP_POWER[m][j] * h->slope[j] / h->level[j];
            }
        }
    }
    h->statistic[AT_STEP + i] = (counts && (power > 0.0f)) ? (VEHEST_ABS(step) / VEHEST_SQRT(power)) : 0.0f;
}

/* Likelihood ratio of an offset in channel i; h is its effect on the scaled innovations. */
static void look_for_offset(vehest_health *h, int32_t i, bool counts)
{
    const vehest_real keep = 1.0f - FORGET_OFFSET;
    vehest_real top = 0.0f;
    vehest_real weight = 0.0f;
    vehest_real share;
    for (int32_t j = 0; j < C; j++) {
        vehest_real effect = 0.0f;
        for (int32_t m = 0; m < C; m++) {
            effect += SETTLED_GAIN[m][j] * h->slope[m];
        }
        h->effect[j] = effect / h->level[j];
    }
    for (int32_t m = 0; m < C; m++) { /* h' S^-1 e and h' S^-1 h */
        vehest_real inner = 0.0f;
        top += h->effect[m] * h->clipped_score[m];
        for (int32_t j = 0; j < C; j++) {
            inner += PRECISION[m][j] * h->effect[j];
        }
        weight += h->effect[m] * inner;
    }
    share = (counts && (weight > 0.0f)) ? smaller(HEAVIEST[i] / weight, 1.0f) : 0.0f;
    top = share * top;
    weight = share * weight;
    h->ratio_sum[i] = ((keep * h->ratio_sum[i]) + top) - (HEALTHY[i] * weight); /* z = sum / sqrt(weight), forgotten exponentially */
    h->ratio_weight[i] = (keep * keep * h->ratio_weight[i]) + weight;
    h->statistic[AT_OFFSET + i] = (h->ratio_weight[i] > 0.0f) ? (VEHEST_ABS(h->ratio_sum[i]) / VEHEST_SQRT(h->ratio_weight[i])) : 0.0f;
}

/* Steps and offsets of each channel. */
static void look_for_offsets(vehest_health *h)
{
    vehest_real highest = 0.0f;
    for (int32_t i = 0; i < C; i++) {
        const bool counts = (h->rows >= ROWS_SETTLE) && MODELLED[i] && (h->gap[i] == 0);
        find_slope(h, i);
        look_for_step(h, i, counts);
        look_for_offset(h, i, counts);
        highest = larger(highest, h->statistic[AT_OFFSET + i] * INVERSE[AT_OFFSET + i]);
    }
    if (highest > CAP) { /* all alike, so that they still compare with each other */
        for (int32_t i = 0; i < C; i++) {
            h->statistic[AT_OFFSET + i] *= CAP / highest;
            h->ratio_sum[i] *= CAP / highest;
        }
    }
}

/* Runs and shares of equal samples, range, slip; returns how many wheels are slow. */
static int32_t look_at_values(vehest_health *h, bool still)
{
    int32_t slow = 0;
    for (int32_t i = 0; i < C; i++) {
        const bool quiet = still || RESTS[i];
        h->statistic[AT_RUN + i] = quiet ? 0.0f : (vehest_real)h->run[i];
        h->statistic[AT_SHARE + i] = quiet ? 0.0f : h->share[i];
        h->statistic[AT_DOMAIN + i] = VEHEST_ABS(h->x[i]) / LARGEST[i];
        h->statistic[AT_SLIP + i] = 0.0f;
    }
    return slow;
}

/* Residual of relation j, and the means that show whether it holds by far. */
static void look_at_relation(vehest_health *h, int32_t j, bool still, bool complete)
{
    const vehest_real u = h->x[0];
    const vehest_real gain = still ? 0.0f : RATE_GAIN[j];
    const vehest_real change = gain * (u - h->mean_speed[1]) * FORGET_RELATION / ((1.0f - FORGET_RELATION) * STEP); /* mean of du/dt */
    const vehest_real roof = CAP * LIMIT[AT_RELATION + j];
    vehest_real size;
    vehest_real left = h->x[TARGET[j]];
    vehest_real small = 0.0f; /* terms of drag: a fault of the yaw rate or ay is no sign or unit of ax */
    vehest_real shown;
    vehest_real expected;
    for (int32_t f = 0; f < FEATURES; f++) {
        const vehest_real own = RELATION[j][f] * h->feature[f];
        left -= own;
        small += (f >= 9) ? own : 0.0f;
    }
    if (still) {
        left = 0.0f;
        small = 0.0f;
    }
    if (complete) {
        h->left[j] += FORGET_SHORT * ((left + small) - h->left[j]);
        h->smooth[j] += FORGET_SHORT * (h->x[TARGET[j]] - h->smooth[j]);
    }
    shown = h->smooth[j];
    expected = (shown - h->left[j]) + (gain * (u - h->mean_speed[0]) * FORGET_SHORT / ((1.0f - FORGET_SHORT) * STEP));
    h->product[j] += FORGET_RELATION * ((shown * expected) - h->product[j]);
    h->expected_power[j] += FORGET_RELATION * ((expected * expected) - h->expected_power[j]);
    h->shown_power[j] += FORGET_RELATION * ((shown * shown) - h->shown_power[j]);
    if (complete) {
        h->average[j] += FORGET_RELATION * (left - h->average[j]);
    }
    size = VEHEST_ABS(h->average[j] - change);
    if (size > roof) {
        h->average[j] = change + ((h->average[j] - change) * roof / size);
        size = roof;
    }
    h->statistic[AT_RELATION + j] = size;
}

/* Means of the residuals of relations. */
static void look_at_relations(vehest_health *h, bool still)
{
    const vehest_real u = h->x[0];
    bool complete = true;
    for (int32_t i = 0; i < C; i++) {
        complete = complete && (h->gap[i] <= 0);
    }
    if (h->rows == 0U) {
        h->mean_speed[0] = u;
        h->mean_speed[1] = u;
    }
    h->mean_speed[0] += FORGET_SHORT * (u - h->mean_speed[0]);
    h->mean_speed[1] += FORGET_RELATION * (u - h->mean_speed[1]);
    for (int32_t j = 0; j < R; j++) {
        look_at_relation(h, j, still, complete);
    }
    h->mean_ax += FORGET_AX * (0.0f - h->mean_ax);
}

/* Of the last second: FREE if a relation holds, SIGN or UNIT if not by far, NONE if the signals are too small. */
static int32_t judge_relation(const vehest_health *h, int32_t j)
{
    const vehest_real expected = h->expected_power[j];
    const vehest_real shown = h->shown_power[j];
    const vehest_real roof = LIMIT[AT_RELATION + j];
    int32_t found;
    if (larger(expected, shown) < (roof * roof)) {
        found = NONE;
    } else if ((expected > (LARGER * LARGER * shown)) || (shown > (LARGER * LARGER * expected))) {
        found = UNIT;
    } else if (h->product[j] < (REVERSED * VEHEST_SQRT(expected * shown))) {
        found = SIGN;
    } else if (h->product[j] > (HOLDS * VEHEST_SQRT(expected * shown))) {
        found = FREE;
    } else {
        found = NONE;
    }
    return found;
}

/* Cause of relations that fail by far: the one channel that is in all that fail and in none that holds.
 * Channels that only ever occur together in failing relations contradict each other; which of them is wrong cannot be decided.
 */
static suspicion find_contradiction(const vehest_health *h)
{
    suspicion found = { FREE, 0, NONE };
    int32_t judged[R];
    int32_t kind = FREE;
    int32_t failed = NONE;
    for (int32_t j = 0; j < R; j++) {
        judged[j] = judge_relation(h, j);
        if (judged[j] > FREE) {
            failed = (failed < 0) ? j : failed;
            kind = ((kind == FREE) || (kind == judged[j])) ? judged[j] : UNIT;
        }
    }
    if (failed >= 0) {
        int32_t suspects = 0;
        int32_t culprit = NONE;
        for (int32_t i = 0; i < C; i++) {
            bool explains = true;
            for (int32_t j = 0; j < R; j++) {
                if (((judged[j] > FREE) && (INVOLVED[j][i] == 0)) || ((judged[j] == FREE) && (INVOLVED[j][i] == 1))) {
                    explains = false;
                }
            }
            if (explains) {
                suspects++;
                culprit = i;
            }
        }
        if (suspects == 1) {
            found.kind = kind;
            found.channel = culprit;
        } else {
            found.kind = CONTRADICTION;
            found.channel = TARGET[failed];
            found.partner = VERSUS[failed];
        }
    }
    return found;
}

/* Reason of the weightiest statistic beyond its limit, and the largest statistic over its limit. */
static suspicion find_reason(const vehest_health *h, int32_t slow, vehest_real *highest)
{
    suspicion found = { FREE, 0, NONE };
    vehest_real weightiest = -1.0f;
    int32_t best = NONE;
    *highest = 0.0f;
    for (int32_t m = 0; m < STATISTICS; m++) {
        const vehest_real over = h->statistic[m] * INVERSE[m];
        *highest = larger(*highest, over);
        if (over >= 1.0f) {
            const vehest_real weight = PRIORITY[m] + (0.5f * over / (1.0f + over));
            if (weight > weightiest) {
                weightiest = weight;
                best = m;
            }
        }
    }
    if (best >= 0) {
        found.kind = KIND[best];
        found.channel = ACCUSED[best];
        found.partner = PARTNER[best];
        if ((found.kind == JUMP) || (found.kind == OFFSET)) { /* likelihood ratios of the same form compare with each other as they are */
            vehest_real likeliest = -1.0f;
            for (int32_t i = 0; i < C; i++) {
                const vehest_real ratio = (best < C) ? h->ratio[i] : h->statistic[(best - (best % C)) + i];
                if (ratio > likeliest) {
                    likeliest = ratio;
                    found.channel = i;
                }
            }
        }
        (void)slow;
        if ((found.kind == OFFSET) || (found.kind == CONTRADICTION)) {
            const suspicion contradiction = find_contradiction(h);
            if (contradiction.kind != FREE) {
                found = contradiction;
            }
        }
    }
    return found;
}

/* Status and reason from all statistics. */
static uint8_t decide(vehest_health *h, int32_t absent, int32_t slow, int32_t *reason)
{
    vehest_real highest;
    suspicion found = find_reason(h, slow, &highest);
    uint8_t level = VALID;
    bool spins = false;
    if (found.kind != FREE) {
        const bool certain = (found.kind == FROZEN) || (found.kind == HELD) || (found.kind == SIGN) || (found.kind == UNIT)
            || (found.kind == DROPOUT);
        level = (certain || ((highest >= CLEARLY) && (found.kind != OUTSIDE))) ? INVALID : DEGRADED;
    }
    spins = (VEHEST_ABS(h->x[1]) > SPIN_YAW_RATE)
        && (VEHEST_ABS(h->x[1] * h->x[0]) > SPIN_TURNING);
    h->spinning = (spins && (h->since_jump > (5U * ROWS_SPIN))) ? counted(h->spinning) : 0U;
    if (h->spinning > ROWS_SPIN) {
        level = INVALID;
        found.kind = SPIN;
        found.channel = 1;
        found.partner = NONE;
    }
    if (absent >= 0) {
        if ((h->gap[absent] - GAP_LIMIT[absent]) > ROWS_BRIDGED) {
            level = INVALID;
        } else if (level < DEGRADED) {
            level = DEGRADED;
        } else {
            /* it stays */
        }
        found.kind = MISSING;
        found.channel = absent;
        found.partner = NONE;
    }
    *reason = 0;
    if (level > VALID) {
        *reason = (found.kind * 10000) + (CODE[found.channel] * 100) + ((found.partner >= 0) ? CODE[found.partner] : 0);
        h->hold = ROWS_HOLD;
        h->reason = *reason;
        h->status = level;
    } else if (h->hold > 0U) { /* a flag is taken back only after all statistics stayed clear of their limits for a while */
        h->hold = (highest < CLEAR) ? (h->hold - 1U) : ROWS_HOLD;
        level = h->status;
        *reason = h->reason;
    } else {
        /* no fault found */
    }
    return level;
}

/* Shift the samples that the next row is predicted from. */
static void remember(vehest_health *h)
{
    for (int32_t lag = P - 1; lag > 0; lag--) {
        for (int32_t i = 0; i < C; i++) {
            h->past_y[lag][i] = h->past_y[lag - 1][i];
        }
    }
    for (int32_t i = 0; i < C; i++) {
        h->past_y[0][i] = h->y[i];
    }
    h->rows = counted(h->rows);
}

uint8_t vehest_health_step(vehest_health *health, const vehest_real row[VEHEST_CHANNELS], const bool measured[VEHEST_CHANNELS], int32_t *reason)
{
    const int32_t absent = receive(health, row, measured);
    const bool still = describe(health);
    int32_t slow;
    uint8_t status;
    predict(health);
    look_at_innovations(health);
    look_for_offsets(health);
    slow = look_at_values(health, still);
    look_at_relations(health, still);
    status = decide(health, absent, slow, reason);
    remember(health);
    return status;
}
