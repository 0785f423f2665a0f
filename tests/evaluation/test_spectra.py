"""Periodograms against signals whose spectra are known, and the process noise against what was
planted.
"""

import numpy as np
import pytest
from refusals import refusal

from conftest import planar_drive
from vehest_papers.kit.spectra import (
    decibels,
    lateral_velocity_rate,
    mean_bias,
    periodogram,
    process_noise,
)

RATE = 20.0


def test_density_of_white_noise_is_its_variance_over_the_band():
    """σ² spread evenly over 0 to 10 Hz.

    The mean of 255 lines over n segments scatters by about 1/sqrt(255 n).
    """
    noise = 0.3 * np.random.default_rng(0).standard_normal(40_000)
    density = periodogram([noise], RATE)
    assert density.density[1:-1].mean() == pytest.approx(
        0.3**2 / (RATE / 2), rel=4 / np.sqrt(255 * density.n_segments)
    )
    # Parseval: for noise of any colour, up to what the segments' ends weigh.
    noise = np.random.default_rng(1).standard_normal(80_000)
    coloured = np.convolve(noise, np.ones(6) / 6, mode="valid")
    assert periodogram([coloured], RATE).power == pytest.approx(coloured.var(), rel=0.03)


def test_sinusoids_stand_in_their_bin_and_recordings_count_by_segments():
    hz = 30 / 25.6
    density = periodogram([1.5 * np.sin(2 * np.pi * hz * np.arange(4096) / RATE)], RATE)
    assert density.frequency[np.argmax(density.density)] == pytest.approx(hz)
    assert density.power == pytest.approx(1.5**2 / 2, rel=1e-6)
    assert (
        density.density[np.abs(density.frequency - hz) > 2.5 / 25.6].max()
        < 1e-6 * density.density.max()
    )
    generator = np.random.default_rng(2)
    long = generator.standard_normal(512 * 4)
    short = 3.0 * generator.standard_normal(512)
    separate = [periodogram([samples], RATE) for samples in (long, short)]
    together = periodogram([long, short], RATE)
    assert [density.n_segments for density in (*separate, together)] == [7, 1, 8]
    np.testing.assert_allclose(
        together.density, (7 * separate[0].density + separate[1].density) / 8, rtol=1e-12
    )


def test_planted_biases_and_noise_are_the_process_noise_of_the_documented_rate(drive):
    hz = 1.0
    time = drive.time
    waving = drive.with_channels({"vy_ref": np.sin(2 * np.pi * hz * time)})
    shrunk = np.sin(2 * np.pi * hz / RATE) / (2 * np.pi * hz / RATE)
    np.testing.assert_allclose(
        lateral_velocity_rate(waving),
        shrunk * 2 * np.pi * hz * np.cos(2 * np.pi * hz * time[1:-1]),
        atol=1e-9,
    )
    assert shrunk == pytest.approx(0.98, abs=0.005)
    # The central difference of a drive that obeys the kinematics errs by a sixth of the third
    # derivative, 3e-4 m/s² here.
    drive = planar_drive()
    assert np.abs(process_noise(drive)).max() < 1e-3
    tilted = drive.with_channels({"ay": drive["ay"] - 0.1})
    assert mean_bias([tilted]) == pytest.approx(0.1, abs=2e-4)
    assert mean_bias([tilted, drive]) == pytest.approx(0.05, abs=2e-4)
    drive = planar_drive(seconds=600.0)
    noise = 0.4 * np.random.default_rng(3).standard_normal(len(drive))
    noisy = drive.with_channels({"ay": drive["ay"] + noise})
    density = periodogram([process_noise(noisy)], RATE)
    assert density.level(1.0) == pytest.approx(
        0.4**2 / 10.0, rel=4 / np.sqrt(6 * density.n_segments)
    )


def test_level_is_the_mean_of_a_third_of_an_octave():
    spectrum = periodogram([np.random.default_rng(4).standard_normal(2048)], RATE)
    inside = [
        density
        for hz, density in zip(spectrum.frequency, spectrum.density, strict=True)
        if 0.8909 <= hz <= 1.1225
    ]
    assert spectrum.level(1.0) == pytest.approx(np.mean(inside))
    assert decibels(10.0 * spectrum.level(1.0), spectrum.level(1.0)) == pytest.approx(10.0)
    assert "has no line at 15 Hz" in refusal(lambda: spectrum.level(15.0))
    assert "series 1 lasts 25.0 s" in refusal(
        lambda: periodogram([np.zeros(600), np.zeros(500)], RATE)
    )
    assert "series 0 has gaps" in refusal(lambda: periodogram([np.full(600, np.nan)], RATE))
    assert "at least one" in refusal(lambda: periodogram([], RATE))
