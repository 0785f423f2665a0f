"""What makes no sense is refused in one line that says what to do: numbers without physical sense,
spreadsheets; and text is no formula.
"""

from pathlib import Path

import numpy as np
import pytest
from refusals import refusal

from every_estimator import drive_for, fitted
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.luenberger import Luenberger
from vehest.report.document import without_formula
from vehest.run.compare_files import compare_estimates
from vehest.sources.base import read_single
from vehest.sources.surveys import survey
from vehest.training.supervised import SupervisedSettings
from vehest.trust.contract import GuardedStepper
from vehest.trust.record import read_trust


def test_settings_and_rates_have_upper_limits():
    with pytest.raises(
        ConfigurationError,
        match=r"training\.learning_rate must be a number of at most 1e\+12, not 1e\+300",
    ):
        SupervisedSettings(learning_rate=1e300)
    with pytest.raises(
        ConfigurationError, match=r"estimator\.rate_hz must be at most 100000, not 1000000\.0"
    ):
        Luenberger.from_config({"rate_hz": 1e6})
    for rate, reason in (
        (1e9, "beyond any bus"),
        (float("inf"), "beyond any bus"),
        (float("nan"), "too slow"),
    ):
        with pytest.raises(ConfigurationError, match=reason):
            GuardedStepper(fitted("luenberger"), None, rate)


def test_a_time_that_is_no_number_counts_as_unknown():
    model = fitted("luenberger")
    drive = drive_for(model)
    timed = GuardedStepper(model)
    untimed = GuardedStepper(model)
    for k in range(5):
        row = {name: float(drive[name][k]) for name in model.channels}
        assert timed.step(row, time="x") == untimed.step(row)


def test_a_recording_of_two_rows_a_minute_distant_is_not_scored():
    channels = {"vx": np.full(2, 20.0), "vy_ref": np.zeros(2)}
    recording = Recording("two", "a car", 1.0 / 60.0, 0.0, channels)
    zeros = {"vy": np.zeros(2), "sideslip": np.zeros(2)}
    estimate = Estimate("two", "luenberger", 1.0 / 60.0, 0.0, zeros)
    message = refusal(lambda: compare_estimates(recording, {"mine": estimate}))
    assert "'two' is sampled at 0.0167 Hz; scores need 1 Hz or more" in message


def test_a_damaged_calibration_names_its_file(tmp_path):
    text = (
        Path(read_trust.__code__.co_filename).parents[1] / "pretrained" / "trust.yaml"
    ).read_text(encoding="utf-8")
    (tmp_path / "trust.yaml").write_text(text.replace("yaw_rate", "foreign"), encoding="utf-8")
    assert "trust.yaml'" in refusal(lambda: read_trust(tmp_path))


def test_tables_to_download_start_no_formula():
    formulas = ('=HYPERLINK("x")', "+1|cmd", "@SUM(A1)")
    assert [without_formula(cell) for cell in formulas] == [f"'{cell}" for cell in formulas]
    plain = ("+0.280 [0.039, 0.521]", "lap 3", -0.5)
    assert tuple(map(without_formula, plain)) == plain


def test_spreadsheets_and_measurements_are_refused_with_a_remedy(tmp_path):
    for name in ("lap.xlsx", "drive.mf4"):
        (tmp_path / name).write_bytes(b"PK")
    for read in (survey, lambda file: read_single({"name": "mine", "source": "tabular"}, file)):
        with pytest.raises(DataError, match=r"lap\.xlsx' is a spreadsheet; save it as CSV"):
            read(tmp_path / "lap.xlsx")
    with pytest.raises(
        ConfigurationError, match=r"describe its signals once by 'vehest new NAME drive\.mf4'"
    ):
        read_single({"name": "mine", "source": "tabular"}, tmp_path / "drive.mf4")
