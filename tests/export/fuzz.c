/* Senseless and plausible samples, missing and repeated ones, one after another: fuzz STEPS SEED. Exit code 1 where the contract breaks. */
#include <stdio.h>
#include <stdlib.h>

#include "vehest_estimator.h"

#define FIELDS ((int)(sizeof(vehest_sample) / sizeof(vehest_real)))

static unsigned long long state_of_numbers;

static double uniform(void) /* between 0 and 1 (Knuth's MMIX) */
{
    state_of_numbers = (6364136223846793005ULL * state_of_numbers) + 1442695040888963407ULL;
    return (double)(state_of_numbers >> 11) / 9007199254740992.0;
}

static vehest_real senseless(vehest_real last)
{
    const vehest_real values[] = { VEHEST_NAN, VEHEST_INFINITY, -VEHEST_INFINITY, (vehest_real)0.0, (vehest_real)-0.0, (vehest_real)1e-38,
        (vehest_real)1e30, (vehest_real)-1e30, (vehest_real)3e38, (vehest_real)1.0, -last, last };
    return values[(int)(uniform() * (double)(sizeof(values) / sizeof(values[0])))];
}

/* What the contract promises of an estimate. */
static const char *broken(const vehest_estimate *estimate, bool known)
{
    if (known && !(VEHEST_ABS(estimate->vy) < VEHEST_INFINITY)) {
        return "vy is not finite after the first estimate";
    }
    if (estimate->vy == VEHEST_INFINITY || estimate->vy == -VEHEST_INFINITY || VEHEST_ABS(estimate->sideslip) > (vehest_real)3.2) {
        return "an estimate is infinite, or an angle beyond a half turn";
    }
    if (estimate->health > VEHEST_INVALID || estimate->marks > 15U || (estimate->health == VEHEST_VALID) != (estimate->reason == 0)) {
        return "health and reason do not go together";
    }
    if (estimate->band_vy < (vehest_real)0.0 || estimate->band_sideslip < (vehest_real)0.0) {
        return "a band is negative";
    }
    return NULL;
}

int main(int argc, char **argv)
{
    const long steps = (argc > 1) ? atol(argv[1]) : 10000;
    vehest_state *state = malloc(sizeof(vehest_state)); /* where the sanitizer sees what lies beside it */
    union {
        vehest_sample sample;
        vehest_real fields[FIELDS];
    } now;
    vehest_real around[FIELDS];
    vehest_estimate estimate;
    bool known = false;
    double time = 0.0;
    state_of_numbers = (argc > 2) ? strtoull(argv[2], NULL, 10) : 1ULL;
    if (state == NULL) {
        return 2;
    }
    vehest_start(state);
    for (int f = 0; f < FIELDS; f++) {
        around[f] = (vehest_real)uniform();
    }
    for (long k = 0; k < steps; k++) {
        const double choice = uniform();
        const bool calm = (k / 400) % 2 == 0; /* stretches in which an estimator may find its feet, and others */
        const char *said;
        for (int f = 0; f < FIELDS; f++) {
            around[f] += (vehest_real)(0.02 * (uniform() - 0.5)) * ((f == 0) ? (vehest_real)5.0 : (vehest_real)1.0);
            now.fields[f] = (calm || uniform() < 0.7) ? around[f] : senseless(around[f]);
        }
        if (!calm && choice < 0.05) {
            (void)vehest_missing(state, &estimate);
        } else if (!calm && choice < 0.3) {
            time = (choice < 0.06) ? (double)senseless(around[0]) : time + (4.0 * (uniform() - 0.2) / (double)VEHEST_INPUT_RATE_HZ);
            (void)vehest_step_at(state, time, &now.sample, &estimate);
        } else {
            (void)vehest_step(state, &now.sample, &estimate);
        }
        said = broken(&estimate, known);
        if (said != NULL) {
            (void)fprintf(stderr, "step %ld: %s: vy %g, sideslip %g, health %d, reason %ld\n", k, said, (double)estimate.vy, (double)estimate.sideslip,
                (int)estimate.health, (long)estimate.reason);
            return 1;
        }
        known = known || estimate.vy == estimate.vy;
        if (uniform() < 1e-4) {
            vehest_start(state);
            known = false;
        }
    }
    (void)printf("%ld steps\n", steps);
    free(state);
    return 0;
}
