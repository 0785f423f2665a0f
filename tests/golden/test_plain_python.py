"""Without compilation, as under a debugger, trainings, estimates and simulated drives have the
numbers of compiled code.
"""

import json
import os
import subprocess
import sys
from functools import partial

import pytest
from golden_numbers import FIXED, Subject, in_folder, moved, simulated

from every_estimator import drive_for, fitted

CAR = {
    "driver": {"grip": 8.0, "top_speed": 60.0, "power_per_mass": 100.0}
}  # which need not be found by driving


def numbers():
    estimator = fitted("ksnn", window=8)
    estimate = estimator.estimate([drive_for(estimator)])[0]
    return {
        "weights": dict(estimator.weights()),
        "estimates": dict(estimate.channels),
        **in_folder(partial(simulated, seconds=0.2, **CAR)),
    }


def record():
    return Subject({"any": "1"}, FIXED, numbers).record()


@pytest.mark.apart
def test_plain_python_gives_the_numbers_of_compiled_code():
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    ran = subprocess.run(
        [sys.executable, __file__], env=environment, capture_output=True, text=True, check=True
    )
    assert not moved("compiled code", record(), json.loads(ran.stdout), FIXED)


if __name__ == "__main__":
    print(json.dumps(record()))
