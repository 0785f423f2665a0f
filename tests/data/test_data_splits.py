"""Splits, windows, runs and minutes: no sample serves two purposes, no window crosses recordings,
and splits of papers are theirs.
"""

import math
import re
from functools import cache
from itertools import combinations, groupby, pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal as one_line

from vehest.configuration.composition import compose_config
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.laps import laps_of
from vehest.data.recording import Recording
from vehest.data.runs import equal_runs, true_runs
from vehest.data.split_files import dataset_names, limit_minutes, split_from_config
from vehest.data.splits import Span, Split, check_name
from vehest.data.windows import windows_of
from vehest.sources.base import open_source

PROPERTY = settings(max_examples=80, deadline=None, derandomize=True, database=None)
CONFIGURATIONS = sorted((Path(__file__).parents[2] / "conf" / "split").glob("*.yaml"))

bounds = st.sampled_from([-math.inf, math.inf, 0.0, 1.0, 1.005, 1.01, 2.0, 3.5]) | st.floats(
    0.0, 4.0
)


@st.composite
def spans(draw):
    start, stop = sorted(draw(st.lists(bounds, min_size=2, max_size=2, unique=True)))
    return Span("set", draw(st.sampled_from(["lap1", "lap2"])), start, stop)


HEAD = {"name": "s", "dataset": "d"}
BASE = HEAD | {
    "train": [{"recording": "a"}],
    "validation": [{"recording": "b"}],
    "tests": {},
}


def refusal(config, catalogue=None):
    """The one line with which a split is refused."""
    message = one_line(lambda: split_from_config(config, catalogue), ConfigurationError)
    assert "split 's'" in message
    return message


def samples_of(span, rate_hz):
    """Which samples of a recording of four seconds a stretch takes."""
    recording = Recording(span.recording, "car", rate_hz, 0.0, {"ay": np.arange(4 * rate_hz)})
    first, end = recording.index_range(span.start, span.stop)
    return {(span.recording, index) for index in range(first, end)}


@st.composite
def roles(draw):
    """Stretches for three purposes, of one recording: neighbours, or anything."""
    if draw(st.booleans()):
        times = sorted(draw(st.lists(bounds, min_size=4, max_size=7, unique=True)))
        neighbours = [Span("set", "lap1", start, stop) for start, stop in pairwise(times)]
        return [tuple(neighbours[role::3]) for role in range(3)]
    return [tuple(draw(st.lists(spans(), min_size=1, max_size=2))) for _ in range(3)]


@PROPERTY
@given(roles(), st.sampled_from([20.0, 100.0, 125.0]))
def test_train_validation_and_tests_never_share_samples(parts, rate_hz):
    train, validation, test = parts
    samples_by_role = [set().union(*(samples_of(span, rate_hz) for span in role)) for role in parts]
    shared = bool(
        samples_by_role[0] & samples_by_role[1]
        or samples_by_role[0] & samples_by_role[2]
        or samples_by_role[1] & samples_by_role[2]
    )
    has_no_overlap = not any(
        a.overlaps(b)
        for first_role, second_role in combinations(parts, 2)
        for a in first_role
        for b in second_role
    )
    assert not (has_no_overlap and shared)
    if has_no_overlap:
        Split("drive", train, validation, {"test": test})
    else:
        with pytest.raises(ConfigurationError, match="share samples of recording"):
            Split("drive", train, validation, {"test": test})


def test_equal_ranges_elsewhere_and_test_sets_that_overlap_share_nothing():
    Split("s", (Span("d", "r1"),), (Span("d", "r2"),), {"test": (Span("e", "r1"),)})
    Split(
        "s",
        (Span("d", "r", 0, 1),),
        (Span("d", "r", 1, 2),),
        {"all": (Span("d", "r", 2, 4),), "fast": (Span("d", "r", 3, 4),)},
    )
    with pytest.raises(
        ConfigurationError,
        match=r"train and test 'wet' share samples of recording 'r' \(r \[0, 10\) s and r \[5, "
        r"6\) s\)",
    ):
        Split("s", (Span("d", "r", 0, 10),), (Span("d", "v"),), {"wet": (Span("d", "r", 5, 6),)})


