"""Errors by block of the heavy vehicle's study: they add up to the figures that the report
shows.
"""

import math

import numpy as np
import pytest
from study_parts import part_of, stored
from test_studies_heavy_ekf import RATE, short_drive
from test_studies_heavy_ekf import estimated as scaled

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span, Split
from vehest.data.store import write_estimate
from vehest.evaluation.blocks import segments_of, write_segments
from vehest.evaluation.metrics import Protocol, accuracy, score_all
from vehest.studies.artefacts import EvaluatedModel
from vehest_papers.heavy_ekf import block_errors, factorial, wheels
from vehest_papers.kit.block_errors import blocks_of, training_of
from vehest_papers.kit.claim_files import claims_of
from vehest_papers.kit.verdicts import judge_paper

PROTOCOL = Protocol(rate_hz=RATE, skip_seconds=1.5)
SPAN = Span("car", "short")
LEARNT = Span("car", "learnt")
JUDGED = Span("car", "judged")
ERRORS = {"zero": 0.01, "ratte": 0.002, "lint": 0.005, "ratmu": 0.004}


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """Estimates of one drive that err by noise of the given deviation [rad], scored as an
    evaluation does.
    """
    folder = tmp_path_factory.mktemp("heavy")
    drive = short_drive(120.0)
    models = []
    noise = np.random.default_rng(1).standard_normal(len(drive))
    for variant, amplitude in ERRORS.items():
        home = folder / variant
        (home / "laps").mkdir(parents=True)
        sideslip = np.arctan2(drive["vy_ref"], drive["vx"]) + amplitude * noise
        channels = {"vy": drive["vx"] * np.tan(sideslip), "sideslip": sideslip}
        estimate = Estimate("short", variant, RATE, 0.0, channels)
        write_estimate(estimate, home / "laps" / "0.parquet")
        scored = score_all(
            lambda _, drive_estimate=estimate: drive_estimate, [SPAN], lambda _: drive, PROTOCOL
        )
        write_segments(home / "blocks.csv", {"laps": segments_of(scored, RATE)})
        family = "zero" if variant == "zero" else "rational_ekf"
        models.append(EvaluatedModel(family, variant, variant, 0, home, home))
    split = Split("laps", (LEARNT,), (JUDGED,), {"laps": (SPAN,)})
    references = stored(folder, "car", {"short": drive})
    return part_of(split, PROTOCOL, models, [], references=references)


def of_metric(rows, metric):
    """Candidate -> block -> (value, size)."""
    by_candidate = {}
    for row in rows:
        if row.metric == metric:
            by_candidate.setdefault(row.candidate, {})[row.block] = (row.value, row.size)
    return by_candidate


def test_blocks_add_up_to_the_rmse(part):
    rows = block_errors.drive_rows("truck", part)
    squares = of_metric(rows, "rmse_sideslip")
    assert set(squares) == {"zero", "RATTE", "LINT"}, "those that claims name"
    blocks = list(squares["zero"])
    assert len(blocks) > 5
    assert blocks[0] == "short 1.50 s"
    for candidate, variant in (("zero", "zero"), ("RATTE", "ratte"), ("LINT", "lint")):
        assert list(squares[candidate]) == blocks, "the same for all candidates"
        values, sizes = np.array(list(squares[candidate].values())).T
        (scored,) = part.scored(
            next(model for model in part.models if model.variant == variant), "laps"
        )
        rmse = math.sqrt(values.sum() / sizes.sum())
        assert rmse == pytest.approx(accuracy([scored])["rmse_sideslip"], rel=1e-9)


