"""Delay of a detection, missed ones, and the error before the first flag."""

import math

import numpy as np
import pytest

from vehest.evaluation.integrity import detection_delay, error_while_undetected, missed_detections


def flags(length, *spans):
    found = np.zeros(length, bool)
    for begin, end in spans:
        found[begin:end] = True
    return found


def test_delay_counts_from_the_first_faulty_sample_to_the_end_of_the_flagged_one():
    assert detection_delay(flags(100, (5, 8), (30, 40)), 20, 100, 10.0) == pytest.approx(1.1)
    assert detection_delay(flags(100, (5, 8)), 20, 100, 10.0) == math.inf
    assert missed_detections([0.2, 1.1, math.inf, 0.4], [0.5, 1.0, 5.0, 0.5]) == 0.5


def test_error_counts_until_the_first_flag():
    error = np.array([9.0, 9.0, 3.0, -4.0, 9.0, 9.0])
    assert error_while_undetected(error, flags(6, (4, 6)), 2, 6) == (pytest.approx(math.sqrt(12.5)), 4.0)
    assert error_while_undetected(error, flags(6, (2, 6)), 2, 6) == (0.0, 0.0)