def test_plain_values_make_a_split_with_tests_alone():
    for start, stop in ((2.0, 1.0), (1.0, 1.0), (math.nan, 1.0), (0.0, math.nan)):
        with pytest.raises(ConfigurationError, match="is not before stop"):
            Span("d", "r", start, stop)
    entry = {"recording": "lap", "start": 1, "stop": 2}
    tests = {"t": [{"recording": "x"}]}
    split = split_from_config(
        BASE
        | {"train": [entry], "validation": [{"recording": "v", "dataset": "e"}], "tests": tests}
    )
    assert split.train == (Span("d", "lap", 1.0, 2.0),)
    assert split.validation == (Span("e", "v", -math.inf, math.inf),)
    assert split.tests == {"t": (Span("d", "x"),)}
    assert split.datasets == ("d", "e")
    config = BASE | {"train": [], "validation": [], "tests": tests}
    split = split_from_config(config)
    assert (split.train, split.validation, split.datasets) == ((), (), ("d",))
    with pytest.raises(ConfigurationError, match="split 's' has no ranges at all"):
        split_from_config(config | {"tests": {}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train": []}, "nothing to train on"),
        ({"validation": []}, "nothing to validate on"),
        ({"train": [{"start": 3}]}, "needs a recording"),
        (
            {"train": [{"recording": "a", "start": "three"}]},
            "are a number of seconds or a percentage such as \"60 %\", not 'three'",
        ),
        (
            {"train": "a"},
            'train must be a list of ranges, a percentage such as "60 %" or laps such as "last '
            'lap"',
        ),
        ({"dataset": None}, "each range needs a dataset"),
    ],
)
def test_misspelt_splits_are_refused_in_a_single_line(changes, message):
    assert message in refusal(BASE | changes)


@cache
def simulated_names(dataset):
    """Names of the recordings of a simulated data set; none of any other."""
    about = compose_config("ingest", [f"dataset={dataset}"])["dataset"]
    return tuple(open_source(about).ids()) if about["source"] == "simulated" else ()


@pytest.mark.parametrize("file", CONFIGURATIONS, ids=lambda file: file.stem)
def test_shipped_splits_are_valid(file):
    """Patterns name recordings that the data sets have: those of simulated ones are known, any
    other has what the split names.
    """

    def cruising(dataset):
        names = simulated_names(dataset) or [
            "some",
            *re.findall(r"recording: ([^,}\s]+)", text),
        ]
        speed = np.full(20_000, 20.0)
        lap = 2.0 * np.pi * np.arange(20_000) / 2000.0  # a lap of 100 s
        long = {
            "ay": np.full(20_000, 3.0),
            "vx": speed,
            "vx_ref": speed,
            "yaw_rate": 2.0 * np.pi / 100.0 * (1.0 + np.sin(lap) + 0.5 * np.sin(3.0 * lap)),
            "sideslip_ref": np.zeros(20_000),
        }

        drives = [Recording(name, "car", 20.0, 0.0, long) for name in names]
        return catalogue_of(*drives)(dataset)

    text = file.read_text(encoding="utf-8")
    config = yaml.safe_load(text)
    split = split_from_config(config, cruising)
    assert split.name == file.stem + ("_fold_1" if "folds" in config else "")
    assert set(dataset_names(config)) == set(split.datasets)


def catalogue_of(*recordings):
    """These recordings as the catalogue of any data set."""

    def reader(recording):
        return lambda channels: recording if channels is None else recording.select(channels)

    return lambda dataset: {recording.id: reader(recording) for recording in recordings}


def drives(ay, vx=None, start_time=0.0):
    """A catalogue of data set ``d``, or of any, with drives at 100 Hz of a given ay."""

    recordings = []
    for name, samples in ay.items():
        channels = {"ay": np.array(samples), "vx": np.array(vx or [10.0] * len(samples))}
        gappy = frozenset({"ay"})
        recordings.append(Recording(name, "car", 100.0, start_time, channels, gappy=gappy))
    return catalogue_of(*recordings)


