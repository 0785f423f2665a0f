"""Ranges cut down to minutes: as long as asked, in order, from any place, and only for what is learnt."""

import math

import pytest

from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.data.split_files import limit_minutes, split_from_config
from vehest.data.splits import Span

SPANS = (Span("d", "one", 10.0, 40.0), Span("d", "two", 100.0, 160.0))


def total(spans):
    return sum(span.stop - span.start for span in spans)


@pytest.mark.parametrize("at", [0.0, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("seconds", [5.0, 45.0, 86.0])
def test_as_much_is_kept_as_was_asked_for_from_any_place(seconds, at):
    kept = limit_minutes(SPANS, seconds, at)
    assert total(kept) == pytest.approx(seconds)
    assert all(any(own.start >= span.start and own.stop <= span.stop for span in SPANS if span.recording == own.recording) for own in kept)
    for position, one in enumerate(kept):
        assert not any(one.overlaps(other) for other in kept[position + 1 :])


def test_the_stretch_begins_where_it_is_said_goes_on_at_the_start_and_leaves_out_a_second():
    assert limit_minutes(SPANS, 60.0, 0.5) == (Span("d", "one", 10.0, 25.0), Span("d", "two", 115.0, 160.0))
    assert limit_minutes(SPANS, 31.0, 0.0) == (Span("d", "one", 10.0, 40.0),)


def split_of(**changed):
    drive = Recording("lap", "car", 10.0, 0.0, {"vx": [1.0] * 6000})
    shares = {"train": "60 %", "validation": "20 %", "tests": {"test": "20 %"}}
    return split_from_config({"name": "mine", "dataset": "d", **shares, **changed}, lambda _: {"lap": lambda channels: drive})


def test_ranges_without_ends_end_with_their_recordings():
    assert split_of(minutes=4.0).train == (Span("d", "lap", 0.0, 180.0),)
    assert split_of(minutes=9.0).train == (Span("d", "lap", -math.inf, 360.0),)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"minutes": 0.0}, "split.minutes: input should be greater than 0"),
        ({"minutes_at": 1.0}, "split.minutes_at: input should be less than 1"),
    ],
)
def test_no_time_and_no_place_are_refused(changed, message):
    with pytest.raises(ConfigurationError, match=message):
        split_of(**changed)


def test_minutes_of_a_split_are_shared_by_training_and_validation_and_leave_tests_alone():
    split = split_of(minutes=2.0)
    assert split.name == "mine_2min"
    assert total(split.train) == pytest.approx(90.0, abs=0.2)
    assert total(split.validation) == pytest.approx(30.0, abs=0.2)
    assert split.tests["test"][0].start == pytest.approx(480.0, abs=0.2)
