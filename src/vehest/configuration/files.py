"""Files of conf/ and pipelines/, the choices they offer; without Hydra, so that it is quick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

# groups of the configuration that offer choices, each a folder of conf/
GROUPS = ("dataset", "split", "vehicle", "estimator", "training", "fault", "tracking")


def packaged(name: str) -> Path:
    """The folder ``conf`` or ``pipelines`` of vehest, in the installed package or beside src."""
    package = Path(__file__).resolve().parents[1]
    inside = package / name
    return inside if inside.is_dir() else package.parents[1] / name


def conf_folders() -> list[Path]:
    """Folders of configuration in the order of their search.

    ./conf, if there is one; the packaged folder; that of the papers' studies.
    """
    local = Path("conf")
    ours = packaged("conf")
    local_folders = [local] if local.is_dir() and local.resolve() != ours.resolve() else []
    return [*local_folders, ours, Path(__file__).resolve().parents[2] / "vehest_papers" / "conf"]


def choices(group: str) -> list[str]:
    """Names of the choices of a group, from all folders together."""
    return sorted(
        {file.stem for folder in conf_folders() for file in (folder / group).glob("*.yaml")}
    )


def is_file_name(word: str) -> bool:
    """Whether a word is no override; an existing file may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


def files_and_overrides(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words of a command line that are files, and those that are overrides."""
    files = [word for word in words if is_file_name(word)]
    return files, [word for word in words if word not in files]


def find_pipeline(name: str) -> Path | None:
    """A pipeline by path or by name: as given, then ./pipelines, then the packaged ones."""
    file = f"{Path(name).name.removesuffix('.yaml')}.yaml"
    candidates = (Path(name), Path("pipelines") / file, packaged("pipelines") / file)
    return next((path for path in candidates if path.is_file()), None)


def pipeline_names() -> list[str]:
    """Names of the pipelines in ./pipelines and in the package."""
    return sorted(
        {
            file.stem
            for folder in (Path("pipelines"), packaged("pipelines"))
            for file in folder.glob("*.yaml")
        }
    )
