"""A log on a virtual bus with a model behind it: estimates as without a bus, what is lost is
missing, what was written stays.
"""

import io
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refusal

import vehest
from conftest import planar_drive
from vehest.bus.mapping import from_dataset, from_names
from vehest.bus.view import Figures, View
from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.run.replay import replay_log

can = pytest.importorskip("can", reason="python-can is not installed: pip install 'vehest[bus]'")
cantools = pytest.importorskip(
    "cantools", reason="cantools is not installed: pip install 'vehest[bus]'"
)

from can_drive import DBC, SIGNALS, ferrari, write_log  # noqa: E402
from replayed_drive import compare, signals_for  # noqa: E402

CHANNELS = ("yaw_rate", "vx", "ay", "ax")  # of the pre-trained model
RATE = 100.0


def drive(seconds=6.0):
    return planar_drive(seconds, RATE, seed=3)


def replayed(written, **more):
    words = {"dbc": written.dbc, "signals": signals_for(CHANNELS), "speed": "max", **more}
    return replay_log(written.log, **words)


def by_cantools(written):
    """Values of the frames in SI units and ISO 8855 signs, without vehest."""
    database = cantools.database.load_string(DBC, "dbc")
    decoded = {name: [] for name in CHANNELS}
    for frame in can.LogReader(written.log):
        values = database.decode_message(frame.arbitration_id, frame.data)
        if "VehSpd" in values:
            decoded["vx"].append(values["VehSpd"] / 3.6)
        if "AccLat" in values:
            decoded["ay"].append(-values["AccLat"])
            decoded["ax"].append(values["AccLong"])
            decoded["yaw_rate"].append(math.radians(values["YawRate"]))
    return decoded


def test_replayed_estimates_equal_the_stepped_model_less_the_filters_delay(
    tmp_path,
):
    written = write_log(drive(), tmp_path, jitter=0.001)
    figures = replayed(written, out=tmp_path / "out.csv")
    table = pd.read_csv(tmp_path / "out.csv")
    values = by_cantools(written)
    stepper = vehest.online(
        vehest.load_model("pretrained"), RATE, elsewhere=True
    ).stepper  # a bus names no car
    expected = []
    last = stepper.last
    for k in range(len(values["vx"])):
        step = stepper.step({name: values[name][k] for name in CHANNELS})
        if step is not last:
            expected.append((step["vy"], step["sideslip"], step["health"]))
            last = step
    assert figures["samples_lost"] == 0
    assert figures["estimates"] == len(table) == len(expected)
    np.testing.assert_allclose(
        table[["vy", "sideslip", "health"]], np.array(expected), rtol=5e-6, atol=1e-9
    )  # half a unit of the six digits that a CSV file has
    replayed(write_log(drive(), tmp_path), out=tmp_path / "out.csv")
    table = pd.read_csv(tmp_path / "out.csv")
    ahead = stepper.horizon_steps / 20.0 - stepper.delay
    # frames come at whole cycles, 0 and 0.4 ms behind them; samples in the middle of the rest
    np.testing.assert_allclose(table["sampled"] % 0.01, 0.0052, atol=2e-5)
    assert np.abs(table["time"] - (table["sampled"] + ahead - 0.0050)).max() < 3e-4


def test_lost_frames_are_missing_samples(tmp_path):
    written = write_log(drive(), tmp_path, jitter=0.001, lost=0.02)
    figures = replayed(written)
    lost = written.lost
    assert figures["missing"] == {
        "vx": len(lost["Speed"]),
        **dict.fromkeys(("yaw_rate", "ay", "ax"), len(lost["IMU"])),
    }
    assert figures["samples_lost"] == len({*lost["IMU"], *lost["Speed"]})


