from dataclasses import replace

import numpy as np
import pytest
from measured_drive import CHANNELS, RATE, measured_drive

from vehest.data.splits import Span, Split
from vehest.data.store import write_recording
from vehest.evaluation.metrics import Protocol, pieces_of
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest.studies.kit.explorer import chained, health_over
from vehest.trust.health import INVALID, VALID, learn_health
from vehest.trust.record import About, Trust, write_trust

FROZEN = 60.0  # s, from which on the yaw rate stands still
SPANS = (Span("toy", "lap", 20.0, 40.0), Span("toy", "lap", 50.0, 90.0))


def comparison_on(drive, folder, rate_hz):
    """One calibrated model on two ranges of a drive."""
    write_recording(drive, folder / "lap.parquet")
    health = learn_health(
        [measured_drive(0), measured_drive(1)], [measured_drive(2)], CHANNELS, RATE
    )
    write_trust(Trust(About("any"), health=health), folder)
    model = EvaluatedModel("any", "", "Any", 0, folder, folder, calibration_folder=folder)
    split = Split("toy", (), (), {"test": SPANS})
    protocol = Protocol(rate_hz=rate_hz, warm_up_seconds=2.0, skip_seconds=1.5)
    references = {("toy", "lap"): folder / "lap.parquet"}
    part = PartArtefacts(
        "toy", "", "", "", split, protocol, {"toy": "simulated"}, {}, None, [model], references, []
    )
    return part, model


def test_health_on_the_page_flags_a_frozen_channel_from_its_onset_on(tmp_path):
    drive = measured_drive(3)
    yaw_rate = np.array(drive["yaw_rate"])
    yaw_rate[drive.time >= FROZEN] = yaw_rate[drive.time >= FROZEN][0]
    drive = drive.with_channels({"yaw_rate": yaw_rate})
    part, model = comparison_on(drive, tmp_path, RATE)
    health = health_over(model, list(pieces_of(SPANS, lambda span: drive, part.protocol)), part, 5)
    lengths = [round((span.stop - span.start - 1.5) * RATE) for span in SPANS]
    assert len(health) == sum(lengths) + 5
    first = health[: lengths[0]]
    second = health[lengths[0] + 5 :]
    onset = round((FROZEN - SPANS[1].start - 1.5) * RATE)
    assert (first == VALID).all()
    assert (second[:onset] == VALID).all()
    assert (second[onset + round(RATE) :] == INVALID).mean() > 0.95
    assert np.isnan(health[lengths[0] : lengths[0] + 5]).all()


def test_health_is_drawn_at_the_rate_of_the_model_only(tmp_path):
    drive = measured_drive(3)
    part, model = comparison_on(drive, tmp_path, RATE)
    pieces = list(pieces_of(SPANS, lambda span: drive, part.protocol))
    faster_part = replace(part, protocol=replace(part.protocol, rate_hz=2 * RATE))
    assert health_over(model, pieces, faster_part, 5) is None
    assert health_over(replace(model, calibration_folder=None), pieces, part, 5) is None
    assert chained([np.ones(2), np.zeros(1)], 2).tolist() == pytest.approx(
        [1.0, 1.0, np.nan, np.nan, 0.0], nan_ok=True
    )
