"""Opening a source by name, simulated drives, and the data sets that are shipped."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from refusals import refusal

from example_package import forget_source, install_source
from vehest.alignment.checks import checks_of_recording
from vehest.configuration.composition import compose_config, missing_keys
from vehest.data.car import CarValues
from vehest.data.errors import ConfigurationError
from vehest.run.ingest import plan_ingest
from vehest.run.versions import code_of
from vehest.simulation.fleet import SensorVariation, variations_from_config, varied
from vehest.simulation.plant.parameters import compiled_parameters, vehicle_from_configuration
from vehest.simulation.sensors.levels import SensorLevels
from vehest.sources.base import (
    car_of,
    kind_of,
    open_source,
    source_class,
    source_names,
)
from vehest.sources.simulated import SimulatedSource

CONF = Path(__file__).parents[2] / "conf"
DATASETS = sorted((CONF / "dataset").glob("*.yaml"))
VEHICLE = yaml.safe_load((CONF / "vehicle" / "bmw_320i_low.yaml").read_text(encoding="utf-8"))


def simulated(**changes):
    drives = [drive("a", 3.0, seed=1), drive("b", 2.5, seed=2)]
    return {
        "name": "sim",
        "source": "simulated",
        "vehicle": VEHICLE,
        "rate_hz": 50,
        "drives": drives,
        **changes,
    }


def drive(name, duration=2.0, **more):
    return {
        "id": name,
        "manoeuvre": {"name": "laps", "course": "handling", "duration": duration},
        **more,
    }


@pytest.mark.parametrize("file", DATASETS, ids=lambda file: file.stem)
def test_every_data_set_that_is_shipped_opens(file):
    config = compose_config("ingest", [f"dataset={file.stem}", "root=elsewhere"])["dataset"]
    assert config["name"] == file.stem
    assert all(config[name] for name in ("licence", "citation"))
    if not missing_keys(config):
        assert open_source(config).name == file.stem


def test_every_source_has_a_module_that_opens_and_an_unknown_one_is_refused_with_those_there_are():
    for name in source_names():
        with pytest.raises(ConfigurationError, match="has no option 'spam'"):
            open_source({"name": "x", "source": name, "spam": 1})
    with pytest.raises(
        ConfigurationError, match="is not one of: can, mdf, revs, rosbag, simulated, tabular"
    ):
        source_class({"name": "x", "source": "revz"})


def test_a_simulated_drive_has_the_asked_length_and_rate_and_is_another_with_another_seed_alone():
    source = open_source(simulated())
    assert source.ids() == ["a", "b"]
    recording = source.read("b")
    assert (recording.id, recording.kind, recording.rate_hz, len(recording)) == (
        "b",
        "simulated",
        50.0,
        125,
    )
    assert {"vx", "yaw_rate", "ax", "ay", "vy_ref"} <= set(recording.channels)
    assert [finding for finding in checks_of_recording(recording) if finding.level == "error"] == []
    np.testing.assert_array_equal(source.read("b")["ay"], recording["ay"])
    other_source = open_source(simulated(drives=[drive("b", 2.5, seed=3)]))
    assert not np.array_equal(other_source.read("b")["ay"], recording["ay"])
    counted = SimulatedSource(simulated(drives=[drive("a", count=3)]))
    assert (counted.ids(), len({counted.seed_of(name) for name in counted.ids()})) == (
        ["a_001", "a_002", "a_003"],
        3,
    )
    assert (kind_of({"source": "simulated"}), kind_of({"source": "tabular"})) == (
        "simulated",
        "real",
    )


def test_of_several_vehicles_each_drive_has_the_one_it_names():
    heavier = {**VEHICLE, "name": "heavier"}
    config = simulated(
        vehicles={"one": VEHICLE, "other": heavier},
        drives=[drive("a", vehicle="one"), drive("b", vehicle="other")],
    )
    del config["vehicle"]
    assert [open_source(config).read(name).vehicle for name in ("a", "b")] == [
        VEHICLE["name"],
        "heavier",
    ]
    with pytest.raises(
        ConfigurationError, match="drive 'a': vehicle 'None' is not one of: one, other"
    ):
        SimulatedSource({**config, "drives": [drive("a")]})


def test_every_car_of_the_fleet_weighs_what_its_parts_weigh_and_differs_at_both_axles():
    dataset = compose_config("ingest", ["dataset=sim_fleet"])["dataset"]
    vehicle = vehicle_from_configuration(dataset["vehicle"])
    vary = variations_from_config(dataset["vary"])
    cars = [compiled_parameters(varied(vehicle, vary, seed)) for seed in range(50)]
    for car in cars:
        assert car.m_s + car.m_uf + car.m_ur == pytest.approx(car.m, abs=1.0)
    for axle in ("tire", "tire_rear"):
        assert np.std([getattr(car, axle).p_ky1 for car in cars]) > 0.5
        assert np.std([getattr(car, axle).p_dy1 for car in cars]) > 0.05
    assert all(car.tire_rear.p_dy1 > 0.99 * car.tire.p_dy1 for car in cars), (
        "the front axle lets go first, or about when the rear one does"
    )


def test_sensors_of_a_fleet_differ_and_references_do_not():
    levels = SensorLevels()
    variation = SensorVariation.from_config({"noise": [2.0, 3.0], "delay": [0.0, 0.0]})
    changed = variation.applied(levels, 3)
    assert 2.0 <= changed.yaw_rate.noise / levels.yaw_rate.noise <= 3.0
    assert (changed.yaw_rate.delay, changed.yaw_rate.offset) == (0.0, levels.yaw_rate.offset)
    assert changed.reference == levels.reference
    assert changed.yaw_rate.noise / levels.yaw_rate.noise != changed.ay.noise / levels.ay.noise


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "real"}, "simulated"),
        (
            {"drives": [drive("a", seed=1, count=2)]},
            "drive 'a': give seed for a single drive, or count, not both",
        ),
        ({"drives": [drive("a"), drive("a")]}, "two drives are called 'a'"),
        (
            {"vary": [{"parameters": ["nope"], "factor": [1, 1]}]},
            "data set 'sim': vary: 'nope' is no parameter",
        ),
        (
            {"drives": [drive("a", count=6_000), drive("b", count=6_000)]},
            "if that is meant, raise it: limits.jobs=NUMBER",
        ),
        (
            {"rate_hz": 1000, "drives": [drive("a", 36_000)]},
            "if that is meant, raise it: limits.samples=NUMBER",
        ),
    ],
    ids=lambda parameter: str(parameter)[:40],
)
def test_a_simulation_that_is_misspelt_or_asks_for_too_much_is_refused_in_one_line(
    changes, message
):
    assert message in refusal(lambda: SimulatedSource(simulated(**changes)), ConfigurationError)


TABLE = {
    "name": "mine",
    "source": "tabular",
    "vehicle": "mine",
    "time": {"column": "time", "unit": "s"},
}


def test_a_data_set_holds_values_of_its_car_and_none_for_those_that_are_not_known():
    assert car_of(TABLE) == CarValues(None, None, None, None)
    values = {"wheelbase": 2.7, "mass": 1500, "cg_to_rear_axle": 1.3, "steering_ratio": 16}
    assert car_of(TABLE | {"car": values}) == CarValues(2.7, 1500.0, 1.3, 16.0)
    assert car_of(TABLE | {"car": {"wheelbase": None, "mass": 900}}) == CarValues(mass=900.0)


def test_the_values_of_a_car_are_scaled_with_its_recordings():
    scale = [{"name": "scale_to_wheelbase", "wheelbase": 0.3, "to": 2.7}]
    car = {"wheelbase": 0.3, "mass": 5, "cg_to_rear_axle": 0.1, "steering_ratio": 2}
    scaled = car_of(TABLE | {"car": car, "transforms": scale})
    assert scaled.wheelbase == pytest.approx(2.7)
    assert scaled.cg_to_rear_axle == pytest.approx(0.9)
    assert (scaled.mass, scaled.steering_ratio) == (None, 2.0)


@pytest.mark.parametrize(
    ("car", "message"),
    [
        ({"wheelbase": 0}, "dataset.car.wheelbase: .* 0.05, not 0"),
        ({"mass": -5}, "dataset.car.mass: .* 0, not -5"),
        ({"steering_ratio": "16:1"}, "steering_ratio must be a positive number, not '16:1'"),
        ({"length": 4.0}, "dataset.car.length is not an option of dataset.car; options: wheelbase"),
        ({"wheelbase": 2.0, "cg_to_rear_axle": 2.0}, r"below the wheelbase \(2 m\), not 2"),
        (2.7, "dataset.car must be a mapping"),
    ],
)
def test_values_that_are_of_no_car_are_refused_with_the_data_set(car, message):
    with pytest.raises(ConfigurationError, match=f"data set 'mine': .*{message}"):
        car_of(TABLE | {"car": car})


def test_a_simulated_data_set_has_the_values_of_its_vehicle_unless_they_vary():
    assert car_of(simulated()).wheelbase == pytest.approx(2.5789, abs=1e-4)
    varied_lengths = [{"parameters": ["a", "b"], "factor": [0.9, 1.1]}]
    varied_car = car_of(simulated(vary=varied_lengths))
    assert (varied_car.wheelbase, varied_car.cg_to_rear_axle) == (None, None)
    assert varied_car.mass == pytest.approx(1093.3, abs=0.1)
    loaded_drive = drive("a", 3.0, payload={"mass": 100})
    assert car_of(simulated(drives=[loaded_drive])).mass is None
    config = compose_config("ingest", ["dataset=sim_tyre_sets"])["dataset"]
    assert car_of(config) == CarValues(0.33, 5.1, 0.15)


def test_the_values_of_the_car_change_no_key_of_an_ingest(tmp_path):
    (tmp_path / "a.csv").write_text("time,vx\n0,1\n0.1,1\n", encoding="utf-8")
    dataset = TABLE | {"path": str(tmp_path), "files": "*.csv"}
    keys = {
        plan_ingest({"dataset": declared, "output": str(tmp_path)}).key
        for declared in (dataset, dataset | {"car": {"wheelbase": 2.4}}, dataset | {"car": None})
    }
    assert len(keys) == 1


@pytest.mark.parametrize(
    ("dataset", "wheelbase"),
    [("ferrari_250lm", 2.4), ("f1tenth_as_full_size", 2.4057), ("dart_as_f1tenth", 0.330859375)],
)
def test_shipped_data_sets_have_the_documented_wheelbase(dataset, wheelbase):
    config = compose_config("ingest", [f"dataset={dataset}", "root=elsewhere"])["dataset"]
    assert car_of(config).wheelbase == pytest.approx(wheelbase, rel=1e-9)


@pytest.fixture
def speeds(tmp_path, monkeypatch):
    """A function that installs the source of another package.

    Its name is forgotten after the test.
    """
    yield partial(install_source, tmp_path / "site", monkeypatch)
    forget_source()


def test_a_source_of_another_package_reads_checks_and_ingests_a_data_set(
    tmp_path, monkeypatch, speeds
):
    speeds()
    assert source_names()[-1] == "speeds"
    assert code_of("ingest", "speeds").endswith(" speeds=7")
    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    declared = {"name": "mine", "source": "speeds", "path": str(tmp_path), "rate_hz": 5}
    declared |= dict.fromkeys(("title", "vehicle", "licence", "citation"), "mine")
    (tmp_path / "conf" / "dataset" / "mine.yaml").write_text(yaml.safe_dump(declared))
    (tmp_path / "lap.txt").write_text("\n".join(f"{10 + 0.1 * k:.1f}" for k in range(50)))
    monkeypatch.chdir(tmp_path)
    config = compose_config("ingest", ["dataset=mine", f"output={tmp_path}/outputs"])
    assert plan_ingest(config).inputs.keys() == {"lap.txt"}
    (recording,) = open_source(config["dataset"]).recordings()
    assert (recording.id, recording.rate_hz, recording.kind) == ("lap", 5.0, "real")
    np.testing.assert_allclose(recording["vx"], 10.0 + 0.1 * np.arange(50))
    message = refusal(lambda: open_source(declared | {"rates": 1}), ConfigurationError)
    assert "source 'speeds' has no option 'rates'" in message


@pytest.mark.parametrize(
    ("content", "message_part"),
    [
        ("raise RuntimeError('no licence')", "RuntimeError: no licence"),
        ("SpeedSource = 3", "no class"),
    ],
)
def test_a_source_of_another_package_that_cannot_be_loaded_is_named(speeds, content, message_part):
    speeds(content)
    message = refusal(lambda: open_source({"name": "x", "source": "speeds"}), ConfigurationError)
    assert "source 'speeds' of another package" in message
    assert message_part in message
