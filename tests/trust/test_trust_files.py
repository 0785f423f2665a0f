"""A damaged trust.yaml is one line or harmless: never an internal error, never a number beyond what
can be learnt.
"""

import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from trust_mutations import PLACED, mutations, place

from vehest.data.errors import VehestError
from vehest.data.store import read_recording
from vehest.estimators.model_files import model_digest
from vehest.inference.car_values import with_settings
from vehest.inference.estimation import estimate_recording
from vehest.inference.models import open_model, pretrained_folder
from vehest.trust.bands import MAX_FACTOR, MAX_TERM, MIN_TERM
from vehest.trust.contract import GuardedStepper
from vehest.trust.guard import MAX_TAN_SIDESLIP, MAX_TOP_SPEED
from vehest.trust.record import TRUST, read_trust, write_trust

YESTERDAY = Path(__file__).parents[1] / "yesterday"
N_MUTATIONS = 200
CHANNELS = ("vy", "sideslip", "band_vy", "band_sideslip", "health", "health_reason")


@cache
def drive():
    return read_recording(YESTERDAY / "drives" / "planar_20hz.parquet")


@pytest.fixture
def folder(tmp_path):
    """A model with its bands, limits and health, and the digest that ties them to it."""
    target = tmp_path / "model"
    shutil.copytree(YESTERDAY / "models" / "ksnn", target)
    write_trust(read_trust(target), target, model_digest(target))
    return target


def answers(folder):
    """Estimates of a model on a drive, whole and online; the message where it is refused."""
    try:
        _, model, trust = open_model(str(folder), folder.parent, lambda remark: None)
        estimate = estimate_recording(model, drive(), trust)
        stepper = GuardedStepper(model, trust, 100.0)
    except VehestError as error:
        return str(error)
    outputs = [estimate[name] for name in CHANNELS if name in estimate.channels]
    for k in range(50):
        step = stepper.step(dict.fromkeys(model.channels, 1.0 + 0.01 * k), 0.01 * k)
        outputs.append(np.array([step.get(name, np.nan) for name in CHANNELS]))
    return outputs


def is_sane(outputs):
    """Whether estimates and bands stay within what limits that can be learnt allow."""
    vy, sideslip, *further_channels = outputs
    health = further_channels[-52]
    band_vy = further_channels[0] if len(further_channels) == 54 else np.zeros(1)
    band_sideslip = further_channels[1] if len(further_channels) == 54 else np.zeros(1)
    largest_band = 1e3 * MAX_FACTOR * MAX_TERM**2 / MIN_TERM
    return bool(
        np.nanmax(np.abs(vy)) <= MAX_TAN_SIDESLIP * MAX_TOP_SPEED
        and np.nanmax(np.abs(sideslip)) <= np.pi
        and np.nanmax(band_sideslip) <= np.pi
        and np.nanmin(band_vy) >= 0.0
        and np.nanmax(band_vy) <= largest_band
        and np.isin(health, (0.0, 1.0, 2.0)).all()
    )


def are_equal(outputs, expected):
    return len(outputs) == len(expected) and all(
        map(np.array_equal, outputs, expected, [True] * len(expected))
    )


def test_every_mutation_of_trust_yaml_is_refused_or_leaves_sane_numbers(folder):
    path = folder / TRUST
    text = path.read_text(encoding="utf-8")
    right = answers(folder)
    assert is_sane(right)
    counts = {"refused": 0, "same bits": 0, "other numbers": 0}
    for name, mutated in mutations(text, N_MUTATIONS).items():
        path.write_text(mutated, encoding="utf-8")
        outputs = answers(folder)
        if isinstance(outputs, str):
            assert "\n" not in outputs, name
            counts["refused"] += 1
        elif are_equal(outputs, right):
            counts["same bits"] += 1
        else:
            assert is_sane(outputs), name
            counts["other numbers"] += 1
    assert sum(counts.values()) >= N_MUTATIONS
    assert counts["refused"] > N_MUTATIONS // 2, counts


@pytest.mark.parametrize("kind", PLACED)
def test_something_else_than_a_file_is_refused_and_never_counts_as_no_calibration(folder, kind):
    path = folder / TRUST
    right = answers(folder)
    text = path.read_text(encoding="utf-8")
    path.unlink()
    place(kind, path, text)
    outputs = answers(folder)
    if kind == "link to the file":
        assert are_equal(outputs, right)
    else:
        assert isinstance(outputs, str)
        assert str(path) in outputs
        assert "\n" not in outputs


@pytest.mark.parametrize("entries", [1, 60])
def test_further_channels_of_bands_are_refused(folder, entries):
    path = folder / TRUST
    text = path.read_text(encoding="utf-8")
    begin = text.index("  channels:\n", text.index("bands:\n")) + len("  channels:\n")
    further_channels = entries * "  - wheel_speed_fl\n"
    path.write_text(text[:begin] + further_channels + text[begin:], encoding="utf-8")
    message = answers(folder)
    assert isinstance(message, str)
    assert "channel" in message


def test_the_file_of_another_model_is_refused(folder, tmp_path):
    other_model = tmp_path / "other"
    shutil.copytree(YESTERDAY / "models" / "gru", other_model)  # same channels, rate and horizon
    shutil.copy(other_model / TRUST, folder / TRUST)
    assert "about.estimator is gru" in answers(folder)
    shutil.copy(pretrained_folder() / TRUST, folder / TRUST)  # of the same family
    assert "belongs to another model" in answers(folder)


def test_a_changed_model_is_refused_but_a_changed_note_is_not(folder):
    description = folder / "model.yaml"
    text = description.read_text(encoding="utf-8")
    right = answers(folder)
    description.write_text(text.replace("about:\n", "about:\n  note: mine\n", 1), encoding="utf-8")
    assert are_equal(answers(folder), right)
    description.write_text(text.replace("polyphase", "nearest"), encoding="utf-8")
    assert isinstance(answers(folder), str)


def test_a_file_that_names_no_model_is_used_with_a_remark(folder):
    right = answers(folder)
    write_trust(read_trust(folder), folder)
    remarks = []
    open_model(str(folder), folder.parent, remarks.append)
    assert len(remarks) == 1
    assert "does not say which model" in remarks[0]
    assert are_equal(answers(folder), right)


@pytest.mark.parametrize("name", ["pretrained", "self_calibrating"])
def test_the_models_that_come_with_vehest_name_themselves(name):
    remarks = []
    folder, _, trust = open_model(name, Path("nowhere"), remarks.append)
    assert remarks == []
    assert trust.about.model == model_digest(folder)


def test_bands_of_a_filter_without_ax_count_it_as_not_measured():
    """The columns of the bands are those of the channels that are read, also where a setting leaves
    one out.
    """
    _, model, trust = open_model("self_calibrating", Path("nowhere"), lambda remark: None)
    fewer = with_settings(model, {"measured_ax": False})
    assert fewer.channels == ("yaw_rate", "vx", "ay")
    with pytest.raises(VehestError, match="belongs to another model"):
        GuardedStepper(fewer, trust)
    fitted = trust.for_settings(fewer)
    assert (fitted.bands.channels, fitted.health) == (fewer.channels, None)
    row = np.array([[0.2, 20.0, 4.0]])
    with_ax = np.array([[0.2, 20.0, 4.0, np.nan]])
    estimate = np.ones(1)
    np.testing.assert_array_equal(
        fitted.bands.half_widths(row, estimate, estimate),
        trust.bands.half_widths(with_ax, estimate, estimate),
    )