def test_the_twins_cells_give_the_rmse_of_its_map():
    generator = np.random.default_rng(0)
    names = ("RATTE", "RATT", "LINT", "zero", "static map")

    def cell(slip, mismatch):
        squared = {name: generator.uniform(1.0, 3.0, factorial.SEEDS) for name in names}
        return factorial.Cell(
            factorial.LEVEL, factorial.ALL_ROADS, slip, mismatch, squared, largest_slip=slip
        )

    cells = [cell(slip, mismatch) for slip in factorial.SLIPS for mismatch in factorial.MISMATCHES]
    rows = block_errors.twin_rows(factorial.Factorial({}, cells))
    assert {row.test_set for row in rows} == {
        "slip_2_stiffness_minus_20",
        "slip_5_stiffness_minus_20",
        "slip_8_stiffness_minus_20",
        "slip_5_stiffness_0",
    }
    (mapped_cell,) = (cell for cell in cells if (cell.slip, cell.mismatch) == (5.0, 0.0))
    errors = of_metric(
        [row for row in rows if row.test_set == "slip_5_stiffness_0"], "rmse_sideslip"
    )
    for name in names:
        values, sizes = np.array(list(errors[name.replace(" ", "_")].values())).T
        assert len(values) == factorial.SEEDS
        assert math.sqrt(values.sum() / sizes.sum()) == pytest.approx(mapped_cell.rmse(name))


def test_wheel_speeds_of_a_drive_in_bends_come_together(tmp_path):
    drive = short_drive()
    channels = dict(drive.channels)
    for wheel in wheels.WHEELS:
        channels[f"wheel_speed_{wheel}"] = drive[f"wheel_speed_{wheel}"] * (0.48 / wheels.RADIUS)
    fast = Recording("short", "av21", RATE, 0.0, channels, "real")
    split = Split("av21", (LEARNT,), (JUDGED,), {"putnam": (SPAN,)})
    part = part_of(
        split, PROTOCOL, [], [], references=stored(tmp_path, "car", {"short": fast, "learnt": fast})
    )
    by_candidate = of_metric(block_errors.wheel_rows("av21", part), "rmse_wheel_speed_spread")
    (measured, corrected) = (
        by_candidate[name] for name in ("measured wheel speeds", "corrected wheel speeds")
    )
    assert list(measured) == [f"short 0.00 s, block {k}" for k in range(1, 7)]
    spread = np.var(
        wheels.RADIUS * np.stack([fast[f"wheel_speed_{wheel}"] for wheel in wheels.WHEELS]),
        axis=0,
    )
    assert measured["short 0.00 s, block 1"] == (pytest.approx(spread[:200].sum()), 200.0)
    assert all(corrected[block][0] < 0.1 * measured[block][0] for block in measured)


def test_measured_values_have_the_ids_of_the_papers_claims():
    drive = short_drive(120.0)
    speed = np.where(drive.time < 110.0, 10.0, 0.0)
    drive = drive.with_channels({"ay": 2.0 * drive["ay"], "vx_ref": speed})
    tests = ("nominal_laps", "worn_laps", "wet_laps")
    estimates = {test: {name: scaled(drive, 0.8) for name in ("RATTE", "zero")} for test in tests}
    rows = block_errors.measured_rows("truck", dict.fromkeys(tests, drive), estimates, 2.0)
    measured = [
        claim
        for claim in claims_of("heavy_ekf").claims
        if claim.kind == "measured" and claim.part == "truck"
    ]
    assert {row.metric for row in rows} == {claim.id for claim in measured}
    for claim in measured:
        named = {(row.part, row.test_set, row.candidate) for row in rows if row.metric == claim.id}
        assert (claim.part, claim.test_set, claim.candidate) in named
    verdicts = judge_paper(
        claims_of("heavy_ekf"), blocks_of(rows), training_of(block_errors.training_rows())
    )
    stops = verdicts["ratte_until_0_4_s_before_stop"]
    assert stops.n_blocks == 3


def test_no_filter_is_trained_in_epochs():
    rows = {row.candidate: row for row in block_errors.training_rows()}
    assert {"LINT", "RATT", "RATTE", "zero", "static_map"} <= rows.keys()
    assert {row.training for row in rows.values()} == {"not applicable"}
