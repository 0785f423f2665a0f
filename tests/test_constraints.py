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


def test_requirements_are_pinned_to_an_allowed_version_and_to_no_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [
        Requirement(line)
        for line in chain(project["dependencies"], *project["optional-dependencies"].values())
    ]
    pinned = {name.lower().replace("_", "-"): version for name, version in PINNED.items()}
    third_party = [requirement for requirement in requirements if requirement.name != "vehest"]
    assert len(third_party) > 40
    assert not [
        str(requirement)
        for requirement in third_party
        if not requirement.specifier.contains(pinned[requirement.name.lower().replace("_", "-")])
    ]
    assert all(
        re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line)
        for line in LOCK.read_text(encoding="utf-8").split()
    )
    assert not [name for name in PINNED if name.startswith(("nvidia", "cuda", "triton"))]


def test_numerical_libraries_are_installed_as_locked_and_provenance_names_the_lock():
    assert {name: version.partition("+")[0] for name, version in library_versions().items()} == {
        name: PINNED[name] for name in library_versions()
    }
    assert metadata.version("numba") == PINNED["numba"]
    assert provenance()["constraints"] == {"constraints.txt": sha256_of(LOCK)}
