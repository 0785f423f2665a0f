"""A drive on one page: what is drawn where, read from matplotlib's artists."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refusal

from conftest import planar_drive
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.evaluation.metrics import accuracy, score_whole
from vehest.report.drive_figure import drive_figure

RATE = 20.0


@pytest.fixture
def drive():
    return planar_drive(30.0, 100.0, seed=2)


def estimate_of(drive, error=0.1, rate_hz=RATE):
    """The reference with a constant error of v [m/s] and a band of 0.2 m/s, invalid for 3 s."""
    step = round(drive.rate_hz / rate_hz)
    vx = drive["vx"][::step]
    vy = drive["vy_ref"][::step] + error
    time = np.arange(len(vy)) / rate_hz
    channels = {
        "vy": vy,
        "sideslip": np.arctan2(vy, vx),
        "band_vy": np.full(len(vy), 0.2),
        "band_sideslip": np.full(len(vy), 0.02),
        "health": np.where(time >= 27.0, 2.0, 0.0),
        "health_reason": np.zeros(len(vy)),
    }
    return Estimate(drive.id, "mine", rate_hz, drive.start_time, channels)


def labels(figure):
    return [axes.get_ylabel().replace("\n", " ") for axes in figure.axes]


def axes_of(figure, label):
    return figure.axes[labels(figure).index(label)]


def test_page_has_a_panel_for_each_signal_and_the_legend_names_the_lines(drive):
    figure = drive_figure(drive, [estimate_of(drive)])
    assert labels(figure)[:7] == [
        "sideslip β [deg]",
        "health",
        "v [m/s]",
        "speed u [m/s]",
        "yaw rate [deg/s]",
        "$a_y$ [m/s²]",
        "$a_x$ [m/s²]",
    ]
    assert {"y [m]", "estimated β [deg]"} <= set(labels(figure))
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "reference",
        "90 % band of mine",
        "mine",
        "invalid, 10 % of the time",
    ]


def test_lines_are_reference_and_estimate_in_degrees(drive):
    estimate = estimate_of(drive)
    top = axes_of(drive_figure(drive, [estimate]), "sideslip β [deg]")
    lines = {line.get_label(): line for line in top.get_lines()}
    middle = len(drive) // 2
    at = drive.time[middle]
    for name, vy in (
        ("reference", drive["vy_ref"][middle]),
        ("mine", drive["vy_ref"][middle] + 0.1),
    ):
        drawn = np.interp(at, lines[name].get_xdata(), lines[name].get_ydata())
        assert drawn == pytest.approx(np.degrees(np.arctan2(vy, drive["vx"][middle])), abs=0.02)


def test_health_is_coloured_where_the_estimate_is_invalid(drive):
    axes = axes_of(drive_figure(drive, [estimate_of(drive)]), "health")
    _, invalid = axes.collections
    (path,) = invalid.get_paths()
    first, end = path.get_extents().get_points()[:, 0]
    assert first == pytest.approx(drive.start_time + 27.0, abs=0.05)
    assert end == pytest.approx(drive.end_time, abs=0.05)


def test_error_in_the_picture_is_that_of_the_metric(drive):
    estimate = estimate_of(drive)
    figure = drive_figure(drive, [estimate])
    legend = axes_of(figure, "estimated β [deg]").get_legend()
    scored = accuracy([score_whole(estimate, drive)])
    assert scored["rmse_vy"] == pytest.approx(0.1, rel=1e-3)
    assert legend.get_texts()[0].get_text() == f"RMSE {scored['rmse_sideslip']:.3f}°"


def test_course_follows_a_circle():
    """u = 10 m/s and 0.5 rad/s make a circle of 20 m radius."""
    steps = np.ones(round(4 * np.pi * 50))
    channels = {"vx": 10.0 * steps, "yaw_rate": 0.5 * steps, "ay": 5.0 * steps}
    drive = Recording("circle", "car", 50.0, 0.0, channels | {"vy_ref": 0.0 * steps})
    axes = axes_of(drive_figure(drive), "y [m]")
    points = np.concatenate(axes.collections[0].get_segments())
    assert np.hypot(points[:, 0], points[:, 1] - 20.0) == pytest.approx(20.0, abs=0.01)


def test_two_estimates_by_the_same_estimator_differ_in_name_and_dash(drive):
    figure = drive_figure(drive, [estimate_of(drive), estimate_of(drive, error=0.3)])
    lines = {line.get_label(): line for line in axes_of(figure, "v [m/s]").get_lines()}
    assert {"mine", "mine (2)"} <= lines.keys()
    assert lines["mine"].get_linestyle() != lines["mine (2)"].get_linestyle()


def test_missing_channels_have_no_panel(drive):
    bare = drive.without_references().select(["vx", "ay"])
    assert labels(drive_figure(bare)) == ["speed u [m/s]", "$a_y$ [m/s²]"]
    estimate = estimate_of(drive)
    assert labels(drive_figure(None, [estimate])) == ["sideslip β [deg]", "health", "v [m/s]"]
    plain = replace(estimate, channels={name: estimate[name] for name in ("vy", "sideslip")})
    assert labels(drive_figure(None, [plain])) == ["sideslip β [deg]", "v [m/s]"]
    alone = drive.select(["vy_ref"])
    assert "there is nothing to draw" in refusal(lambda: drive_figure(alone), DataError)


def test_ranges_are_drawn_alone_and_empty_ranges_are_refused(drive):
    figure = drive_figure(drive, [estimate_of(drive)], 10.0, 12.0)
    assert axes_of(figure, "v [m/s]").get_xlim() == (10.0, pytest.approx(11.99))
    assert "no samples between" in refusal(lambda: drive_figure(drive, start=500.0), DataError)


def test_a_notebook_shows_it_and_the_same_drive_gives_the_same_bytes(drive):
    few_panels = drive.select(["vx", "vy_ref"])
    first, second = (drive_figure(few_panels)._repr_png_() for _ in range(2))
    assert first.startswith(b"\x89PNG")
    assert first == second


def standing_and_reversing():
    """A car that drives, stands with a speed that wanders around zero, and reverses; 10 s each."""
    n = round(10.0 * RATE)
    rng = np.random.default_rng(4)
    vx = np.concatenate([np.full(n, 10.0), rng.normal(0.0, 0.15, n), np.full(n, -3.0)])
    vy = np.concatenate([np.full(n, 0.5), rng.normal(0.0, 0.02, n), rng.normal(0.0, 0.02, n)])
    channels = {"vx": vx, "yaw_rate": np.zeros(3 * n), "vy_ref": vy}
    return Recording("yard", "car", RATE, 0.0, channels), n


@pytest.mark.parametrize("has_reference", [True, False])
def test_standstill_and_reverse_neither_draw_sideslip_nor_set_its_axis(has_reference):
    recording, n = standing_and_reversing()
    estimate = estimate_of(recording)
    assert np.degrees(np.abs(estimate["sideslip"])).max() > 170.0
    drawn = recording if has_reference else recording.without_references()
    for figure in (drive_figure(drawn, [estimate]), drive_figure(None, [estimate])):
        axes = axes_of(figure, "sideslip β [deg]")
        (line,) = [line for line in axes.get_lines() if line.get_label() == "mine"]
        is_drawn = np.isfinite(line.get_ydata())
        assert is_drawn.tolist() == [True] * n + [False] * (2 * n)
        assert line.get_ydata()[0] == pytest.approx(np.degrees(np.arctan2(0.6, 10.0)))
        assert np.abs(axes.get_ylim()).max() < 10.0