def selected_ranges(keep, catalogue, **entry):
    """A split whose training is cut by a condition."""
    train = {"recordings": "train_*", **entry, "keep": keep}
    return split_from_config(BASE | {"train": [train]}, catalogue)


def test_patterns_name_recordings_in_order_and_ask_for_a_data_set_once():
    catalogue = drives({name: [0.0] * 10 for name in ("train_b", "test_a", "train_a", "Train_c")})
    config = BASE | {"train": [{"recordings": "train_*", "start": 1}]}
    assert split_from_config(config, catalogue).train == (
        Span("d", "train_a", 1.0),
        Span("d", "train_b", 1.0),
    )
    requested = []

    def catalogue(dataset):
        requested.append(dataset)
        return drives({"a1": [0.0] * 10, "b1": [0.0] * 10})(dataset)

    plain = {**HEAD, "train": [{"recording": "a1"}], "validation": [{"recording": "b1"}]}
    split_from_config(plain, catalogue)
    assert requested == []
    split_from_config(
        plain | {"train": [{"recordings": "a*"}], "validation": [{"recordings": "b*"}]}, catalogue
    )
    assert requested == ["d"]


def test_conditions_select_segments_of_the_minimum_duration():
    # At 100 Hz: 1.99 s, too short; one sample above; 2 s, just long enough; one above; 3 s to the
    # end. Limits belong to what is kept.
    ay = [-7.0] * 199 + [7.01] + [7.0] * 200 + [-7.01] + [0.0] * 300
    keep = {"magnitude": {"ay": {"at_most": 7.0}}, "at_least_seconds": 2.0}
    split = selected_ranges(keep, drives({"train_1": ay}, start_time=50.0))
    assert [(span.start, span.stop) for span in split.train] == [(52.0, 54.0), (54.01, math.inf)]


@PROPERTY
@given(
    st.lists(
        st.tuples(st.sampled_from([0.0, 5.0, -9.0, math.nan]), st.integers(1, 40)),
        min_size=1,
        max_size=12,
    ),
    st.integers(0, 30),
)
def test_conditions_match_a_plain_loop_over_samples(pieces, shortest):
    ay = [value for value, length in pieces for _ in range(length)]
    expected = set()
    run = []
    for k, value in enumerate([*ay, math.inf]):
        if abs(value) <= 5.0:
            run.append(k)
            continue
        expected.update(run if len(run) >= shortest else [])
        run = []
    catalogue = drives({"train_1": ay}, start_time=3.3)
    keep = {"magnitude": {"ay": {"at_most": 5.0}}, "at_least_seconds": shortest / 100.0}
    if not expected:
        with pytest.raises(ConfigurationError, match="keeps nothing"):
            selected_ranges(keep, catalogue)
        return
    recording = catalogue("d")["train_1"](["ay"])
    ranges = [
        recording.index_range(span.start, span.stop)
        for span in selected_ranges(keep, catalogue).train
    ]
    assert {k for first, end in ranges for k in range(first, end)} == expected
    assert all(earlier[1] < later[0] for earlier, later in pairwise(ranges))


def test_all_channels_of_a_condition_must_meet_it_within_the_range():
    ay = [0.0] * 50 + [9.0] * 50 + [0.0] * 100
    vx = [10.0] * 150 + [4.0] * 50
    keep = {"magnitude": {"ay": {"at_most": 7.0}, "vx": {"at_least": 5.0}}}
    spans = selected_ranges(keep, drives({"train_1": ay}, vx=vx)).train
    assert [(span.start, span.stop) for span in spans] == [(-math.inf, 0.5), (1.0, 1.5)]
    keep = {"magnitude": {"ay": {"at_most": 7.0}}}
    spans = selected_ranges(
        keep, drives({"train_1": [0.0] * 100 + [9.0] * 100 + [0.0] * 100}), start=0.5, stop=2.5
    ).train
    assert [(span.start, span.stop) for span in spans] == [(0.5, 1.0), (2.0, 2.5)]


