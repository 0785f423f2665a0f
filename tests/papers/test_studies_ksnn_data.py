"""Table I and Figures 4 and 5 from drives whose figures are known."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import planar_drive
from vehest.data.recording import Recording
from vehest.report.document import Document, Figure, Table, write_document
from vehest_papers.ksnn.data_quality import PUBLISHED, data_quality, statistics


def _drive(vehicle, *, bias=0.0, seed=0, slide=1.0):
    drive = planar_drive(noise=0.001, seed=seed, name=f"{vehicle}{seed}")
    channels = {**drive.channels, "ay": drive["ay"] - bias, "vy_ref": slide * drive["vy_ref"]}
    return replace(drive, vehicle=vehicle, channels=channels)


def _text(blocks):
    return "\n".join(block for block in blocks if isinstance(block, str))


def test_statistics_are_those_of_a_hand_calculation():
    n = 1201
    ramp = np.linspace(-1.0, 1.0, n)
    channels = {"vx": np.full(n, 30.0), "yaw_rate": 0.5 * ramp, "ay": 10.0 * ramp, "ax": 0.0 * ramp, "vy_ref": 2.0 * ramp}
    own = statistics([Recording("ramp", "car", 20.0, 0.0, channels), Recording("again", "car", 20.0, 0.0, channels)])
    assert (own.u_min, own.u_max, own.yaw_rate_min, own.yaw_rate_max) == (30.0, 30.0, -0.5, 0.5)
    assert (own.v_low, own.v_high) == (pytest.approx(-1.96, abs=2e-3), pytest.approx(1.96, abs=2e-3))
    assert own.ay == pytest.approx(9.9, abs=0.02)
    assert own.length_km == pytest.approx(2 * 1201 / 20 * 30 / 1000)
    assert own.minutes == pytest.approx(2 * 1201 / 20 / 60)


def test_published_rows_stand_beside_ours():
    table = data_quality({"C-1": [_drive("corvette")], "own": [_drive("other", seed=1)]}, "made up")[0]
    assert isinstance(table, Table)
    assert table.frame[["set", "data"]].values.tolist() == [["C-1", "paper"], ["C-1", "ours, simulated"], ["own", "ours, simulated"]]
    assert table.frame["length_km"][0] == PUBLISHED["C-1"].length_km


def test_planted_bias_is_told_beside_the_papers():
    text = _text(data_quality({"F-1": [_drive("ferrari", bias=0.25)], "C-1": [_drive("corvette", bias=0.0)]}, "made up"))
    assert "mean bias 0.25" in text.split("\n- ")[1]
    assert "(the paper, on real drives: −0.03 m/s²)" in text.split("\n- ")[1]
    assert "0.10 m/s²" in text.split("\n- ")[2]


@pytest.mark.parametrize(
    ("slide", "claim"), [(2.0, "of the simulated cars here it does."), (0.5, "of the simulated cars here it does not.")]
)
def test_words_on_the_cars_follow_the_drives(slide, claim):
    """The Ferrari's lateral velocity is made twice or half that of the Corvette at the same lateral acceleration."""
    text = _text(data_quality({"F-1": [_drive("ferrari", slide=slide)], "C-1": [_drive("corvette")]}, "made up"))
    assert claim in text


def test_real_car_is_not_compared_with_a_simulated_one():
    real = replace(_drive("ferrari"), kind="real")
    assert "of the" not in _text(data_quality({"F-1": [real], "C-1": [_drive("corvette")]}, "made up")).split("Median")[1]


def test_every_car_and_kind_has_a_panel_and_the_same_bytes_each_time(tmp_path):
    real = replace(_drive("ferrari", seed=2), kind="real")
    sets = {"F-1": [_drive("ferrari")], "F-2": [real], "C-1": [_drive("corvette")]}
    figures = [block for block in data_quality(sets, "made up") if isinstance(block, Figure)]
    assert [figure.name for figure in figures] == ["process_noise", "velocity_over_ay"]
    titles = [axes.get_title(loc="left") for axes in figures[0].static.axes]
    assert titles == ["ferrari, real", "ferrari, simulated", "corvette, simulated"]
    for number in (1, 2):
        (tmp_path / str(number)).mkdir()
        write_document(Document("data", data_quality(sets, "made up")), tmp_path / str(number), page=False)
    first, second = ((tmp_path / str(number) / "figures" / "process_noise.svg").read_bytes() for number in (1, 2))
    assert first == second
