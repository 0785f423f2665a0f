"""The drawn trucks, the Ferrari's folds and the search for noise levels, on drives whose answer is
known.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from vehest.data.splits import Span
from vehest_papers.heavy_ekf import candidates, conditions, cross_validation, drawn, paper
from vehest_papers.heavy_ekf.candidates import (
    FILTERS,
    WITH_STATE,
    Levels,
    measured_drive,
    sideslip_of,
    tuned,
)
from vehest_papers.heavy_ekf.twin import CURVES, Conditions, drive
from vehest_papers.kit.block_errors import Key, blocks_of
from vehest_papers.kit.block_rows import BlockRow
from vehest_papers.kit.claim_files import claims_of


class DrivesPart:
    """A part whose recordings are drives of the twin."""

    def __init__(self, tests, tuning_drives, recordings):
        self.recordings = recordings
        self.split = SimpleNamespace(tests=tests, train=tuning_drives, validation=[])

    def reference(self, span):
        return self.recordings[span.recording]

    def reference_ranges(self, spans):
        return [self.reference(span) for span in spans]


def lap(name, seed, seconds=40.0, slip=5.0, **conditions_of_drive):
    recording = drive(Conditions(slip, **conditions_of_drive), seed, seconds).recording
    references = {"vx_ref": recording["vx"], "yaw_rate_ref": recording["yaw_rate"]}
    return replace(recording, id=name, channels={**recording.channels, **references})


@pytest.fixture(scope="module")
def trucks():
    """Two trucks in each condition, with a search of a few points."""
    recordings = {}
    tests = {}
    tuning = []
    for condition in drawn.CONDITIONS:
        has_crossfall = condition.endswith("crossfall")
        names = [f"{condition}_test_{number:03d}" for number in (1, 2)]
        tests[condition] = [Span("d", name) for name in names]
        for number, name in enumerate([*names, f"{condition}_tune_101"]):
            recordings[name] = lap(name, number, crossfall=has_crossfall)
        tuning.append(Span("d", f"{condition}_tune_101"))
    patch = pytest.MonkeyPatch()
    patch.setattr(candidates, "N_DRAWN", 4)
    patch.setattr(candidates, "N_REFINED", 1)
    patch.setattr(candidates, "MAX_EVALUATIONS", 5)
    part = DrivesPart(tests, tuning, recordings)
    outcome = drawn.drawn_trucks(part)
    patch.undo()
    return part, outcome


def test_errors_of_a_truck_are_those_of_the_filter_with_the_levels_of_its_tuning(trucks):
    part, outcome = trucks
    blocks = blocks_of(outcome.rows)
    curves = np.concatenate([outcome.fit.front, outcome.fit.rear])
    recording = part.recordings["worn_crossfall_test_002"]
    measured = measured_drive(recording, curves)
    for part_name, condition in (
        (drawn.TUNED_ON_ALL, "worn_crossfall"),
        (drawn.MATCHED, "worn_crossfall"),
        (drawn.UNMATCHED, "nominal_level"),
    ):
        levels = outcome.tuned[part_name]["worn_crossfall"]["LINT"].levels
        if part_name == drawn.UNMATCHED:
            assert levels == outcome.tuned[drawn.MATCHED][condition]["LINT"].levels
        expected = measured.squared_error(sideslip_of("LINT", levels, measured)).sum()
        errors = blocks[Key(part_name, "LINT", "worn_crossfall", "rmse_sideslip")]
        assert errors.blocks == ("truck 1", "truck 2")
        assert errors.sums[0, 1] == pytest.approx(expected)
        assert errors.sizes[1] == measured.is_scored.sum()


def test_a_road_pools_the_laps_of_each_truck_and_regimes_add_up(trucks):
    _, outcome = trucks
    blocks = blocks_of(outcome.rows)
    for name in (*FILTERS, "zero", "static_map"):
        laps = [
            blocks[Key("drawn", name, f"{tyres}_level", "rmse_sideslip")]
            for tyres in ("nominal", "worn", "wet")
        ]
        pooled = blocks[Key("drawn", name, "level", "rmse_sideslip")]
        np.testing.assert_allclose(pooled.sums, np.sum([of_lap.sums for of_lap in laps], axis=0))
        regimes = [
            blocks[Key("drawn", name, "level", f"rmse_sideslip_{regime}")].sums
            for regime in ("straight", "turning")
        ]
        np.testing.assert_allclose(np.sum(regimes, axis=0), pooled.sums)


def test_rear_slip_and_gain_of_a_lap():
    recording = lap("x", 0, 120.0)
    assert drawn.rear_slip([recording]) == pytest.approx(5.0, rel=0.1)
    assert drawn.bend_gain(recording, 0.7 * recording["sideslip_ref"]) == pytest.approx(0.7)


def test_search_finds_levels_as_good_as_the_simulated_noise_levels():
    recordings = [drive(Conditions(3.0), seed, 30.0).recording for seed in (50, 51)]
    drives = [measured_drive(recording, CURVES) for recording in recordings]
    simulated_levels = Levels(ay=0.1, steer=0.002)
    errors = [
        tuning_drive.rmse(sideslip_of(paper.RATT, simulated_levels, tuning_drive))
        for tuning_drive in drives
    ]
    result = tuned(paper.RATT, drives)
    assert result.cost <= 1.02 * math.exp(np.mean(np.log(errors)))


def test_first_seconds_and_slow_samples_are_not_scored():
    recording = drive(Conditions(3.0), 1, 20.0).recording
    speed = np.where(np.arange(len(recording)) < 100, recording["vx"], 1.0)
    measured = measured_drive(recording.with_channels({"vx": speed}), CURVES)
    assert measured.is_scored.sum() == 70
    wrong = measured.sideslip + np.where(measured.is_scored, math.radians(0.3), 1.0)
    assert measured.rmse(wrong) == pytest.approx(0.3)


def test_every_fold_is_scored_by_levels_and_curves_of_the_others(monkeypatch):
    """The training of a fold ends `GAP_SECONDS` before it and begins as much after it."""
    seconds = cross_validation.STOP - cross_validation.START
    recording = replace(lap("ferrari", 3, seconds), start_time=cross_validation.START)
    trained = []

    def remember(name, drives):
        trained.append((name, drives))
        return SimpleNamespace(levels=Levels(0.1, 0.005, 0.001))

    monkeypatch.setattr(cross_validation, "tuned", remember)
    part = DrivesPart({}, [Span("d", "ferrari")], {"ferrari": recording})
    outcome = cross_validation.cross_validated("ferrari", part)
    fold = seconds / cross_validation.N_FOLDS
    of_ratt = [drives for name, drives in trained if name == paper.RATT]
    lengths = [
        sum(len(tuning_drive.samples) for tuning_drive in drives) / 20.0 for drives in of_ratt
    ]
    gaps = [1, 2, 2, 2, 1]
    expected = [seconds - fold - 2.0 * number for number in gaps]
    assert lengths == pytest.approx(expected, abs=0.2)
    errors = blocks_of(outcome.rows)[Key("ferrari", paper.RATT, "cross_validated", "rmse_sideslip")]
    assert len(errors.blocks) == 20
    squared = np.square(
        np.degrees(outcome.estimates[paper.RATT]["sideslip"] - recording["sideslip_ref"])
    )
    assert errors.sums.sum() == pytest.approx(squared[30:].sum())


def test_orders_have_a_row_per_claim_and_print_the_power_if_not_significant():
    generator = np.random.default_rng(0)
    ratios = {"LINT": 1.0, "RATT": 1.0, "RATTE": 0.5}
    rows = []
    for part, test in (("drawn", "level"), ("drawn", "crossfall"), ("truck", "nominal_laps")):
        hard = generator.uniform(1.0, 9.0, 20)
        for name, ratio in ratios.items():
            for suffix in ("", WITH_STATE):
                noise = 1.0 + 0.05 * generator.standard_normal(20)
                rows += [
                    BlockRow(
                        part, f"{name}{suffix}", 0, test, "rmse_sideslip", f"truck {k}", value, 1.0
                    )
                    for k, value in enumerate(ratio**2 * hard * noise)
                ]
    orders, tuning, every_entry = conditions.orders_tables(claims_of("heavy_ekf"), rows, [])
    assert len(orders.frame) == 3
    ratt_lint, ratte_ratt, _ = orders.frame["trucks, level, all tyres"]
    assert "n.s. (100 %)" in ratt_lint
    assert float(ratte_ratt.split()[0]) == pytest.approx(0.5, abs=0.01)
    assert ratte_ratt.endswith("lower")
    assert len(tuning.frame) == len(conditions.BY_TUNING)
    assert every_entry["power"].between(0.0, 1.0).all()
