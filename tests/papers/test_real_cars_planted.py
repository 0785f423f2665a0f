"""Planted faults: the table of detections and false alarms on the real Ferrari, and each fault by itself."""

import numpy as np
import pytest

from real_drives import real_drive
from vehest.data.recording import Recording
from vehest_papers.real_cars.planted import detections, planted_faults

LENGTH = 2000


def drive():
    generator = np.random.default_rng(0)
    names = ("vx", "yaw_rate", "ax", "ay", "steer", "vy_ref", "sideslip_ref")
    return Recording("r", "car", 100.0, 0.0, {name: generator.standard_normal(LENGTH) for name in names})


def fault(name, channel, size):
    (found,) = [one for one in planted_faults() if (one.name, one.channels[0], one.size) == (name, channel, size)]
    return found


def test_every_fault_changes_its_channels_and_no_other():
    whole = drive()
    for one in planted_faults():
        changed = one(whole)
        assert {name for name in whole.channels if not np.array_equal(whole[name], changed[name])} == set(one.channels)


def test_faults_are_what_they_are_called():
    whole = drive()
    np.testing.assert_allclose(fault("late", "ay", "40 ms")(whole)["ay"][4:], whole["ay"][:-4], atol=1e-9)
    np.testing.assert_allclose(fault("held", "ay", "10 Hz")(whole)["ay"], np.repeat(whole["ay"][::10], 10))
    slow = fault("low-passed", "ax", "0.4 s")(whole)["ax"]
    state = whole["ax"][0]
    for sample in range(1, 50):
        state += (1.0 - np.exp(-0.01 / 0.4)) * (whole["ax"][sample] - state)
        assert slow[sample] == pytest.approx(state)


def test_a_fault_without_its_channel_is_left_out():
    assert set(detections(drive().select(["vx", "ay"]))["channel"]) == {"vx", "ay"}


@pytest.mark.parametrize(("start", "stop", "missed"), [(150.0, 450.0, {20}), (450.0, 550.0, {20, 40}), (550.0, 700.0, {20})])
def test_all_but_the_shortest_delays_of_the_reference_are_found_in_the_ferrari_without_a_false_alarm(data_root, start, stop, missed):
    """Its accelerometers are late by some 15 ms themselves, which a late reference makes good."""
    table = detections(real_drive(data_root).cut(start, stop))
    assert len(table) == len(planted_faults())
    lost = table[table["decidable"] & ~table["found"]]
    assert set(lost["channel"]) == {"vy_ref and sideslip_ref"}
    assert set(lost["size"]) == {f"{size} ms" for size in missed}
    assert not table["false_alarms"].any()
    assert not table[~table["decidable"]]["found"].any()
