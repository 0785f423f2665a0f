"""Keys forgive: what changes no number leaves every version of the code as it is; what does changes those of its users alone."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from vehest.estimators.registry import estimator_module, estimator_names
from vehest.run import code_version
from vehest.run.code_version import UNCOUNTED, file_of, modules_reached
from vehest.run.train import code_of_training

SOURCES = Path(code_version.__file__).parents[1]


class Package:
    """A copy of vehest's sources, which may be edited; the versions of all trainings as they would be with it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.before = self.versions()

    def file(self, module: str) -> Path:
        """The file of a module, with or without ``vehest.`` before its name."""
        return self.root.joinpath(*module.removeprefix("vehest.").split(".")).with_suffix(".py")

    def edit(self, module: str, old: str, new: str) -> None:
        """Replace what must be there once."""
        text = self.file(module).read_text()
        assert text.count(old) == 1, f"{module} holds {text.count(old)} times {old!r}"
        self.file(module).write_text(text.replace(old, new))

    def versions(self) -> dict[str, str]:
        """Estimator -> version of the code of its training."""
        code_version.forget()
        return {name: code_of_training(estimator_module(name)) for name in estimator_names()}

    def retrained(self) -> set[str]:
        """Estimators whose training has another version than before."""
        after = self.versions()
        return {name for name, version in self.before.items() if after[name] != version}


@pytest.fixture
def package(tmp_path, monkeypatch):
    shutil.copytree(SOURCES, tmp_path / "vehest", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_version, "_ROOT", tmp_path / "vehest")
    yield Package(tmp_path / "vehest")
    code_version.forget()


def test_comments_docstrings_and_layout_retrain_nothing(package):
    kernel = package.file("estimators.kernels.ksnn")
    text = re.sub(r'\A"""[^"]*"""', '"""Quite other words."""', kernel.read_text())
    kernel.write_text(re.sub(r"^(def \w+\()", r"# A comment.\n\n\n\1", text, flags=re.M))
    assert text != kernel.read_text()
    assert package.retrained() == set()


def test_a_new_settings_class_of_one_method_retrains_no_other(package):
    with package.file("estimators.networks.velocity_recurrent").open("a") as stream:
        stream.write("\n\n@dataclass(frozen=True)\nclass LongSequenceSettings(SequenceSettings):\n    sequence_steps: int = 3000\n")
    assert package.retrained() == {"velocity_gru", "velocity_lstm"}


def test_a_changed_default_of_an_identification_retrains_those_who_identify(package):
    package.edit("training.identification", "restarts: int = 5", "restarts: int = 6")
    assert package.retrained() == {"dugoff_ukf", "cnn_ukf", "ensemble_ukf"}


def test_a_renamed_and_moved_module_retrains_nothing(package):
    package.file("estimators.kernels.threads").rename(package.file("training.side_by_side"))
    for file in package.root.rglob("*.py"):
        file.write_text(file.read_text().replace("vehest.estimators.kernels.threads", "vehest.training.side_by_side"))
    assert not package.file("estimators.kernels.threads").exists()
    assert package.retrained() == set()


def test_imports_that_are_sorted_otherwise_or_made_local_retrain_nothing(package):
    luenberger = package.file("estimators.luenberger")
    imports = [line for line in luenberger.read_text().splitlines() if line.startswith("from vehest.")]
    package.edit("estimators.luenberger", "\n".join(imports), "\n".join(reversed(imports)))
    line = "from vehest.training.search import DirectSearchSettings, nelder_mead_over_grid\n"
    package.edit("estimators.luenberger", line, "from vehest.training.search import DirectSearchSettings\n")
    text = luenberger.read_text()
    use = next(found for found in re.finditer(r"^( +)[^\n]*nelder_mead_over_grid\(", text, flags=re.M))
    moved = f"{use.group(1)}from vehest.training.search import nelder_mead_over_grid\n\n"
    luenberger.write_text(text[: use.start()] + moved + text[use.start() :])
    assert package.retrained() == set()


