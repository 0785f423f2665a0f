"""Values of a car in its data set: every command uses them, and a band does not depend on the data
set's name.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml

import vehest
from conftest import planar_drive
from vehest.data.car import CarValues
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.data.store import read_estimate
from vehest.estimators.model_files import load_model
from vehest.inference.car_values import CarRecord, Number, adapted, with_car_values
from vehest.inference.models import pretrained_folder
from vehest.run.estimate_summary import describe_use
from vehest.sources.base import car_of
from vehest.trust.record import describe_band, is_other_vehicle, read_trust

TABLE = {
    "source": "tabular",
    "licence": "mine",
    "citation": "none",
    "files": "*.csv",
    "time": {"column": "time", "unit": "s"},
}
UNKNOWN = Number(5.0, 1.0)
RECORD = CarRecord(
    2.2, None, replace(UNKNOWN, value=0.0), UNKNOWN, replace(UNKNOWN, value=0.01), UNKNOWN, {}
)


def write_dataset(name, **options):
    file = Path("conf/dataset") / f"{name}.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(yaml.safe_dump(TABLE | {"name": name} | options), encoding="utf-8")


def write_lap(references=True):
    drive = planar_drive(30.0, 100.0, seed=4, noise=0.02)
    measured = drive if references else drive.without_references()
    measured.to_pandas().to_csv("lap.csv")


@pytest.fixture(scope="module")
def self_calibrating():
    return load_model(pretrained_folder("self_calibrating"))


def settings_after(model, car=None, settings=None, record=None):
    estimator, _, remarks = adapted(model, None, car or CarValues(), settings or {}, record)
    return estimator.settings.wheelbase, estimator.settings.cg_to_rear_axle, " ".join(remarks)


def test_command_line_precedes_record_data_set_and_default(
    self_calibrating,
):
    car = CarValues(wheelbase=2.4, cg_to_rear_axle=1.07)
    record = replace(RECORD, wheelbase=2.2)
    assert settings_after(self_calibrating)[:2] == (2.7, None)
    assert settings_after(self_calibrating, car)[:2] == (2.4, 1.07)
    assert settings_after(self_calibrating, car, record=record)[:2] == (2.2, None)
    assert settings_after(self_calibrating, car, {"wheelbase": 2.9}, record)[:2] == (2.9, None)
    assert settings_after(self_calibrating, car, {"cg_to_rear_axle": 1.2})[:2] == (2.4, 1.2)
    of_the_same_car = replace(RECORD, wheelbase=2.4)
    assert settings_after(self_calibrating, car, record=of_the_same_car)[:2] == (2.4, 1.07)


def test_default_wheelbase_is_remarked_only_without_a_configured_wheelbase(self_calibrating):
    assumed = "the wheelbase is assumed to be 2.7 m"
    assert assumed in settings_after(self_calibrating)[2]
    for arguments in (
        {"car": CarValues(wheelbase=2.4)},
        {"settings": {"wheelbase": 2.7}},
        {"record": RECORD},
    ):
        assert assumed not in settings_after(self_calibrating, **arguments)[2]
    assert (
        "wheelbase 2.4 m: of the data set"
        in settings_after(self_calibrating, CarValues(wheelbase=2.4))[2]
    )


def test_a_model_whose_wheelbase_was_chosen_in_training_keeps_it(self_calibrating):
    trained, _, _ = adapted(self_calibrating, None, CarValues(), {"wheelbase": 3.1})
    assert settings_after(trained, CarValues(wheelbase=2.4, cg_to_rear_axle=1.0))[0] == 3.1


def test_estimate_compare_and_identify_use_the_wheelbase_of_the_data_set(place):
    write_lap()
    write_dataset("small", car={"wheelbase": 0.33})
    write_dataset("unknown_car")
    place.done("estimate", "lap.csv", "dataset=small", "-o", "small.parquet")
    output = place.done("estimate", "lap.csv", "estimator.wheelbase=0.33", "-o", "given.parquet")[1]
    assert "assumed" not in output
    place.done("estimate", "lap.csv", "dataset=unknown_car", "-o", "default.parquet")
    small, configured, default = (
        read_estimate(Path(f"{name}.parquet"))["vy"] for name in ("small", "given", "default")
    )
    np.testing.assert_array_equal(small, configured)
    assert np.abs(small - default).max() > 0.05

    def compared(*words):
        out, _ = place.done("compare", "lap.csv", *words, "-m", "self_calibrating", "--json")
        rows = {row["estimate"]: row["rmse_sideslip"] for row in json.loads(out)["rows"]}
        return rows["self_calibrating"]

    assert compared("dataset=small") == compared("estimator.wheelbase=0.33")
    assert compared("dataset=small") != compared("dataset=unknown_car")
    place.done("identify", "lap.csv", "dataset=small", "-o", "car.yaml")
    assert yaml.safe_load(Path("car.yaml").read_text(encoding="utf-8"))["wheelbase"] == 0.33


def test_null_wheelbase_in_a_training_is_that_of_its_only_car():
    config = {"estimator": {"name": "data_sheet", "wheelbase": None, "cg_to_rear_axle": None}}
    first, second, third = (
        TABLE | {"name": "one", "car": {"wheelbase": wheelbase, "cg_to_rear_axle": rear}}
        for wheelbase, rear in ((2.4, 1.1), (2.4, 1.2), (2.6, 1.2))
    )

    def values(config, *datasets):
        settings = with_car_values(config, map(car_of, datasets))["estimator"]
        return settings["wheelbase"], settings["cg_to_rear_axle"]

    assert values(config, first) == (2.4, 1.1)
    assert values(config, first, second) == (2.4, None)
    assert values(config, first, third) == (None, None)
    configured = {"estimator": {"name": "data_sheet", "wheelbase": 3.0, "cg_to_rear_axle": None}}
    assert with_car_values(configured, [car_of(first)]) is configured
    filter_of = {"name": "self_calibrating", "wheelbase": 2.7, "cg_to_rear_axle": None}
    assert values({"estimator": filter_of}, first) == (2.4, 1.1)  # 2.7 m is its default
    assert values({"estimator": filter_of}, first, third) == (2.7, None)
    assert values({"estimator": filter_of}, TABLE | {"name": "one"}) == (2.7, None)
    assert values({"estimator": filter_of | {"wheelbase": 3.0}}, first) == (3.0, None)
    map_of = {"name": "prior_map", "wheelbase": 2.7, "cg_to_rear_axle": None}
    assert values({"estimator": map_of}, first) == (2.4, 1.1)
    without = {"estimator": {"name": "zero"}}
    assert with_car_values(without, [car_of(first)]) is without


def test_the_steering_ratio_is_aligned_with_the_wheelbase_of_the_data_set(place):
    write_lap()
    write_dataset("unknown_car")
    code, _, err = place("data", "align", "lap.csv", "-e", "steering_ratio", "dataset=unknown_car")
    assert code != 0
    assert "needs the wheelbase [m]: --wheelbase 2.7, or car: {wheelbase: 2.7} in conf" in err


@pytest.fixture(scope="module")
def model():
    """An observer that was calibrated on drives of the vehicle 'planar'."""
    drives = [
        replace(planar_drive(30.0, 100.0, seed=seed, noise=0.02), vehicle="planar")
        for seed in (1, 2)
    ]
    return vehest.train(
        "luenberger", drives[:1], drives[1:], ("training.grid=1", "training.max_evaluations=5")
    )


def test_band_depends_on_the_car_and_not_on_the_name_of_a_data_set(place, model):
    vehest.save_model(model, place.folder / "own")
    write_lap(references=False)
    write_dataset("first")
    write_dataset("second", vehicle="unknown")
    write_dataset("named", vehicle="planar")
    write_dataset("other", vehicle="lorry")

    def band(*words):
        out, _ = place.done("estimate", "own", "lap.csv", *words, "--json")
        result = json.loads(out)
        metadata = json.loads(pq.read_schema("estimate.parquet").metadata[b"vehest"])
        assert metadata["band"] == result["band"]
        read_estimate(Path("estimate.parquet"))
        return result["band_sideslip_deg"]["median"], result["band"]

    alone, basis = band()
    assert basis.startswith("calibrated on recordings of 'planar'")
    assert "assumed to be of the same car" in basis
    for dataset in ("first", "second", "named"):
        assert band(f"dataset={dataset}")[0] == alone
    assert "the same car, by its name" in band("dataset=named")[1]
    doubled, basis = band("dataset=other")
    assert doubled == pytest.approx(2.0 * alone, abs=1e-3)
    assert "this one is of 'lorry', another car: band doubled" in basis
    assert "same_vehicle=true" in basis
    assert band("dataset=other", "same_vehicle=true")[0] == alone
    assert band("same_vehicle=false")[0] == doubled
    code, _, err = place("estimate", "own", "lap.csv", "same_vehicle=maybe")
    assert code != 0
    assert "same_vehicle must be true, false or null, not 'maybe'" in err


def test_the_rules_by_which_a_band_applies(model, tmp_path):
    vehest.save_model(model, tmp_path / "own")
    trust = read_trust(tmp_path / "own")
    unnamed = replace(trust, bands=replace(trust.bands, vehicles=("unknown",)))
    many_cars = replace(trust, bands=replace(trust.bands, vehicles=()))
    assert not is_other_vehicle(trust, "planar")
    assert not is_other_vehicle(trust, "unknown")
    assert is_other_vehicle(trust, "lorry")
    assert not is_other_vehicle(trust, "lorry", same_vehicle=True)
    assert is_other_vehicle(trust, "planar", same_vehicle=False)
    assert not is_other_vehicle(unnamed, "lorry")
    assert not is_other_vehicle(many_cars, "lorry")
    fleet = replace(trust, bands=replace(trust.bands, vehicles=("planar", "van")))
    assert is_other_vehicle(fleet, "unknown"), "a recording without a name is of none of several"
    assert not is_other_vehicle(fleet, "van")
    assert "assumed to be of another car: band doubled" in describe_band(fleet, "unknown")
    assert not is_other_vehicle(replace(trust, bands=None), "lorry", same_vehicle=False)
    assert describe_band(None, "lorry") == ""
    assert describe_band(many_cars, "lorry").endswith("for any car")
    assert "a car without a name" in describe_band(unnamed, "lorry")


def test_settings_are_refused_for_a_model_that_has_none_to_change(model):
    with pytest.raises(ConfigurationError, match="are for the self-calibrating filter"):
        adapted(model, None, CarValues(), {"wheelbase": 2.4})
    assert adapted(model, None, CarValues(wheelbase=2.4), {})[0] is model


def test_the_python_functions_use_the_car_of_a_data_set_as_the_commands_do(place):
    write_lap()
    write_dataset("f1", car={"wheelbase": 0.33})
    place.done("estimate", "lap.csv", "dataset=f1", "-o", "command.parquet")
    expected = read_estimate(Path("command.parquet"))["vy"]
    model = vehest.load_model("self_calibrating")
    for overrides in (["dataset=f1"], ["dataset.car.wheelbase=0.33"]):
        recording = vehest.read_recording("lap.csv", overrides)
        assert recording.car == CarValues(wheelbase=0.33)
        np.testing.assert_array_equal(vehest.estimate(recording, model)["vy"], expected)
    assert model.settings.wheelbase == 2.7, "the caller's model stays as it is"
    stepper = vehest.online(model, car=CarValues(wheelbase=0.33))
    assert stepper.stepper.estimator.settings.wheelbase == 0.33
    unknown = vehest.read_recording("lap.csv")
    with pytest.warns(UserWarning, match="the wheelbase is assumed to be 2.7 m") as warned:
        assumed = vehest.estimate(unknown, model)["vy"]
    with pytest.warns(UserWarning, match="the wheelbase is assumed to be 2.7 m") as warned_online:
        vehest.online(model)
    for warning in (*warned, *warned_online):
        assert warning.filename == __file__, "at the caller's line"
    assert np.abs(assumed - expected).max() > 0.05
    with_reference = replace(unknown, car=CarValues(wheelbase=0.33))
    small = vehest.score(model, with_reference)
    with pytest.warns(UserWarning, match="the wheelbase is assumed"):
        large = vehest.score(model, [unknown])
    assert small["rmse_sideslip"] != large["rmse_sideslip"]
    with pytest.raises(ConfigurationError, match="the recording that it was made of, not 2"):
        vehest.score(vehest.estimate(with_reference, model), [with_reference, unknown])
    with_car = replace(planar_drive(20.0, 100.0, seed=1), car=CarValues(2.4, 1500.0, 1.1))
    trained = vehest.train("data_sheet", [with_car], [with_car])
    assert (trained.settings.wheelbase, trained.settings.cg_to_rear_axle) == (2.4, 1.1)


def test_compare_scores_a_small_car_by_the_wheelbase_of_its_data_set(place):
    write_lap()
    write_dataset("f1", car={"wheelbase": 0.33})
    place.done("estimate", "lap.csv", "dataset=f1", "-o", "mine.parquet")

    def min_speed(*words):
        out, _ = place.done("compare", "lap.csv", "mine.parquet", *words, "--json")
        return json.loads(out)["min_sideslip_speed"]

    small = pytest.approx((0.33 / 2.7) ** 0.5)
    assert min_speed() == 1.0
    assert min_speed("dataset=f1") == small
    assert min_speed("dataset.car.wheelbase=0.33") == small
    assert min_speed("estimator.wheelbase=0.33") == small
    code, _, err = place("compare", "lap.csv", "mine.parquet", "estimator.wheelbase=short")
    assert code == 2
    assert "estimator.wheelbase" in err


def test_an_export_is_of_the_car_of_its_data_set(place):
    write_dataset("f1", car={"wheelbase": 0.33})

    def exported(*words):
        _, err = place.done("export", "self_calibrating", "-o", "c", *words)
        source = Path("c/vehest_method.c").read_text(encoding="utf-8")
        vectors = Path("c/expected.csv").read_text(encoding="utf-8")
        return source + vectors, err

    of_dataset, output = exported("dataset=f1")
    assert "wheelbase 0.33 m: of the data set" in output
    assert of_dataset == exported("dataset.car.wheelbase=0.33")[0]
    assert of_dataset == exported("estimator.wheelbase=0.33")[0]
    default, output = exported()
    assert of_dataset != default
    assert "the wheelbase is assumed to be 2.7 m" in output


def test_a_band_is_doubled_on_a_car_whose_values_are_others(place):
    """Data sets without the car's name, as `vehest new` writes them: values of car decide."""
    car = CarValues(wheelbase=2.7, mass=1500.0)
    drives = [replace(planar_drive(30.0, 100.0, seed=seed, noise=0.02), car=car) for seed in (1, 2)]
    drives = [replace(drive, vehicle="unknown") for drive in drives]
    options = ("training.grid=1", "training.max_evaluations=5")
    vehest.save_model(vehest.train("luenberger", drives[:1], drives[1:], options), "own")
    write_lap(references=False)
    for name, values in {
        "same": {"wheelbase": 2.75, "mass": 1600},
        "no_values": None,
        "ratio_only": {"steering_ratio": 15},
        "f1": {"wheelbase": 0.33},
        "lorry": {"wheelbase": 2.7, "mass": 4000},
    }.items():
        write_dataset(name, **({"car": values} if values else {}))
    write_dataset("named", car={"wheelbase": 0.33}, vehicle="my_f1")

    def band(*words):
        result = json.loads(place.done("estimate", "own", "lap.csv", *words, "--json")[0])
        return result["band_sideslip_deg"]["median"], result["band"]

    alone, basis = band("dataset=same")
    assert "assumed to be of the same car, as neither names nor values of car differ" in basis
    for name in ("no_values", "ratio_only"):
        assert band(f"dataset={name}")[0] == alone
    for name, difference in {
        "f1": "wheelbase 0.33 m, not 2.7 m",
        "lorry": "mass 4000 kg, not 1500 kg",
        "named": "wheelbase 0.33 m, not 2.7 m",
    }.items():
        doubled, basis = band(f"dataset={name}")
        assert doubled == pytest.approx(2.0 * alone, abs=1e-3)
        assert f"another car ({difference}): band doubled" in basis
        assert band(f"dataset={name}", "same_vehicle=true")[0] == alone
    model = vehest.load_model("own")

    def median(overrides, **options):
        estimate = vehest.estimate(vehest.read_recording("lap.csv", overrides), model, **options)
        return np.degrees(np.nanmedian(estimate["band_sideslip"]))

    assert median(["dataset=same"]) == pytest.approx(alone, abs=1e-3)
    assert median(["dataset=f1"]) == pytest.approx(2.0 * alone, abs=1e-3)
    assert median(["dataset=f1"], same_vehicle=True) == pytest.approx(alone, abs=1e-3)

    def exported(*words):
        place.done("export", "own", "-o", "c", *words)
        return Path("c/expected.csv").read_text(encoding="utf-8")

    assert exported("dataset=f1") == exported("--elsewhere") != exported("dataset=same")
    assert exported("dataset=same") == exported()


