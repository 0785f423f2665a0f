"""Compilation that keeps a first training waiting is said beforehand, once."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from vehest.estimators.kernels import planar_car
from vehest.stages.compiling import has_to_compile


def test_a_learned_filter_has_to_compile_until_its_code_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planar_car, "_transition", SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path))))
    assert has_to_compile("learned_ukf")
    assert not has_to_compile("luenberger")
    (tmp_path / "planar_car._transition-1.py311.nbi").touch()
    assert not has_to_compile("learned_ukf")
