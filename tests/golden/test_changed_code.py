"""A kernel's constant that changes fails with the version to raise; code that is only moved and renamed trains nothing anew."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from place import Place

ROOT = Path(__file__).parents[2]
KERNEL = "src/vehest/estimators/kernels/luenberger.py"
GOLDEN = "tests/golden/test_golden_numbers.py::test_numbers_are_those_recorded[luenberger]"


@pytest.fixture
def checkout(tmp_path):
    """Sources that a test may change."""
    shutil.copytree(ROOT / "src", tmp_path / "checkout" / "src", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "checkout" / "conf").symlink_to(ROOT / "conf")
    return tmp_path / "checkout"


def run(checkout, folder, *words):
    environment = os.environ | {"PYTHONPATH": str(checkout / "src")}
    return subprocess.run([sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False)


def change(file, before, after):
    text = file.read_text(encoding="utf-8")
    assert before in text
    file.write_text(text.replace(before, after), encoding="utf-8")


def test_a_constant_changed_in_a_kernel_fails_with_the_version_to_raise(checkout):
    change(checkout / KERNEL, "damping = 1.0 + 2.0 * step", "damping = 1.0 + 2.02 * step")
    tested = run(checkout, ROOT, "-m", "pytest", "-p", "no:cacheprovider", GOLDEN)
    assert tested.returncode == 1
    assert "of luenberger moved: raise Luenberger.version" in tested.stdout


def test_a_module_that_is_split_and_a_function_that_is_renamed_train_nothing_anew(checkout, tmp_path, capsys):
    place = Place(tmp_path, capsys)
    words = ("-m", "vehest", "train", "estimator=luenberger", "training.grid=1", "split=mine", "tracking=none", "--json")
    words = (*words, f"root={place.folder / 'raw'}", f"output={place.folder / 'outputs'}")
    before = run(ROOT, place.folder, *words)
    assert not json.loads(before.stdout)["skipped"]
    kernel = checkout / KERNEL
    split = kernel.with_name("observer.py")
    recursion, entry = kernel.read_text(encoding="utf-8").split("\n\ndef observe(")
    split.write_text(recursion, encoding="utf-8")
    imports = "import math\nimport numpy as np\nfrom vehest.constants import FloatArray\n"
    imports += "from vehest.estimators.kernels.observer import compiled_observer\n\n\n"
    kernel.write_text("from __future__ import annotations\n" + f"{imports}def run_observer({entry}", encoding="utf-8")
    change(checkout / "src" / "vehest" / "estimators" / "luenberger.py", " observe", " run_observer")
    after = run(checkout, place.folder, *words)
    assert json.loads(after.stdout) == {**json.loads(before.stdout), "skipped": True}