CONDITION = {"magnitude": {"ay": {"at_most": 7.0}}}


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"recordings": "lap_*"}, "no recording of data set 'd' matches 'lap_*' (it has train_1)"),
        (
            {"recordings": "train_*", "recording": "train_1"},
            "needs a recording or recordings, a pattern of several",
        ),
        ({"recording": "train_9", "keep": CONDITION}, "no recording 'train_9'"),
        ({"keep": {"magnitude": {"lateral": {"at_most": 7.0}}}}, "there is no channel 'lateral'"),
        (
            {"keep": {"magnitude": {"ay": {"at_most": -7.0}}}},
            "keep.magnitude.ay: no magnitude lies between 0 and -7",
        ),
        (
            {"keep": {"magnitude": {"ay": {"at_least": 8.0, "at_most": 7.0}}}},
            "keep.magnitude.ay: no magnitude lies between 8 and 7",
        ),
        (
            {"keep": {**CONDITION, "at_least_seconds": -1.0}},
            "at_least_seconds: input should be greater than or equal to 0, not -1",
        ),
        (
            {"keep": {**CONDITION, "at_least_seconds": 3.0}},
            "the condition of train keeps nothing (0 <= |ay| <= 7, 3 s or longer)",
        ),
    ],
)
def test_invalid_patterns_and_conditions_are_refused_in_a_single_line(entry, message):
    named = {} if "recording" in entry else {"recordings": "train_*"}
    assert message in refusal(
        BASE | {"train": [{**named, **entry}]}, drives({"train_1": [0.0] * 200})
    )


@pytest.mark.parametrize(
    "entry", [{"recordings": "train_*"}, {"recording": "train_1", "keep": CONDITION}]
)
def test_patterns_and_conditions_require_recordings(entry):
    assert "its patterns and the like need the recordings of data set 'd'" in refusal(
        BASE | {"train": [entry]}
    )


def test_windows_share_memory_and_gaps_and_missing_channels_are_refused_by_name():
    windows = windows_of([recorded("r", 1000, 0.0)], ["vx", "ay"], "vy_ref", 30)
    assert windows.series.nbytes == 1000 * 2 * 8
    channels = {
        "vx": np.zeros(9),
        "ay": np.where(np.arange(9) == 4, np.nan, 0.0),
        "vy_ref": np.zeros(9),
    }
    recording = Recording("lap", "car", 20.0, 0.0, channels, gappy=frozenset({"ay"}))
    with pytest.raises(DataError, match="recording 'lap': channel 'ay' has gaps"):
        windows_of([recording], ["vx", "ay"], "vy_ref", 3)
    assert len(windows_of([recording], ["vx"], "vy_ref", 3)) == 6
    with pytest.raises(DataError, match="recording 'train_1' has no channel 'yaw_rate'"):
        selected_ranges(
            {"magnitude": {"yaw_rate": {"at_most": 1.0}}}, drives({"train_1": [0.0] * 10})
        )


def recorded(name, length, offset):
    samples = offset + np.arange(float(length))
    return Recording(
        name, "car", 20.0, 0.0, {"vx": samples, "ay": -samples, "vy_ref": samples + 0.5}
    )


@PROPERTY
@given(st.lists(st.integers(1, 25), min_size=1, max_size=4), st.integers(1, 12))
def test_windows_are_those_of_a_plain_loop_over_each_recording(lengths, n_window):
    recordings = [recorded(f"r{k}", length, 1000.0 * k) for k, length in enumerate(lengths)]
    expected = []
    for recording in recordings:
        for now in range(n_window - 1, len(recording) - 1):
            past = [
                [recording["vx"][k], recording["ay"][k]] for k in range(now - n_window + 1, now + 1)
            ]
            expected.append((past, recording["vy_ref"][now + 1]))
    if not expected:
        with pytest.raises(DataError, match=f"windows of {n_window} samples"):
            windows_of(recordings, ["vx", "ay"], "vy_ref", n_window)
        return
    windows = windows_of(recordings, ["vx", "ay"], "vy_ref", n_window)
    assert len(windows) == len(expected)
    for start, target, (past, after) in zip(windows.starts, windows.targets, expected, strict=True):
        assert windows.series[start : start + n_window].tolist() == past
        assert target == after


