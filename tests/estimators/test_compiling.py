"""Compilation that keeps a first training waiting is said beforehand, once, and what it compiles
has the digits of every later run.
"""

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import vehest
from vehest.estimators.kernels import planar_car
from vehest.estimators.kernels.compiling import has_to_compile
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.trust.health import SLOW_KERNEL


def test_learned_filters_compile_until_their_code_is_cached(tmp_path, monkeypatch):
    monkeypatch.setattr(
        planar_car, "_transition", SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path)))
    )
    assert has_to_compile(estimator_class("learned_ukf").slow_kernel)
    assert not has_to_compile(estimator_class("luenberger").slow_kernel)
    (tmp_path / "planar_car._transition-1.py311.nbi").touch()
    os.utime(tmp_path / "planar_car._transition-1.py311.nbi", (0.0, 0.0))
    assert has_to_compile(estimator_class("learned_ukf").slow_kernel)  # of an earlier installation
    (tmp_path / "planar_car._transition-1.py311.nbi").touch()
    assert not has_to_compile(estimator_class("learned_ukf").slow_kernel)
    monkeypatch.setattr(planar_car, "_transition", lambda: None)
    assert not has_to_compile(estimator_class("learned_ukf").slow_kernel)


@pytest.mark.parametrize(
    "module_name",
    sorted(
        {SLOW_KERNEL, *(estimator_class(name).slow_kernel for name in estimator_names())} - {""}
    ),
)
def test_slow_kernels_are_entries_that_are_there(module_name):
    module, _, name = module_name.partition(":")
    assert hasattr(getattr(importlib.import_module(module), name), "stats")


@pytest.mark.apart
@pytest.mark.parametrize("kernels", ["networks", pytest.param("cars", marks=pytest.mark.slow)])
def test_the_process_that_compiles_has_the_digits_of_those_that_read_the_cache(tmp_path, kernels):
    folder = Path(__file__).parent
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(folder), str(folder.parent)]),
    }
    command = [sys.executable, str(folder / "digits.py"), kernels]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert list(tmp_path.rglob("*.nbc"))
    assert first == second


def test_code_with_reordered_sums_is_compiled_in_a_single_way():
    """`fastmath` outside `kernels.compiling` would give the first run different digits."""
    source = Path(vehest.__file__).parent
    decorated = [
        f"{path.relative_to(source)}:{call.lineno}"
        for path in source.rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
        and ast.unparse(call.func) in ("numba.njit", "njit", "numba.jit")
        if any(keyword.arg == "fastmath" for keyword in call.keywords)
    ]
    assert decorated == []
