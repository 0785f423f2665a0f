"""Clock faults: time stamps of a drive that are wrong from one sample on."""

import math

import numpy as np

FAULTS = ("constant", "runs_backwards", "back_far", "ahead_1_s", "ahead_1_h", "nan", "inf")
"""Faults of which the first 0.2 s have to show."""

RATE_FAULTS = (
    "back_one_sample_and_slow",
    "half_rate",
    "double_rate",
    "tenth_of_the_speed",
)
"""Faults of the intervals between stamps."""

HARMLESS = ("repeated_once", "back_once", "jitter", "nan_once", "each_twice")


def faulted_times(kind, times, first, rate):
    """Time stamps (T,) [s] with a fault from sample ``first`` on, at a sampling rate [Hz]."""
    wrong = times.copy()
    since = np.arange(len(times) - first) / rate
    match kind:
        case "constant":
            wrong[first:] = times[first - 1]
        case "runs_backwards":
            wrong[first:] = times[first - 1] - since - 1.0 / rate
        case "back_one_sample_and_slow":
            wrong[first:] = times[first - 1] - 1.0 / rate + 0.4 * since
        case "back_far":
            wrong[first:] -= 1000.0
        case "ahead_1_s":
            wrong[first:] += 1.0
        case "ahead_1_h":
            wrong[first:] += 3600.0
        case "nan":
            wrong[first:] = math.nan
        case "inf":
            wrong[first:] = math.inf
        case "half_rate":
            wrong[first:] = times[first - 1] + 2.0 * (since + 1.0 / rate)
        case "double_rate":
            wrong[first:] = times[first - 1] + 0.5 * (since + 1.0 / rate)
        case "tenth_of_the_speed":
            wrong[first:] = times[first - 1] + 0.1 * (since + 1.0 / rate)
        case "repeated_once":
            wrong[first] = times[first - 1]
        case "back_once":
            wrong[first] = times[first - 2]
        case "nan_once":
            wrong[first] = math.nan
        case "each_twice":
            wrong[first:] = times[first:][np.arange(len(since)) // 2]
        case "jitter":
            wrong += np.random.default_rng(0).uniform(-0.19, 0.19, len(times)) / rate
        case _:
            raise ValueError(kind)
    return wrong
