"""Noise levels read off signals: white noise, slow signals, gaps."""

import numpy as np
import pytest

from vehest.filters.noise_levels import high_passed_level


def test_level_of_white_noise_is_its_share_above_the_cutoff():
    """A fraction 1 - c of white noise's power lies above c times the Nyquist frequency; 2 % leaves room for the filter's slopes."""
    noise = 0.3 * np.random.default_rng(0).standard_normal(100_000)
    for cutoff in (0.1, 0.2):
        assert high_passed_level([noise], cutoff) == pytest.approx(0.3 * np.sqrt(1 - cutoff), rel=0.02)


def test_slow_signals_and_offsets_are_no_noise():
    """60 dB down below 0.75 times the cut-off."""
    time = np.arange(20_000) / 100.0
    noise = 0.01 * np.random.default_rng(1).standard_normal(len(time))
    slow = 5.0 + 3.0 * np.sin(2 * np.pi * 0.5 * time) + np.sin(2 * np.pi * 7.0 * time)
    assert high_passed_level([slow], 0.2) < 1e-3
    assert high_passed_level([slow + noise], 0.2) == pytest.approx(high_passed_level([noise], 0.2), rel=0.02)


def test_gaps_and_ends_do_not_count():
    noise = np.random.default_rng(2).standard_normal(2_000)
    offset = noise + 1e3
    offset[700] = np.nan
    without = high_passed_level([noise[:700], noise[701:]], 0.2)
    assert high_passed_level([offset], 0.2) == pytest.approx(without, rel=1e-6)


@pytest.mark.parametrize(("series", "cutoff", "what"), [(np.zeros(50), 0.2, "samples without a gap"), (np.zeros(500), 0.9, "cut-off must")])
def test_what_cannot_be_read_is_refused(series, cutoff, what):
    with pytest.raises(ValueError, match=what):
        high_passed_level([series], cutoff)