def test_frames_of_estimates_agree_with_the_table(tmp_path):
    written = write_log(drive(), tmp_path, ".blf")
    replayed(written, out=tmp_path / "out.csv")
    figures = replayed(written, out=tmp_path / "sent.asc", identifier="0x321")
    assert figures["written"] == [str(tmp_path / "sent.asc"), str(tmp_path / "sent.dbc")]
    table = pd.read_csv(tmp_path / "out.csv")
    database = cantools.database.load_file(tmp_path / "sent.dbc")
    frames = [
        (frame, database.decode_message(frame.arbitration_id, frame.data))
        for frame in can.LogReader(tmp_path / "sent.asc")
    ]
    sent = [values for frame, values in frames if frame.arbitration_id == 0x321]
    assert len(sent) == len(table) == len(frames) / 2
    assert [values["AliveCounter"] for values in sent] == [k % 16 for k in range(len(sent))]
    available = [
        k for k, values in enumerate(sent) if str(values["LateralVelocity"]) != "not available"
    ]
    assert available == np.flatnonzero(table["vy"].notna()).tolist()
    np.testing.assert_allclose(
        [sent[k]["LateralVelocity"] for k in available], table["vy"].iloc[available], atol=0.0003
    )
    np.testing.assert_allclose(
        [sent[k]["SideslipAngle"] for k in available],
        np.degrees(table["sideslip"].iloc[available]),
        atol=0.0003,
    )


def test_in_real_time_every_frame_is_sent_and_estimates_come_back(tmp_path):
    written = write_log(drive(3.0), tmp_path)
    figures = replayed(written, speed="4", out=tmp_path / "out.csv")
    assert figures["frames_sent"] == figures["frames_received"] == 600
    assert figures["samples"] == pytest.approx(300, abs=3)
    assert (
        len(pd.read_csv(tmp_path / "out.csv")) == figures["estimates"] == pytest.approx(60, abs=1)
    )


@pytest.mark.parametrize("speed", ["max", "1"])
def test_estimates_written_before_a_stop_remain(tmp_path, speed):
    calls = iter(range(10_000))
    figures = replayed(
        write_log(drive(), tmp_path),
        stopped=lambda: next(calls) > 300,
        speed=speed,
        out=tmp_path / "out.csv",
    )
    assert figures["stopped"]
    assert 0 < figures["samples"] < 600
    assert len(pd.read_csv(tmp_path / "out.csv")) == figures["estimates"]


def test_signals_named_like_channels_need_no_map_and_a_data_set_equals_words(
    tmp_path,
):
    text = 'VERSION ""\n\nBO_ 5 A: 8 X\n'
    text += ' SG_ vx : 0|16@1+ (0.01,0) [0|0] "m/s" X\n SG_ ay : 16|16@1- (0.01,0) [0|0] "g" X\n'
    (tmp_path / "own.dbc").write_text(text)
    assert from_names(tmp_path / "own.dbc", ["vx", "ay"]).factors == {
        "vx": 1.0,
        "ay": pytest.approx(9.80665),
    }
    with pytest.raises(ConfigurationError, match="the model reads channel 'ax'"):
        from_names(tmp_path / "own.dbc", ["vx", "ay", "ax"])
    assert set(
        from_names(tmp_path / "own.dbc", ["vx", "ay", "ax"], optional=["ax"]).by_channel
    ) == {
        "vx",
        "ay",
    }
    written = write_log(drive(1.0), tmp_path)
    dataset = {
        "name": "mine",
        "source": "can",
        "dbc": str(written.dbc),
        "path": str(tmp_path),
        "rate_hz": 100,
        "channels": SIGNALS,
    }
    maps = (
        from_dataset(dataset, CHANNELS),
        from_names(written.dbc, CHANNELS, words=signals_for(CHANNELS).split(",")),
    )
    declared, named = (
        (
            signal_map.factors,
            {
                name: (mapped_signal.message.name, mapped_signal.signal)
                for name, mapped_signal in signal_map.by_channel.items()
            },
        )
        for signal_map in maps
    )
    assert declared == named


