"""Without compilation, as under a debugger, trainings, estimates and simulated drives have the numbers of compiled code."""

import json
import os
import subprocess
import sys

import pytest
from golden_numbers import FIXED, moved, subjects

RECORD = "import json, sys; from golden_numbers import subjects; print(json.dumps(subjects()[sys.argv[1]].record()))"


@pytest.mark.parametrize("name", ["ksnn", "source simulated"])
def test_plain_python_gives_the_numbers_of_compiled_code(name):
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    ran = subprocess.run([sys.executable, "-c", RECORD, name], env=environment, capture_output=True, text=True, check=True)
    assert not moved(name, subjects()[name].record(), json.loads(ran.stdout), FIXED)