def circuit(name="lap", laps=4.3, start_time=1600000000.0, rate_hz=20.0):
    """A course of two straights and two unlike bends, driven at a speed of its own every lap.

    And the distance of a lap [m].
    """
    straight = 200.0
    radii = (60.0, 30.0)
    bends = [np.pi * radius for radius in radii]
    length = 2.0 * straight + sum(bends) + 300.0
    time = np.arange(int(laps * length / 20.0 * rate_hz)) / rate_hz
    distance = 20.0 * time + 30.0 * np.sin(0.02 * time)
    speed = np.gradient(distance, time)
    place = np.mod(distance, length)
    curvature = np.zeros(len(time))
    curvature[(place >= straight) & (place < straight + bends[0])] = 1.0 / radii[0]
    curvature[(place >= straight + bends[0] + 300.0) & (place < straight + 300.0 + sum(bends))] = (
        1.0 / radii[1]
    )
    noise = 0.01 * np.random.default_rng(0).standard_normal(len(time))
    return Recording(
        name,
        "car",
        rate_hz,
        start_time,
        {"vx": speed, "yaw_rate": curvature * speed + noise, "ay": curvature * speed**2},
    ), length


def test_laps_last_a_round_and_count_from_either_end():
    recording, length = circuit()
    laps = laps_of(recording)
    assert len(laps) == 4
    distance = np.cumsum(recording["vx"]) / recording.rate_hz
    driven = [
        np.interp(stop, recording.time, distance) - np.interp(start, recording.time, distance)
        for start, stop in laps
    ]
    np.testing.assert_allclose(driven, length, rtol=0.01)
    assert all(earlier[1] == later[0] for earlier, later in pairwise(laps))
    entry = {"recording": "lap"}
    config = {
        **HEAD,
        "train": [{**entry, "laps": "first 2"}],
        "validation": [{**entry, "laps": "3"}],
    }
    split = split_from_config(config | {"tests": {"end": "last lap"}}, catalogue_of(recording))
    assert split.train == (Span("d", "lap", laps[0][0], laps[1][1]),)
    assert split.validation == (Span("d", "lap", *laps[2]),)
    assert split.tests["end"] == (Span("d", "lap", *laps[3]),)


def test_laps_are_full_turns_of_ovals_and_circles_and_roads_have_none():
    time = np.arange(6000) / 50.0
    speed = np.full(6000, 10.0)
    bend = (
        np.mod(10.0 * time, 100.0 + 10.0 * np.pi * 2.0) >= 100.0
    )  # two equal halves: a straight, and half a turn of 20 m
    oval = Recording("oval", "car", 50.0, 0.0, {"vx": speed, "yaw_rate": np.where(bend, 0.5, 0.0)})
    durations = [stop - start for start, stop in laps_of(oval)]
    np.testing.assert_allclose(durations, 2.0 * (100.0 + 20.0 * np.pi) / 10.0, rtol=0.02)
    circle = Recording("circle", "car", 50.0, 0.0, {"vx": speed, "yaw_rate": np.full(6000, -0.4)})
    np.testing.assert_allclose(
        [stop - start for start, stop in laps_of(circle)], 2.0 * np.pi / 0.4, atol=0.03
    )
    generator = np.random.default_rng(1)
    yaw_rate = np.convolve(generator.standard_normal(6000), np.full(200, 0.01), mode="same")
    assert (
        laps_of(
            Recording("road", "car", 50.0, 0.0, {"vx": np.full(6000, 20.0), "yaw_rate": yaw_rate})
        )
        == []
    )
    assert (
        laps_of(
            Recording("parked", "car", 50.0, 0.0, {"vx": np.zeros(600), "yaw_rate": np.zeros(600)})
        )
        == []
    )


