"""What a model says in C is what Python's guarded stepper says, at whatever happens on a bus."""

import numpy as np
import pytest
from exports import FAMILIES, Export, command

from vehest.export.program import TOLERANCES

pytestmark = pytest.mark.export

# its drive has a motor speed that follows vx to more digits than a float has: health sees rounding
NOT_IN_FLOAT = ("learned_ukf",)
# of bands beside faults: Python's own covariances lose digits there, which square roots in C keep
IN_FAULTS = 1e-7


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("faults", [False, True], ids=["vectors", "faults"])
def test_double_agrees_with_python_in_values_and_reasons(tmp_path, family, faults):
    largest, n_different = Export(family, "double", tmp_path).agreement(faults=faults)
    assert largest[:2].max() <= TOLERANCES["double"]
    assert largest[2:].max() <= (IN_FAULTS if faults else TOLERANCES["double"])
    assert n_different == 0


@pytest.mark.parametrize("family", [name for name in FAMILIES if name not in NOT_IN_FLOAT])
def test_float_agrees_to_a_millimetre_a_second_on_the_vectors(tmp_path, family):
    largest, n_different = Export(family, "float", tmp_path).agreement()
    assert largest[:2].max() <= TOLERANCES["float"]
    assert n_different <= 0.01 * len((tmp_path / "expected.csv").read_text().splitlines())


@pytest.mark.parametrize("bus_rate_hz", [100.0, 250.0, 1000.0 / 3.0])
@pytest.mark.parametrize("faults", [False, True], ids=["vectors", "faults"])
def test_the_front_end_passes_on_the_same_rows_at_the_same_samples(tmp_path, bus_rate_hz, faults):
    largest, n_different = Export("kinematic", "double", tmp_path, bus_rate_hz).agreement(
        faults=faults
    )
    assert largest.max() <= TOLERANCES["double"]
    assert n_different == 0


@pytest.mark.parametrize("family", ["kinematic", "dugoff_ukf", "ksnn"])
def test_a_model_that_was_never_calibrated_has_the_limits_of_any_car_and_no_band(tmp_path, family):
    export = Export(family, "double", tmp_path, trusted=False).write()
    assert not (tmp_path / "vehest_health.c").exists()
    export.build("gcc", "-O2")
    export.vectors(faults=True)
    largest, n_different = export.differences(["./main"])
    assert largest[:2].max() <= TOLERANCES["double"]
    assert n_different == 0
    assert np.isnan(np.genfromtxt(tmp_path / "out.csv", delimiter=",", skip_header=1)[:, 2:4]).all()


def test_samples_missing_by_the_clock_equal_calls_of_vehest_missing(
    tmp_path,
):
    export = Export("kalman", "double", tmp_path).write()
    export.build("gcc", "-O2")
    export.vectors()
    rows = (tmp_path / "in.csv").read_text().splitlines()
    (tmp_path / "in.csv").write_text("\n".join([rows[0], *rows[1:200], *rows[210:400]]) + "\n")
    command(["./main", "in.csv", "jumped.csv"], tmp_path)
    gap = [line.split(",")[0] + ",nan" * (len(line.split(",")) - 1) for line in rows[200:210]]
    (tmp_path / "in.csv").write_text(
        "\n".join([rows[0], *rows[1:200], *gap, *rows[210:400]]) + "\n"
    )
    command(["./main", "in.csv", "filled.csv"], tmp_path)
    jumped, filled = (
        (tmp_path / name).read_text().splitlines() for name in ("jumped.csv", "filled.csv")
    )
    assert jumped[:200] + jumped[200:] == filled[:200] + filled[210:]
