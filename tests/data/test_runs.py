"""Runs of samples, against a count sample by sample."""

from itertools import groupby

import numpy as np
import pytest

from vehest.data.runs import equal_runs, true_runs


@pytest.mark.parametrize("length", [0, 1, 2, 50])
@pytest.mark.parametrize("seed", range(3))
def test_runs_are_those_of_a_count_sample_by_sample(length, seed):
    samples = np.random.default_rng(seed).integers(0, 2, length)
    counted, place = [], 0
    for value, group in groupby(samples.tolist()):
        begin, place = place, place + len(list(group))
        counted.append((value, [begin, place]))
    assert equal_runs(samples).tolist() == [run for _, run in counted]
    assert true_runs(samples == 1).tolist() == [run for value, run in counted if value == 1]