def test_percentages_are_consecutive_over_every_recording():
    first = Recording("a", "car", 10.0, 50.0, {"vx": np.ones(1000)})
    second = Recording("b", "car", 10.0, 0.0, {"vx": np.ones(200)})
    config = {
        **HEAD,
        "train": "60 %",
        "validation": "15%",
        "tests": {"wet": "20 %", "dry": "5 %"},
    }
    split = split_from_config(config, catalogue_of(first, second))
    assert split.train == (Span("d", "a", -math.inf, 110.0), Span("d", "b", -math.inf, 12.0))
    assert split.validation == (Span("d", "a", 110.0, 125.0), Span("d", "b", 12.0, 15.0))
    assert split.tests["wet"] == (Span("d", "a", 125.0, 145.0), Span("d", "b", 15.0, 19.0))
    assert split.tests["dry"] == (Span("d", "a", 145.0, math.inf), Span("d", "b", 19.0, math.inf))


def test_every_fold_is_tested_once_and_none_learns_from_its_test():
    recording, _ = circuit(laps=6.5)
    config = {**HEAD, "folds": {"number": 4, "of": "laps", "gap_seconds": 1.0}}
    splits = [
        split_from_config({**config, "fold": fold}, catalogue_of(recording)) for fold in range(4)
    ]
    assert [split.name for split in splits] == ["s_fold_1", "s_fold_2", "s_fold_3", "s_fold_4"]
    tested = sorted((span.start, span.stop) for split in splits for span in split.tests["test"])
    assert tested[0][0] == recording.start_time
    assert tested[-1][1] == recording.end_time
    assert all(earlier[1] == later[0] for earlier, later in pairwise(tested))
    for split, after in zip(splits, [*splits[1:], splits[0]], strict=True):
        (tested_span,) = split.tests["test"]
        (stopped_on,) = after.tests["test"]
        assert (
            stopped_on.start
            <= split.validation[0].start
            < split.validation[-1].stop
            <= stopped_on.stop
        )
        for span in (*split.train, *split.validation):
            assert span.stop <= tested_span.start - 1.0 or span.start >= tested_span.stop + 1.0


@pytest.mark.parametrize("of", ["recordings", "seconds"])
def test_folds_of_recordings_and_of_seconds_leave_nothing_out(of):
    recordings = [
        Recording(name, "car", 10.0, 0.0, {"vx": np.ones(1000), "yaw_rate": np.zeros(1000)})
        for name in "abcdef"
    ]
    config = {**HEAD, "folds": {"number": 3, "of": of, "gap_seconds": 0.0}}
    for fold in range(3):
        split = split_from_config({**config, "fold": fold}, catalogue_of(*recordings))
        length = {
            role: sum(span.stop - span.start for span in spans)
            for role, spans in (
                ("train", split.train),
                ("validation", split.validation),
                ("test", split.tests["test"]),
            )
        }
        assert sum(length.values()) == pytest.approx(600.0)
        assert length["test"] == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"train": "70 %", "validation": "20 %", "tests": {"t": "20 %"}},
            "the percentages come to 110 %",
        ),
        (
            {"train": [{"recording": "lap", "start": "150 %"}]},
            "start and stop are a number of seconds or a percentage",
        ),
        (
            {"train": [{"recording": "lap", "laps": "2 to 9"}]},
            "has no '2 to 9': 4 complete laps were found; name times instead",
        ),
        ({"train": [{"recording": "lap", "laps": "some"}]}, "laps are first, last, first 3"),
        (
            {"train": [{"recording": "lap", "laps": "1", "stop": 3}]},
            "a range has laps, or start and stop, not both",
        ),
        ({"folds": {"number": 3}}, "folds make training, validation and test; leave train"),
        (
            {"train": [], "validation": [], "tests": {}, "folds": {"number": 2}},
            "number: input should be greater than or equal to 3, not 2",
        ),
        (
            {"train": [], "validation": [], "tests": {}, "folds": {"number": 9}},
            "do not fill 9 folds",
        ),
        (
            {"train": [], "validation": [], "tests": {}, "folds": {"number": 3}, "fold": 3},
            "fold 3 is not one of 0 to 2",
        ),
        ({"minutes": 0.0}, "split.minutes: input should be greater than 0"),
        ({"minutes_at": 1.0}, "split.minutes_at: input should be less than 1"),
    ],
    ids=str,
)
def test_invalid_portions_are_refused_in_a_single_line(changes, message):
    assert message in refusal(
        BASE | {"train": [{"recording": "lap"}]} | changes, catalogue_of(circuit()[0])
    )