def test_imports_for_type_checkers_do_not_count(package):
    block = "\nfrom typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from vehest.estimators.ksnn import Ksnn\n"
    package.edit("estimators.lstm", "from __future__ import annotations\n", f"from __future__ import annotations\n{block}")
    assert package.retrained() == set()


@pytest.mark.parametrize(
    ("kernel", "users"),
    [
        ("lstm", {"lstm"}),
        ("ksnn", {"ksnn"}),
        ("lanes", {"gru", "lstm", "learned_ukf", "learned_ukf_variant"}),
        ("dugoff_track", {"dugoff_ukf", "cnn_ukf", "ensemble_ukf"}),
    ],
)
def test_a_changed_recursion_retrains_its_users_and_nobody_else(package, kernel, users):
    text = package.file(f"estimators.kernels.{kernel}").read_text()
    plus = next(found for found in re.finditer(r"^ +\w+(?:\[[^\]]*\])? \+?= [^\n\"']* ([+*]) ", text, flags=re.M))
    package.file(f"estimators.kernels.{kernel}").write_text(f"{text[: plus.start(1)]}-{text[plus.end(1) :]}")
    assert package.retrained() == users


def test_the_same_name_from_another_module_counts_though_both_were_imported_before(package):
    package.file("training.one").write_text("def step(x):\n    return x + 1\n")
    package.file("training.two").write_text("def step(x):\n    return x + 2\n")
    imports = "from __future__ import annotations\n"
    both = f"{imports}import vehest.training.one\nimport vehest.training.two\n"
    package.edit("estimators.lstm", imports, f"{both}from vehest.training.one import step\n")
    package.before = package.versions()
    package.edit("estimators.lstm", "training.one import step", "training.two import step")
    assert package.retrained() == {"lstm"}


def test_names_that_are_swapped_on_import_count(package):
    package.file("training.one").write_text("def up(x):\n    return x + 1\n\n\ndef down(x):\n    return x - 1\n")
    imports = "from __future__ import annotations\n"
    package.edit("estimators.lstm", imports, f"{imports}from vehest.training.one import up, down\n")
    package.before = package.versions()
    package.edit("estimators.lstm", "import up, down", "import down as up, up as down")
    assert package.retrained() == {"lstm"}


def test_limits_and_wordings_of_errors_retrain_nothing(package):
    with package.file("data.errors").open("a") as stream:
        stream.write("\n\nclass AnotherError(VehestError):\n    exit_code = 9\n")
    assert package.retrained() == set()


def test_no_estimator_counts_the_training_of_another_kind():
    reached = {name: set(modules_reached([estimator_module(name)])) for name in estimator_names()}
    assert not reached["dugoff_ukf"] & {"vehest.training.sequences", "vehest.estimators.kernels.sample_network"}
    assert not reached["factor_graph"] & {"vehest.training.search", "vehest.training.checkpoints"}
    assert not reached["gru"] & {"vehest.training.sequences", "vehest.training.search", "vehest.estimators.ksnn"}
    assert {"vehest.estimators.kernels.gru", "vehest.training.supervised"} <= reached["gru"]


def test_modules_that_do_not_count_are_there():
    assert all(file_of(name) is not None for name in UNCOUNTED)


def test_the_package_of_a_plug_in_is_followed_without_importing_it(tmp_path, monkeypatch):
    (tmp_path / "plug").mkdir()
    (tmp_path / "plug" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (tmp_path / "plug" / "own.py").write_text("from .core import f\nfrom plug import other\n")
    (tmp_path / "plug" / "other.py").write_text("y = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    versions = set()
    for core in ("def f(): return 1\n", "def f(): return 2\n"):
        (tmp_path / "plug" / "core.py").write_text(core)
        code_version.forget()
        versions.add(code_version.code_version(["plug.own"]))
        assert set(code_version.files_read()) >= {"plug.own", "plug.core", "plug.other"}
    assert len(versions) == 2
    code_version.forget()
