"""Real recordings are read as recorded: every sample to 12 digits, on another machine each
channel's root mean square to 1e-9.
"""

import json

import pytest
from golden_numbers import FIXED, this_machine
from golden_readings import FILE, READINGS, read

RECORDED = json.loads(FILE.read_text(encoding="utf-8"))


def test_every_reading_is_recorded():
    assert set(RECORDED["readings"]) == set(READINGS), "run `make golden`"


@pytest.mark.parametrize("name", READINGS)
def test_real_recordings_are_read_as_recorded(data_root, name):
    recorded = RECORDED["readings"][name]
    now = read(name, str(data_root))
    assert list(now) == list(recorded)
    for recording, expected in recorded.items():
        if RECORDED["machine"] == this_machine():
            is_unchanged = now[recording] == expected
        else:
            is_unchanged = _numbers(now[recording]) == pytest.approx(
                _numbers(expected), rel=FIXED, abs=FIXED
            )
        assert is_unchanged, (
            f"{recording} moved: raise the version of its source if that is meant, "
            "then run `make golden`"
        )


def _numbers(reading):
    """All but the digests and, beside its velocities, the reference's angle: where the car stands,
    digits of rounding decide whether it is 0 or 180°.
    """
    channels = reading["channels"]
    sizes = {channel: size for channel, (_, size) in channels.items()}
    if {"vx_ref", "vy_ref"} <= channels.keys():
        sizes.pop("sideslip_ref", None)
    return {"rate_hz": reading["rate_hz"], "start_time": reading["start_time"]} | sizes