def test_folds_are_never_scraps_and_gaps_stay_complete():
    """What is before the first lap and after the last belongs to them.

    A gap reaches over blocks that are shorter than it.
    """
    recording, _ = circuit(laps=6.5)
    for number in (3, 5):
        config = {
            **HEAD,
            "folds": {"number": number, "of": "laps", "gap_seconds": 3.0},
        }
        for fold in range(number):
            split = split_from_config({**config, "fold": fold}, catalogue_of(recording))
            assert min(span.stop - span.start for span in split.tests["test"]) > 30.0
    short = {
        **HEAD,
        "folds": {"number": 3, "of": "seconds", "block_seconds": 1.0, "gap_seconds": 2.0},
    }
    split = split_from_config(
        short, catalogue_of(Recording("a", "car", 10.0, 0.0, {"vx": np.ones(300)}))
    )
    assert (split.tests["test"], split.validation) == (
        (Span("d", "a", 0.0, 10.0),),
        (Span("d", "a", 12.0, 18.0),),
    )


@pytest.mark.parametrize("laps", [2.3, 2.5, 3.3, 3.97])
def test_laps_end_where_the_course_begins_again_wherever_the_recording_stops(laps):
    time = np.arange(int(laps * 60.0 * 20.0)) / 20.0
    yaw_rate = (
        0.2
        + 0.2 * np.sin(2.0 * np.pi * time / 60.0)
        + 0.3 * np.sin(6.0 * np.pi * time / 60.0 + 1.0)
        - (0.2 - 2.0 * np.pi / 60.0)
    )
    detected = laps_of(
        Recording("lap", "car", 20.0, 0.0, {"vx": np.full(len(time), 20.0), "yaw_rate": yaw_rate})
    )
    assert len(detected) == int(laps)
    np.testing.assert_allclose(
        [stop for _, stop in detected], 60.0 * np.arange(1, int(laps) + 1), atol=0.3
    )


SPANS = (Span("d", "one", 10.0, 40.0), Span("d", "two", 100.0, 160.0))


def total(spans):
    return sum(span.stop - span.start for span in spans)