@pytest.mark.parametrize(
    ("car", "second_car", "difference"),
    [
        (CarValues(2.55), CarValues(2.647), ""),  # two sources on one Volvo V40
        (CarValues(2.7), CarValues(2.9), "wheelbase 2.7 m, not 2.9 m"),
        (CarValues(None, 2000.0), CarValues(2.7, 1500.0), "mass 2000 kg, not 1500 kg"),
        (CarValues(2.7, 1800.0), CarValues(2.7, 1500.0), ""),
        (CarValues(), CarValues(2.7, 1500.0), ""),
    ],
)
def test_cars_differ_by_wheelbase_and_mass_beyond_sources_and_load(car, second_car, difference):
    assert car.difference_to(second_car) == difference


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cg_to_rear_axle": 2.6}, "cg_to_rear_axle must be below the wheelbase (2.6 m), not 2.6"),
        ({"imu_to_rear_axle": -2.7}, r"imu_to_rear_axle .* (-2.6 to 5.2 m), not at -2.7"),
        ({"imu_to_rear_axle": 5.3}, r"imu_to_rear_axle .* (-2.6 to 5.2 m), not at 5.3"),
    ],
)
def test_places_that_no_car_of_this_wheelbase_has_are_refused(values, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        CarValues(wheelbase=2.6, **values)
    CarValues(**values)


def test_the_filter_does_not_use_an_ax_that_was_made_of_the_speed(place):
    write_lap()
    lap = pd.read_csv("lap.csv")
    lap.drop(columns="ax").to_csv("lap.csv", index=False)
    channels = {
        name: {"column": name, "unit": CHANNELS[name].unit}
        for name in lap.columns
        if name not in ("time", "ax")
    }
    write_dataset("without", path=".", channels=channels)
    write_dataset(
        "derived", path=".", channels=channels, transforms=[{"name": "acceleration_from_speed"}]
    )
    estimates = []
    for name in ("without", "derived"):
        options = ("lap.csv", f"dataset={name}", "estimator.wheelbase=2.5")
        code, out, err = place("estimate", *options, "-o", f"{name}.parquet", "--json")
        assert code == 0, err
        assert "no longitudinal acceleration ax is measured" in err
        assert "faults and samples outside" in describe_use(json.loads(out))
        estimates.append(pd.read_parquet(f"{name}.parquet")["vy"].to_numpy())
        record = f"{name}.yaml"
        assert place("identify", *options, "-o", record)[0] == 0
    assert np.array_equal(*estimates)
    assert Path("without.yaml").read_text() == Path("derived.yaml").read_text()
    recording = vehest.read_recording("lap.csv", ["dataset=derived"])
    assert np.array_equal(vehest.estimate(recording, wheelbase=2.5)["vy"], estimates[0])
