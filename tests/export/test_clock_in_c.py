"""A clock fault in C has the same consequences as in Python, at the same call, with the same
reason.
"""

import numpy as np
import pytest
from exports import FAMILIES, Export, drive

from clock_faults import FAULTS, HARMLESS, RATE_FAULTS, faulted_times
from vehest.export.program import TOLERANCES
from vehest.export.vectors import COLUMNS, replayed, table_text
from vehest.trust.clock import CLOCK_STOPPED

pytestmark = [
    pytest.mark.export,
    pytest.mark.filterwarnings("ignore:samples come at"),
]

START = 1.0  # s, of each fault
FAULT_SECONDS = 2.0  # after which the clock resumes


def stamped(export, kind):
    """Write in.csv, a drive whose clock fails for a while, and expected.csv.

    The number of the faulted sample.
    """
    stepper = export.stepper()
    rate = stepper.input_rate_hz
    plain = drive(stepper.estimator, 5, 6.0)
    times = np.arange(0.0, 5.5, 1.0 / rate)
    samples = {
        name: np.interp(times, np.arange(len(plain)) / plain.rate_hz, plain[name])
        for name in stepper.estimator.channels
    }
    first = round(START * rate)
    end = first + round(FAULT_SECONDS * rate)
    wrong = faulted_times(kind, times, first, rate)
    wrong[end:] = times[end:]
    rows = np.column_stack([wrong, *samples.values()])
    (export.folder / "in.csv").write_text(table_text(("time", *samples), rows))
    (export.folder / "expected.csv").write_text(
        table_text(COLUMNS, replayed(stepper, wrong, samples))
    )
    return first


@pytest.mark.parametrize("family", FAMILIES)
def test_every_clock_fault_has_the_same_health_and_reason_as_in_python(tmp_path, family):
    export = Export(family, "double", tmp_path).write()
    export.build("gcc", "-O1")
    for kind in FAULTS + RATE_FAULTS + HARMLESS:
        first = stamped(export, kind)
        largest, n_different = export.differences(["./main"])
        assert largest[:2].max() <= TOLERANCES["double"], kind
        assert n_different == 0, kind
        if kind == "constant":
            out = np.genfromtxt(tmp_path / "out.csv", delimiter=",", skip_header=1)
            calls = round(0.2 * export.stepper().input_rate_hz)
            assert (out[first + calls :, 4][:calls] == 2).all()
            assert (out[first + calls :, 5][:calls] == 10_000 * CLOCK_STOPPED).all()


@pytest.mark.parametrize("kind", FAULTS + RATE_FAULTS + HARMLESS)
def test_behind_the_front_end_clock_faults_agree_too(tmp_path, kind):
    export = Export("kinematic", "double", tmp_path, 250.0).write()
    export.build("gcc", "-O1")
    stamped(export, kind)
    largest, n_different = export.differences(["./main"])
    assert largest.max() <= TOLERANCES["double"]
    assert n_different == 0