@pytest.mark.parametrize("at", [0.0, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("seconds", [5.0, 45.0, 86.0])
def test_limited_minutes_have_their_duration_from_any_offset(seconds, at):
    limited = limit_minutes(SPANS, seconds, at)
    assert total(limited) == pytest.approx(seconds)
    assert all(
        any(
            limited_span.start >= span.start and limited_span.stop <= span.stop
            for span in SPANS
            if span.recording == limited_span.recording
        )
        for limited_span in limited
    )
    for position, first in enumerate(limited):
        assert not any(first.overlaps(second) for second in limited[position + 1 :])


def test_minutes_begin_at_their_offset_and_leave_tests_unchanged():
    assert limit_minutes(SPANS, 60.0, 0.5) == (
        Span("d", "one", 10.0, 25.0),
        Span("d", "two", 115.0, 160.0),
    )
    assert limit_minutes(SPANS, 31.0, 0.0) == (Span("d", "one", 10.0, 40.0),)
    assert split_of(minutes=4.0).train == (Span("d", "lap", 0.0, 180.0),)
    assert split_of(minutes=9.0).train == (Span("d", "lap", -math.inf, 360.0),)
    split = split_of(minutes=2.0)
    assert split.name == "mine_2min"
    assert total(split.train) == pytest.approx(90.0, abs=0.2)
    assert total(split.validation) == pytest.approx(30.0, abs=0.2)
    assert split.tests["test"][0].start == pytest.approx(480.0, abs=0.2)


def split_of(**changed):
    drive = Recording("lap", "car", 10.0, 0.0, {"vx": [1.0] * 6000})
    shares = {"train": "60 %", "validation": "20 %", "tests": {"test": "20 %"}}
    return split_from_config(
        {"name": "mine", "dataset": "d", **shares, **changed},
        catalogue_of(drive),
    )


SETS = {  # Table I
    "C-1": ("20130222_01_01_03", "20130222_01_02_03", "20130222_02_01_03"),
    "C-2": ("20130223_01_01_03", "20130223_01_02_03"),
    "F-1": ("20140221_03_02_03", "20140221_03_03_03", "20140221_04_01_03"),
    "F-2": ("20140222_01_01_03", "20140222_02_01_03"),
}
SCHEMES = {
    "cross_vehicle_1": (["C-1"] * 3, ["F-1"] * 3),
    "cross_vehicle_2": (["F-1"] * 3, ["C-1"] * 3),
}  # Table II: learn, stop
SCHEMES |= {"one_vehicle": (["F-1"] * 2, ["F-1"])}


def split(name):
    return split_from_config(compose_config("train", [f"split={name}"])["split"])


def sets_of(spans):
    """Which of Table I's sets the recordings are, in alphabetical order of their names."""
    names = sorted(span.recording for span in spans)
    simulated = [f"{name[0].upper()}-{name[1]}" for name in names if name[2] == "_"]
    return simulated or [
        key for name in names for key, files in SETS.items() if name.rsplit("_", 1)[0] in files
    ]


@pytest.mark.parametrize("place", ["", "_sim"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_schemes_train_and_validate_on_their_cars_and_test_on_both(scheme, place):
    parts = split(scheme + place)
    assert (sets_of(parts.train), sets_of(parts.validation)) == SCHEMES[scheme]
    third = {"j1": ["J-1"] * 2} if place else {}
    assert {name: sets_of(spans) for name, spans in parts.tests.items()} == {
        "c2": ["C-2"] * 2,
        "f2": ["F-2"] * 2,
        **third,
    }


@pytest.mark.parametrize("dataset", ["sim_two_cars", "sim_race_cars", "sim_race_cars_same_sensors"])
def test_simulated_sets_last_as_long_as_the_papers(dataset):
    drives = compose_config("ingest", [f"dataset={dataset}"])["dataset"]["drives"]
    minutes = {
        entry["id"]: entry["count"] * entry["manoeuvre"]["duration"] / 60.0
        for entry in drives
        if entry["id"] != "j1"
    }
    assert minutes == pytest.approx({"c1": 19.0, "c2": 12.6, "f1": 25.7, "f2": 18.1}, abs=0.05)


@pytest.mark.parametrize("length", [0, 1, 2, 50])
@pytest.mark.parametrize("seed", range(3))
def test_runs_are_those_of_a_count_sample_by_sample(length, seed):
    samples = np.random.default_rng(seed).integers(0, 2, length)
    counted = []
    place = 0
    for value, group in groupby(samples.tolist()):
        begin = place
        place = place + len(list(group))
        counted.append((value, [begin, place]))
    assert equal_runs(samples).tolist() == [run for _, run in counted]
    assert true_runs(samples == 1).tolist() == [run for value, run in counted if value == 1]


@pytest.mark.parametrize(
    "name",
    [
        *("1", "1e5", "0x1f", "1.5", "2024-05-03", "null", "True", "no", "off", "nan", "inf"),
        *("öäü", "-lap", ".lap", "lap.", "a b", "a'b", 'a"b', "a/b", "a\nb", "", "~"),
        *("con", "NUL.x", "lpt1", "a" * 101),
    ],
)
def test_a_name_that_means_something_else_in_yaml_an_override_or_a_file_is_refused(name):
    message = one_line(lambda: check_name(name, "data set"), ConfigurationError)
    assert message.startswith("data set: ")
    assert "\n" not in message


@pytest.mark.parametrize(
    "name", ["lap", "250lm", "ferrari_250lm", "a.b-c", "_x", "a" * 100, "null1"]
)
def test_a_plain_name_is_taken_and_yaml_reads_it_as_text(name):
    check_name(name, "data set")
    assert yaml.safe_load(name) == name
