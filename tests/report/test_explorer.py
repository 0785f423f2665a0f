import json

import numpy as np
import pandas as pd
import pytest
from hour import hour_of_driving
from packed_columns import unpacked

from vehest.report.document import Column, Document, Table, bars_of, write_document
from vehest.report.explorer import explorer_json, packed, reckoned_course


def test_packed_values_are_exact_within_half_a_step_and_keep_gaps():
    rng = np.random.default_rng(1)
    values = 30.0 * rng.standard_normal(5_000)
    values[100:120] = np.nan
    described, data = packed(
        {"values": values, "constant": np.full(5_000, -2.5), "nothing": np.full(5_000, np.nan)}
    )
    back = unpacked({"length": 5_000, "columns": described, "data": data})
    assert np.nanmax(np.abs(back["values"] - values)) <= 0.5 * np.ptp(
        values[np.isfinite(values)]
    ) / 65_534 * (1 + 1e-9)
    assert np.array_equal(np.isnan(back["values"]), np.isnan(values))
    assert (back["constant"] == -2.5).all()
    assert np.isnan(back["nothing"]).all()


def test_course_of_a_steady_turn_is_a_circle_of_speed_over_yaw_rate():
    n = 4_001
    step = 0.05
    x, y = reckoned_course(np.full(n, 20.0), np.full(n, -1.0), np.full(n, 0.2), step)
    radius = np.hypot(20.0, 1.0) / 0.2
    angle = 0.2 * step * np.arange(n)
    heading = np.arctan2(-1.0, 20.0)
    assert x == pytest.approx(radius * (np.sin(angle + heading) - np.sin(heading)), abs=0.01)
    assert y == pytest.approx(-radius * (np.cos(angle + heading) - np.cos(heading)), abs=0.01)
    vx = np.array([1.0, 1.0, np.nan, 1.0, 1.0, 1.0])
    x, y = reckoned_course(vx, 0.0 * vx, 0.0 * vx, 1.0)
    assert x.tolist()[:2] + x.tolist()[3:] == [0.0, 1.0, 0.0, 1.0, 2.0]
    assert np.isnan([x[2], y[2]]).all()


def test_bars_share_an_axis_from_zero_and_outliers_are_cut():
    unit, two, far, none = bars_of(
        [0.2, 0.4, 50.0, np.nan], [0.1, 0.3, 40.0, np.nan], [0.4, 0.5, 60.0, np.nan]
    )
    assert none is None
    assert unit["at"] > 0
    assert two["at"] == pytest.approx(2 * unit["at"], abs=0.1)
    assert unit["low"] < unit["at"] < unit["high"]
    assert (unit["cut"], far["cut"], far["at"]) == (False, True, 100.0)


def test_bars_go_with_their_rows_into_the_page_and_into_no_other_file(tmp_path):
    frame = pd.DataFrame(
        {
            "name": ["a", "b"],
            "error": [1.0, 2.0],
            "low": [0.5, 1.5],
            "high": [1.5, 2.5],
            "interval": ["x", "y"],
        }
    )
    columns = {"name": Column("name"), "interval": Column("interval", bar=("error", "low", "high"))}
    write_document(Document("Bars", [Table("bars", "Bars.", frame, columns)]), tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count('data-value="1.0"') == page.count('data-value="2.0"') == 1
    assert '<path class="value" d="M40.0 0V10"/>' in page
    assert "svg" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_page_of_an_hour_at_20_hz_takes_less_than_10_mb(tmp_path):
    write_document(hour_of_driving(), tmp_path)
    assert (tmp_path / "report.html").stat().st_size < 10e6


def test_labels_cannot_end_the_script_that_holds_them():
    content = explorer_json({"timeLabel": "</script>"}, {"vx": np.ones(11)})
    assert "</" not in content
    assert json.loads(content)["timeLabel"] == "</script>"
