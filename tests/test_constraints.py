"""The lock of versions: what is installed is what it says, and published results name it."""

import re
import tomllib
from importlib import metadata
from itertools import chain
from pathlib import Path

from packaging.requirements import Requirement

from vehest.artefacts.artefact import library_versions, provenance
from vehest.data.files import sha256_of

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "constraints.txt"
PINNED = dict(line.split("==") for line in LOCK.read_text(encoding="utf-8").split())


def test_what_pyproject_asks_for_is_pinned_to_one_version_that_it_allows_and_no_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = [
        Requirement(line)
        for line in chain(project["dependencies"], *project["optional-dependencies"].values())
    ]
    pinned = {name.lower().replace("_", "-"): version for name, version in PINNED.items()}
    others = [own for own in asked if own.name != "vehest"]
    assert len(others) > 40
    assert not [
        str(own)
        for own in others
        if not own.specifier.contains(pinned[own.name.lower().replace("_", "-")])
    ]
    assert all(
        re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line)
        for line in LOCK.read_text(encoding="utf-8").split()
    )
    assert not [name for name in PINNED if name.startswith(("nvidia", "cuda", "triton"))]


def test_libraries_that_numbers_depend_on_are_installed_as_locked_and_provenance_names_the_lock():
    assert {name: version.partition("+")[0] for name, version in library_versions().items()} == {
        name: PINNED[name] for name in library_versions()
    }
    assert metadata.version("numba") == PINNED["numba"]
    assert provenance()["constraints"] == {"constraints.txt": sha256_of(LOCK)}
