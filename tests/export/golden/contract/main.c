/* main.c: run the exported model on a drive from a file. It is a tool for a desk, with files and printf; the model itself is in vehest_*.
 *
 *     main IN.csv OUT.csv [EXPECTED.csv]
 *
 * IN: a header with names of channels (vx, yaw_rate, ay) and, if it is there, time [s]; a row a sample in SI units, at
 * VEHEST_INPUT_RATE_HZ unless time says which are missing. An empty field or nan was not measured. OUT: a row a row of IN. With EXPECTED,
 * a file like OUT, the largest differences of rows with the same health are printed, and the exit code is 1 where one is beyond TOLERANCE
 * or the health of more than one row in a hundred is another.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "vehest_estimator.h"

#define LONGEST_LINE 4096
#define MOST_FIELDS 256
#define NO_CHANNEL (-1)
#define TIME (-2)
#define NUMBERS 4 /* of a row of OUT, before health and reason */
#define TOLERANCE 0.001

static const char *const NAMES[VEHEST_CHANNELS] = { "vx", "yaw_rate", "ay" };
static const char *const HEADER = "vy,sideslip,band_vy,band_sideslip,health,reason";

/* Where a line's fields begin; each is ended in place. Returns how many there are. */
static int split(char *line, char *fields[MOST_FIELDS])
{
    int n = 0;
    char *at = line;
    line[strcspn(line, "\r\n")] = '\0';
    while ((at != NULL) && (n < MOST_FIELDS)) {
        fields[n] = at;
        n++;
        at = strchr(at, ',');
        if (at != NULL) {
            *at = '\0';
            at++;
        }
    }
    return n;
}

/* A field's number; NaN where there is none. */
static double number(const char *field)
{
    char *end = NULL;
    const double value = strtod(field, &end);
    return (end == field) ? (double)NAN : value;
}

/* What each column of a header holds; returns how many channels of the model are there. */
static int read_header(char *line, int columns[MOST_FIELDS], int *n_columns)
{
    char *fields[MOST_FIELDS];
    int found = 0;
    *n_columns = split(line, fields);
    for (int f = 0; f < *n_columns; f++) {
        columns[f] = (strcmp(fields[f], "time") == 0) ? TIME : NO_CHANNEL;
        for (int c = 0; c < VEHEST_CHANNELS; c++) {
            if (strcmp(fields[f], NAMES[c]) == 0) {
                columns[f] = c;
                found++;
            }
        }
    }
    return found;
}

static void put(vehest_sample *sample, int channel, double value)
{
    switch (channel) {
    case VEHEST_VX:
        sample->vx = (vehest_real)value;
        break;
    case VEHEST_YAW_RATE:
        sample->yaw_rate = (vehest_real)value;
        break;
    case VEHEST_AY:
        sample->ay = (vehest_real)value;
        break;
    default:
        break;
    }
}

/* Largest difference of a row from what was expected, in each number; returns whether its health is the same. */
static bool compare(char *line, const double own[NUMBERS], const vehest_estimate *estimate, double largest[NUMBERS])
{
    char *fields[MOST_FIELDS];
    const int n = split(line, fields);
    const bool same = (n == (NUMBERS + 2)) && ((int)number(fields[NUMBERS]) == (int)estimate->health);
    for (int i = 0; same && (i < NUMBERS); i++) {
        const double wanted = number(fields[i]);
        const double difference = fabs(own[i] - wanted);
        if ((own[i] == own[i]) != (wanted == wanted)) {
            largest[i] = (double)INFINITY;
        } else if (difference > largest[i]) {
            largest[i] = difference;
        } else {
            /* no more than before */
        }
    }
    return same;
}

static int complain(const char *what, const char *name)
{
    (void)fprintf(stderr, "error: %s '%s'\n", what, name);
    return 2;
}

/* From an open file to another, beside a third that may be NULL; returns the exit code. */
static int replay(FILE *in, FILE *out, FILE *expected, const char *name)
{
    static vehest_state state;
    static char line[LONGEST_LINE];
    static char wanted[LONGEST_LINE];
    vehest_estimate estimate;
    int columns[MOST_FIELDS];
    int n_columns = 0;
    double largest[NUMBERS] = { 0.0, 0.0, 0.0, 0.0 };
    long rows = 0;
    long others = 0;
    bool bad = false;
    if ((fgets(line, LONGEST_LINE, in) == NULL) || (read_header(line, columns, &n_columns) < VEHEST_CHANNELS)) {
        return complain("not all channels of the model are in", name);
    }
    if ((expected != NULL) && (fgets(wanted, LONGEST_LINE, expected) == NULL)) {
        return complain("nothing is expected of", name);
    }
    (void)fprintf(out, "%s\n", HEADER);
    vehest_start(&state);
    while (fgets(line, LONGEST_LINE, in) != NULL) {
        char *fields[MOST_FIELDS];
        const int n = split(line, fields);
        vehest_sample sample;
        double time = (double)NAN;
        for (int c = 0; c < VEHEST_CHANNELS; c++) {
            put(&sample, c, (double)NAN);
        }
        for (int f = 0; (f < n) && (f < n_columns); f++) {
            if (columns[f] == TIME) {
                time = number(fields[f]);
            } else {
                put(&sample, columns[f], number(fields[f]));
            }
        }
        if (time == time) {
            (void)vehest_step_at(&state, time, &sample, &estimate);
        } else {
            (void)vehest_step(&state, &sample, &estimate);
        }
        {
            const double own[NUMBERS]
                = { (double)estimate.vy, (double)estimate.sideslip, (double)estimate.band_vy, (double)estimate.band_sideslip };
            (void)fprintf(out, "%.17g,%.17g,%.17g,%.17g,%d,%ld\n", own[0], own[1], own[2], own[3], (int)estimate.health, (long)estimate.reason);
            if ((expected != NULL) && (fgets(wanted, LONGEST_LINE, expected) != NULL)) {
                others += compare(wanted, own, &estimate, largest) ? 0 : 1;
            }
        }
        rows++;
    }
    (void)printf("rows: %ld\nbytes of state: %lu\n", rows, (unsigned long)sizeof(vehest_state));
    if (expected != NULL) {
        (void)printf("largest difference: vy %.3g m/s, sideslip %.3g rad, band_vy %.3g m/s, band_sideslip %.3g rad\n", largest[0], largest[1], largest[2], largest[3]);
        (void)printf("rows of another health: %ld\n", others);
        bad = (others > (rows / 100));
        for (int i = 0; i < NUMBERS; i++) {
            bad = bad || !(largest[i] <= TOLERANCE);
        }
    }
    return bad ? 1 : 0;
}

int main(int argc, char **argv)
{
    FILE *in;
    FILE *out;
    FILE *expected = NULL;
    int code;
    if ((argc < 3) || (argc > 4)) {
        (void)fprintf(stderr, "usage: main IN.csv OUT.csv [EXPECTED.csv]\n");
        return 2;
    }
    in = fopen(argv[1], "r");
    if (in == NULL) {
        return complain("cannot read", argv[1]);
    }
    out = fopen(argv[2], "w");
    if (out == NULL) {
        (void)fclose(in);
        return complain("cannot write", argv[2]);
    }
    if (argc == 4) {
        expected = fopen(argv[3], "r");
    }
    code = ((argc == 4) && (expected == NULL)) ? complain("cannot read", argv[3]) : replay(in, out, expected, argv[1]);
    (void)fclose(in);
    if (fclose(out) != 0) {
        code = complain("cannot write", argv[2]);
    }
    if (expected != NULL) {
        (void)fclose(expected);
    }
    return code;
}
