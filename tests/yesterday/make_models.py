"""Made once, before a refactoring: a small model of every family with bands and health, fixed
drives, and its estimates of them.

Models in cars must stay usable. test_yesterdays_models.py compares; this script is run again only
for a family that is new: ``PYTHONPATH=tests:src python tests/yesterday/make_models.py FAMILY...``.
It leaves folders that are there as they are.
"""

import sys
from pathlib import Path

from conftest import planar_drive
from every_estimator import drive_for, fitted
from single_track_drive import linear_drive
from small_car_drive import small_car_drive
from vehest.data.store import write_estimate, write_recording
from vehest.estimators.model_files import save_model
from vehest.estimators.registry import estimator_names
from vehest.inference.estimation import estimate_recording
from vehest.trust.calibration import CalibrationRange, learn_trust
from vehest.trust.record import write_trust

FOLDER = Path(__file__).parent
SECONDS = 5.0
PREPARATION = {"method": "polyphase", "transforms": []}


def drive_name(estimator):
    """File of the drive that suits an estimator's channels, at its rate."""
    kind = (
        "small_car"
        if "motor_current" in estimator.channels
        else "steered"
        if "steer" in estimator.channels
        else "planar"
    )
    return f"{kind}_{estimator.settings.rate_hz:g}hz.parquet"


def _drives(estimator):
    """Drives with reference to learn bands, limits and health from."""
    rate = estimator.settings.rate_hz
    if "motor_current" in estimator.channels:
        return small_car_drive(4.0), small_car_drive(4.0, 1)
    if "steer" in estimator.channels:
        return linear_drive(20.0, rate)[0], linear_drive(15.0, rate, seed=1)[0]
    return planar_drive(20.0, rate, noise=0.05), planar_drive(15.0, rate, seed=1, noise=0.05)


def main():
    """Make what is missing."""
    for name in sys.argv[1:] or estimator_names():
        folder = FOLDER / "models" / name
        if folder.exists():
            continue
        estimator = fitted(name)
        folder.mkdir(parents=True)
        save_model(estimator, folder, {"seed": 0, "downsample": PREPARATION})
        learnt, stopped = (
            [CalibrationRange(drive, drive.start_time, "", drive.id)]
            for drive in _drives(estimator)
        )
        trust = learn_trust(estimator, learnt, stopped)
        write_trust(trust, folder)
        drive = drive_for(estimator)
        drive = drive.cut(drive.start_time, drive.start_time + SECONDS)
        path = FOLDER / "drives" / drive_name(estimator)
        path.parent.mkdir(exist_ok=True)
        if not path.exists():
            write_recording(drive, path)
        write_estimate(estimate_recording(estimator, drive, trust), folder / "estimate.parquet")


if __name__ == "__main__":
    main()
