"""Accelerations that a logger computed of speed and yaw rate are told from measured ones."""

import numpy as np
import pytest
import scipy

from conftest import planar_drive
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.computed import computed_in

RATE_HZ = 100.0


def smoothed(samples):
    """As a logger smooths: second order at 3 Hz, twice."""
    return scipy.signal.sosfiltfilt(scipy.signal.butter(2, 3.0, fs=RATE_HZ, output="sos"), samples)


@pytest.mark.parametrize("logged", [np.asarray, smoothed])
@pytest.mark.parametrize("has_reference", [True, False])
def test_computed_accelerations_are_named(logged, has_reference):
    drive = planar_drive(120.0, RATE_HZ, seed=3, noise=0.001)
    drive = drive if has_reference else drive.without_references()
    computed = {
        "ax": logged(np.gradient(drive["vx"]) * RATE_HZ),
        "ay": logged(drive["vx"] * drive["yaw_rate"]),
    }
    for channel, samples in computed.items():
        found = checks_of_recording(drive.with_channels({channel: samples}))
        assert [finding.channel for finding in found if finding.check == "computed"] == [channel]


def test_measured_accelerations_are_not_named():
    for seed in range(5):
        drive = planar_drive(120.0, RATE_HZ, seed=seed, noise=0.0)
        assert computed_in(drive) == {}
        assert computed_in(drive.without_references()) == {}


def test_a_drive_that_hardly_turns_does_not_tell():
    drive = planar_drive(120.0, RATE_HZ, seed=3, noise=0.0)
    ax = np.gradient(drive["vx"]) * RATE_HZ
    straight = drive.with_channels({"ax": ax, "yaw_rate": 0.02 * drive["yaw_rate"]})
    assert computed_in(straight) == {}
