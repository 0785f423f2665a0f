/* vehest_health.h: whether the channels are as they were in the training.
 */
#ifndef VEHEST_HEALTH_H
#define VEHEST_HEALTH_H

#include "vehest_types.h"

#define VEHEST_HEALTH_LAGS 1 /* p of the autoregression */
#define VEHEST_HEALTH_RELATIONS 1
#define VEHEST_HEALTH_FEATURES 13
#define VEHEST_HEALTH_STATISTICS 22

typedef struct {
    /* What lasts from sample to sample. */
    uint32_t rows; /* that were seen */
    uint32_t hold; /* rows until a flag is cleared */
    uint32_t spinning; /* rows */
    uint32_t since_jump; /* rows since the yaw rate jumped */
    int32_t reason; /* last one */
    uint8_t status; /* last one */
    vehest_real mean_ax;
    vehest_real drift; /* lateral velocity, as far as it changed lately */
    vehest_real last[VEHEST_CHANNELS];
    int32_t gap[VEHEST_CHANNELS]; /* rows without a sample; below zero while predictions settle again */
    uint32_t run[VEHEST_CHANNELS]; /* equal samples in a row */
    vehest_real share[VEHEST_CHANNELS]; /* of equal samples */
    vehest_real past_y[VEHEST_HEALTH_LAGS][VEHEST_CHANNELS];
    vehest_real innovation[VEHEST_HEALTH_LAGS][VEHEST_CHANNELS];
    vehest_real energy[VEHEST_CHANNELS]; /* of the innovations */
    vehest_real ratio_sum[VEHEST_CHANNELS]; /* of h' S^-1 e */
    vehest_real ratio_weight[VEHEST_CHANNELS]; /* of h' S^-1 h */
    vehest_real average[VEHEST_HEALTH_RELATIONS];
    vehest_real mean_speed[2]; /* short and long */
    vehest_real left[VEHEST_HEALTH_RELATIONS];
    vehest_real smooth[VEHEST_HEALTH_RELATIONS];
    vehest_real product[VEHEST_HEALTH_RELATIONS]; /* means of shown times expected, and of both squares */
    vehest_real expected_power[VEHEST_HEALTH_RELATIONS];
    vehest_real shown_power[VEHEST_HEALTH_RELATIONS];
    /* What is used within a sample; here, so that it takes no stack. */
    vehest_real x[VEHEST_CHANNELS];
    vehest_real y[VEHEST_CHANNELS];
    vehest_real error[VEHEST_CHANNELS]; /* innovation e */
    vehest_real scaled[VEHEST_CHANNELS]; /* e over its level at this speed */
    vehest_real clipped[VEHEST_CHANNELS];
    vehest_real ratio[VEHEST_CHANNELS]; /* likelihood ratio of a jump */
    vehest_real score[VEHEST_CHANNELS]; /* S^-1 e */
    vehest_real clipped_score[VEHEST_CHANNELS];
    vehest_real stepped[VEHEST_CHANNELS]; /* sum over a step */
    vehest_real level[VEHEST_CHANNELS];
    vehest_real feature[VEHEST_HEALTH_FEATURES];
    vehest_real by_yaw_rate[VEHEST_HEALTH_FEATURES]; /* derivatives of the features */
    vehest_real by_speed[VEHEST_HEALTH_FEATURES];
    vehest_real slope[VEHEST_CHANNELS]; /* J */
    vehest_real effect[VEHEST_CHANNELS]; /* h */
    vehest_real statistic[VEHEST_HEALTH_STATISTICS];
} vehest_health;

void vehest_health_start(vehest_health *health);

/* Judge a row.
 *
 * row: as received; arbitrary where measured is false.
 * measured: the values that the guard accepts.
 * reason: output, 0 if there is none.
 *
 * Returns 0 valid, 1 degraded, 2 invalid.
 */
uint8_t vehest_health_step(vehest_health *health, const vehest_real row[VEHEST_CHANNELS], const bool measured[VEHEST_CHANNELS], int32_t *reason);

#endif