@pytest.fixture(scope="module")
def short_log(tmp_path_factory):
    """A log of two seconds that tests leave as it is."""
    return write_log(drive(2.0), tmp_path_factory.mktemp("log"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"signals": "ay"}, "takes CHANNEL=MESSAGE.SIGNAL"),
        ({"signals": "steer=SteerAng"}, "'steer', which the model does not read"),
        ({"signals": "vx=VehSpd"}, "reads channel 'yaw_rate', and no signal"),
        (
            {"signals": signals_for(CHANNELS).replace("VehSpd:km/h", "VehSpd:parsec")},
            "'parsec' of signal 'Speed.VehSpd' is no unit",
        ),
        (
            {"signals": signals_for(CHANNELS).replace("VehSpd:km/h", "VehSpd:m/s")},
            "is in 'km/h' by the file and in 'm/s'",
        ),
        (
            {"signals": signals_for(CHANNELS).replace("Speed.VehSpd", "Counter")},
            "stands in several messages",
        ),
        ({"dbc": None}, "nothing describes the bus"),
        ({"dataset": "tabular", "signals": ""}, "is of source 'tabular'"),
        ({"dataset": "can"}, "both name the channels"),
        ({"speed": "-1"}, "--speed must be"),
        ({"speed": "max", "interface": "socketcan"}, "needs the virtual bus"),
        (
            {"speed": "1", "interface": "nonsense"},
            "cannot open channel 'vehest' of interface 'nonsense'",
        ),
        ({"identifier": "0x120"}, "has a message 0x120, as estimates would"),
        ({"bus_rate": 10.0}, "too slow for an estimator that works at 20 Hz"),
        ({"out": Path("out.parquet")}, "must end in .csv or .asc"),
        ({"out": Path("/nowhere/at/all.csv")}, "cannot write"),
        ({"model": "nothing"}, "there is no model 'nothing'"),
    ],
)
def test_senseless_options_are_refused_in_a_line(short_log, words, message):
    with pytest.raises(VehestError, match=message) as caught:
        replayed(short_log, **words)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, ConfigurationError | DataError | MissingError)


def test_an_output_that_links_to_itself_is_refused(tmp_path, short_log):
    out = tmp_path / "out.csv"
    out.symlink_to(out)
    with pytest.raises(DataError, match="links lead to each other"):
        replayed(short_log, out=out)


def test_a_damaged_log_ends_a_replay_in_a_line_and_is_never_overwritten(
    tmp_path,
):
    written = write_log(drive(2.0), tmp_path)
    before = written.log.read_bytes()
    with pytest.raises(ConfigurationError, match="is an input"):
        replayed(written, out=written.log)
    assert written.log.read_bytes() == before
    lines = written.log.read_text().splitlines()
    damaged = [*lines[:300], lines[300].replace("Rx   d 8", "Rx   d zz"), ""]
    written.log.write_text("\n".join(damaged))
    for speed in ("max", "10"):
        with pytest.raises(DataError, match=r"is damaged .*zz"):
            replayed(written, speed=speed)


FIGURES = Figures(
    frames_sent=30, frames_received=20, samples=10, samples_lost=1, estimates=2, latest_ms=1.2
)


def test_the_view_shows_estimate_band_health_and_reason_in_a_line_every_ten_seconds():
    stream = io.StringIO()
    values = {
        "vy": 0.5,
        "sideslip": math.radians(-1.25),
        "band_vy": 0.1,
        "band_sideslip": math.radians(0.5),
    }
    for view, estimate in (
        (View(stream), {**values, "health": 2.0, "health_reason": 3e5}),
        (View(stream), {}),
        (View(None), {}),
    ):
        view.show(FIGURES, estimate, 10.1)
        view.show(FIGURES, estimate, 10.2)
    first, second = stream.getvalue().splitlines()
    assert first.startswith(
        "time 10.1 s, v +0.500 ± 0.100 m/s, β -1.25 ± 0.50 °, "
        "health invalid: there is no estimate, 2 estimates, "
    )
    assert second.startswith("time 10.1 s, v -, β -, health -, ")


def test_a_replay_of_the_real_ferrari_errs_as_the_model_does_offline(data_root, tmp_path):
    assert data_root.is_dir()
    comparison = compare("pretrained", ferrari(550.0, 590.0), tmp_path)
    assert comparison.lost > 50  # of 4,000 samples and two messages, 1 % each
    assert max(comparison.ratios) < 1.05


def test_a_stray_stamp_in_a_log_is_refused_before_anything_is_written(tmp_path):
    written = write_log(drive(), tmp_path, ".log")
    lines = written.log.read_text().splitlines(keepends=True)
    at = len(lines) * 3 // 4
    lines[at] = "(10000000000.000000)" + lines[at].partition(")")[2]
    written.log.write_text("".join(lines))
    message = refusal(lambda: replayed(written, out=tmp_path / "out.csv"))
    assert f"'{written.log}' would give 830000000000 samples" in message
    assert "limits.samples=NUMBER" in message
    assert not (tmp_path / "out.csv").exists()
