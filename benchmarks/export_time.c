/* Nanoseconds a step of an exported model over a drive, the least of some passes: export_time ROWS.bin PASSES. */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "vehest_estimator.h"

static double now(void)
{
    struct timespec at;
    (void)clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &at);
    return (double)at.tv_sec + (1e-9 * (double)at.tv_nsec);
}

int main(int argc, char **argv)
{
    static vehest_state state;
    static vehest_method method;
    FILE *file = (argc > 2) ? fopen(argv[1], "rb") : NULL;
    double row[VEHEST_CHANNELS];
    vehest_real *rows = NULL;
    long steps = 0;
    double least[2] = { 1e9, 1e9 };
    double sum = 0.0;
    if (file == NULL) {
        return 2;
    }
    while (fread(row, sizeof(row), 1, file) == 1) {
        rows = realloc(rows, sizeof(vehest_real) * (size_t)(steps + 1) * VEHEST_CHANNELS);
        for (int c = 0; c < VEHEST_CHANNELS; c++) {
            rows[(steps * VEHEST_CHANNELS) + c] = (vehest_real)row[c];
        }
        steps++;
    }
    (void)fclose(file);
    for (int pass = 0; pass < atoi(argv[2]); pass++) {
        double begun = now();
        vehest_start(&state);
        for (long k = 0; k < steps; k++) {
            vehest_sample sample;
            vehest_estimate estimate;
            memcpy(&sample, &rows[k * VEHEST_CHANNELS], sizeof(sample)); /* the fields are the channels, in their order */
            (void)vehest_step(&state, &sample, &estimate);
            sum += (double)estimate.vy;
        }
        least[0] = (now() - begun < least[0]) ? now() - begun : least[0];
        begun = now();
        vehest_method_start(&method);
        for (long k = 0; k < steps; k++) {
            vehest_method_output output;
            (void)vehest_method_step(&method, &rows[k * VEHEST_CHANNELS], &output);
            sum += (double)output.vy;
        }
        least[1] = (now() - begun < least[1]) ? now() - begun : least[1];
    }
    (void)printf("%.9g %.9g %g\n", 1e9 * least[0] / (double)steps, 1e9 * least[1] / (double)steps, sum);
    free(rows);
    return 0;
}
