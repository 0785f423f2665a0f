"""Tables of results/unseen_car: bands with a factor from the other cars, and the cars that are
drawn.
"""

import numpy as np
import pytest
from unseen_car import (
    BAND_HEADS,
    CARS,
    DRIVE_BAND_HEADS,
    Errors,
    band_figures,
    drive_figures,
    factor_without,
)
from unseen_car_planted import at_the_limit, draw_crossfall, in_town, share_interval

DEVELOPMENT = [car for car in CARS if car.development]
TEST = next(car for car in CARS if not car.development)


def errors(sideslip, half_width, valid=True, turning=True, straight=False):
    """A drive with errors of β and half widths of the band [deg]."""
    sideslip = np.asarray(sideslip, dtype=float)
    count = len(sideslip)
    return Errors(
        sideslip={"cold": sideslip**2},
        vy={},
        half_width=np.broadcast_to(np.asarray(half_width, dtype=float), count),
        valid=np.broadcast_to(valid, count),
        turning=np.broadcast_to(turning, count),
        straight=np.broadcast_to(straight, count),
        reference=np.zeros(count),
        time=np.arange(count) / 20.0,
        title="drive",
        speed=10.0,
    )


def test_factor_of_a_development_car_comes_from_the_others_and_a_test_car_has_1():
    first, second = DEVELOPMENT[:2]
    car_errors = {
        first: [errors(np.linspace(0.0, 1.0, 201), 1.0)] * 20,
        second: [errors(np.linspace(0.0, 3.0, 201), 1.0)] * 20,
        TEST: [errors(np.full(2001, 50.0), 1.0)],
    }
    assert factor_without(first, car_errors) == pytest.approx(3.0 * 0.9, rel=0.02)
    assert factor_without(second, car_errors) == pytest.approx(1.0 * 0.9, rel=0.02)
    assert factor_without(TEST, car_errors) == 1.0


def test_figures_of_a_band_against_values_worked_out_by_hand():
    straight = [True, False, False, True]
    drive = errors([0.0, 0.5, 1.5, 3.0], 0.5, [True, True, True, False], straight=straight)
    figures = dict(zip(BAND_HEADS[1:], band_figures([drive], 2.0), strict=True))
    assert figures == {
        "factor": "2.00",
        "coverage": "0.50",
        "while turning": "0.50",
        "while turning, worst drive": "–",  # of drives that turn for 2.5 s
        "width [deg]": "2.00",
        "interval score [deg]": "14.50",  # 2 + 20 (0.5 + 2)/4
        "valid": "0.75",
        "valid and outside the band": "0.33",
        "valid and beyond twice the band": "0.000",
        "of these, on straights": "0.000",
    }
    assert len(drive_figures(drive, 2.0)) == len(DRIVE_BAND_HEADS)
    last = drive_figures(drive, 0.5)[-2:]
    assert last == ["0.333", "0.000"]  # errors of 0, 2 and 6 half widths, the last in a turn
    assert drive_figures(drive._replace(straight=~drive.straight), 0.5)[-1] == "0.333"


def test_intervals_of_shares_are_those_of_clopper_and_pearson():
    low, high = share_interval(0, 200)
    assert (low, high) == (0.0, pytest.approx(1.0 - 0.025 ** (1.0 / 200.0)))
    low, high = share_interval(5, 10)
    assert (low, high) == (pytest.approx(0.187, abs=5e-4), pytest.approx(0.813, abs=5e-4))


def test_drawn_cars_are_as_the_page_describes_them():
    town = in_town(0, crossfall=0.0)
    assert -0.5 <= town.imu_to_rear_axle <= town.car.wheelbase
    assert 90.0 < town.drive.duration < 150.0
    moving = town.drive["vx"] > 3.0
    turn = np.abs(town.drive["yaw_rate"] * town.drive["vx"])[moving]
    assert 1.0 < np.quantile(turn, 0.99) < 3.0
    limit = at_the_limit(0, crossfall=0.0)
    assert 0.0 <= limit.imu_to_rear_axle <= 0.75 * limit.car.wheelbase
    assert np.quantile(np.abs(limit.drive["ay"]), 0.99) > 0.6 * 9.81 * limit.car.friction
    again = at_the_limit(0, crossfall=0.0)
    np.testing.assert_array_equal(again.drive["vy_ref"], limit.drive["vy_ref"])


def test_crossfall_of_drawn_roads_shows_as_gravity_in_ay():
    drive = in_town(0, crossfall=3.0).drive
    level = in_town(0, crossfall=0.0).drive
    road = np.array([draw_crossfall(0, 3.0)(time) for time in drive.time])
    assert 2.0 < np.degrees(np.std(road)) < 3.5
    moving = drive["vx"] > 3.0
    pull, level_pull = ((log["ay"] - log["vx"] * log["yaw_rate"])[moving] for log in (drive, level))
    slope, _ = np.polyfit(9.81 * np.sin(road[moving]), pull - level_pull, 1)
    assert 1.0 < slope < 1.1  # the body rolls too
