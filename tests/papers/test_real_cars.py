"""What is said of real recordings: statistics against closed forms, the report on recordings made
here, and planted faults.
"""

import math

import numpy as np
import pytest
from study_parts import study_of, tables_of, text_of

from real_drives import real_drive
from vehest.data.recording import Recording
from vehest.data.store import write_recording
from vehest.studies.artefacts import StoredDataset
from vehest_papers.real_cars.document import documents
from vehest_papers.real_cars.planted import detections, planted_faults
from vehest_papers.real_cars.statistics import statistics_of


def drive(seconds=120.0, size=1.0, noise=0.0, name="lap"):
    """At 20 m/s in a sinusoidal course.

    v = size·(static part + a part that no static map has) and white noise on its reference.
    """
    time = np.arange(round(100.0 * seconds)) / 100.0
    yaw_rate = 0.3 * np.sin(0.4 * time)
    vx = np.full_like(time, 20.0)
    vy = size * (-2.0 * yaw_rate + 0.2 * np.cos(0.4 * time))
    ay = np.gradient(vy) * 100.0 + vx * yaw_rate
    vy_ref = vy + noise * np.random.default_rng(0).standard_normal(len(time))
    channels = {
        "vx": vx,
        "yaw_rate": yaw_rate,
        "ay": ay,
        "ax": np.zeros_like(time),
        "vy_ref": vy_ref,
    }
    return Recording(
        name, "car", 100.0, 0.0, channels, provenance={"derived": {"reference_point": "unknown"}}
    )


def test_statistics_are_those_of_the_closed_form():
    """At constant speed a static map is one factor of the yaw rate, and the cosine that it leaves
    has 1/√2 of its amplitude.
    """
    statistics = statistics_of([drive()])
    level = math.degrees(0.2 / math.sqrt(2.0) / 20.0)
    assert statistics.static_map == pytest.approx(level, rel=0.02)
    assert statistics.rms == pytest.approx(
        math.degrees(math.sqrt(0.6**2 / 2.0 + 0.2**2 / 2.0) / 20.0), rel=0.02
    )
    assert statistics.speed == pytest.approx((20.0, 20.0))
    assert statistics.driven == pytest.approx(120.0, abs=0.1)
    assert statistics.point == "at a point that is not known"
    assert statistics.reasons == []


@pytest.mark.parametrize(
    ("recording", "reason_words"),
    [
        (drive(seconds=40.0), "40 s of driving"),
        (drive(size=0.2), "° (rms)"),
        (drive(noise=0.5), "noise of the reference"),
        (drive().select(["vx", "yaw_rate", "ay"]), "no reference of v"),
    ],
    ids=["short", "silent", "noisy", "unlabelled"],
)
def test_a_recording_that_cannot_rank_says_why(recording, reason_words):
    assert any(reason_words in reason for reason in statistics_of([recording]).reasons)


def test_report_names_the_data_sets_that_can_rank_and_why_the_others_cannot(tmp_path):
    datasets = []
    for name, recording in (("long", drive()), ("short", drive(seconds=40.0))):
        write_recording(recording, tmp_path / f"{name}.parquet")
        datasets.append(
            StoredDataset(
                name, name, "real", {}, {"lap": tmp_path / f"{name}.parquet"}, "none", "nobody"
            )
        )
    (report,) = documents(study_of("real_cars", datasets=datasets)).values()
    text = text_of(report)
    assert "1 of 2 data sets can rank estimators: `long` (real)." in text
    assert "`short` cannot: 40 s of driving." in text
    assert "injected" not in text, "errors are injected into the Ferrari's drive alone"
    assert set(tables_of(report)) == {"overview", "findings_by_check"}
    assert set(report.data) == {"recordings", "findings", "licences"}
    reasons = report.data["recordings"].set_index("dataset")["reasons"]
    assert dict(reasons) == {"long": "", "short": "40 s of driving"}


def test_report_of_the_ferrari_counts_the_injected_errors(tmp_path):
    """Three ranges of a made drive stand for those of the Ferrari."""
    file = tmp_path / "lap.parquet"
    write_recording(drive(seconds=710.0, name="lap"), file)
    dataset = StoredDataset("ferrari_250lm", "Ferrari", "real", {}, {"lap": file}, "none", "nobody")
    (report,) = documents(study_of("real_cars", datasets=[dataset])).values()
    cases = report.data["injected"]
    detectable = cases[cases["detectable"]]
    n_detected = detectable["detected"].sum()
    assert f"detect {n_detected} of {len(detectable)} errors" in text_of(report)
    table = tables_of(report)["injected_by_error"]
    assert table["cases"].sum() == len(cases)
    assert table["detected"].sum() == n_detected > 0


def noise():
    generator = np.random.default_rng(0)
    names = ("vx", "yaw_rate", "ax", "ay", "steer", "vy_ref", "sideslip_ref")
    return Recording(
        "r", "car", 100.0, 0.0, {name: generator.standard_normal(2000) for name in names}
    )


def fault(name, channel, size):
    (named_fault,) = [
        planted
        for planted in planted_faults()
        if (planted.name, planted.channels[0], planted.size) == (name, channel, size)
    ]
    return named_fault


def test_faults_change_only_their_channels_and_as_named():
    healthy = noise()
    for planted in planted_faults():
        changed = planted(healthy)
        assert {
            name for name in healthy.channels if not np.array_equal(healthy[name], changed[name])
        } == set(planted.channels)
    np.testing.assert_allclose(
        fault("late", "ay", "40 ms")(healthy)["ay"][4:], healthy["ay"][:-4], atol=1e-9
    )
    np.testing.assert_allclose(
        fault("held", "ay", "10 Hz")(healthy)["ay"], np.repeat(healthy["ay"][::10], 10)
    )
    slow = fault("low-passed", "ax", "0.4 s")(healthy)["ax"]
    state = healthy["ax"][0]
    for sample in range(1, 50):
        state += (1.0 - np.exp(-0.01 / 0.4)) * (healthy["ax"][sample] - state)
        assert slow[sample] == pytest.approx(state)
    assert set(detections(noise().select(["vx", "ay"]))["channel"]) == {"vx", "ay"}


@pytest.mark.parametrize(
    ("start", "stop", "missed"),
    [(150.0, 450.0, {20}), (450.0, 550.0, {20, 40}), (550.0, 700.0, {20})],
)
def test_all_faults_but_the_shortest_reference_delays_are_detected_in_the_ferrari(
    data_root, start, stop, missed
):
    """Its accelerometers are late by some 15 ms themselves, which a late reference makes good."""
    table = detections(real_drive(data_root).cut(start, stop))
    assert len(table) == len(planted_faults())
    lost = table[table["detectable"] & ~table["detected"]]
    assert set(lost["channel"]) == {"vy_ref and sideslip_ref"}
    assert set(lost["size"]) == {f"{size} ms" for size in missed}
    assert not table["false_alarms"].any()
    assert not table[~table["detectable"]]["detected"].any()
