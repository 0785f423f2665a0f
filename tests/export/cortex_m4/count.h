/* Included before main.c: its steps go through the counter of board.c. */
#include "vehest_estimator.h"
bool board_step_at(vehest_state *state, double time, const vehest_sample *sample, vehest_estimate *estimate);
#define vehest_step_at board_step_at
