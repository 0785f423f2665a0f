"""Files of conf/ and pipelines/ and the choices they offer; imports nothing heavy, so that help and completion are quick."""

from __future__ import annotations

from itertools import takewhile
from pathlib import Path

GROUPS = ("dataset", "split", "vehicle", "estimator", "training", "fault", "tracking")


def packaged_conf() -> Path:
    """The conf folder that came with vehest."""
    return _packaged("conf")


def papers_conf() -> Path:
    """The conf folder of the papers' studies: splits that one of them alone uses."""
    return Path(__file__).resolve().parents[2] / "vehest_papers" / "conf"


def packaged_pipelines() -> Path:
    """The pipelines folder that came with vehest."""
    return _packaged("pipelines")


def _packaged(name: str) -> Path:
    """A folder inside the installed package, or beside src in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / name
    return inside if inside.is_dir() else package.parents[1] / name


def local_conf() -> Path | None:
    """./conf, if there is one and it is not the packaged folder itself."""
    folder = Path("conf")
    return folder if folder.is_dir() and folder.resolve() != packaged_conf().resolve() else None


def conf_folders() -> list[Path]:
    """Folders of configuration, the first one searched first: ./conf, the packaged folder, that of the papers' studies."""
    return [folder for folder in (local_conf(), packaged_conf(), papers_conf()) if folder is not None]


def conf_text(name: str) -> str:
    """The text of a file by its path below conf/, from the first folder that has it; empty where none has."""
    file = next((folder / name for folder in conf_folders() if (folder / name).is_file()), None)
    return "" if file is None else file.read_text(encoding="utf-8", errors="replace")


def choices(group: str) -> list[str]:
    """Names that a group offers, from all folders together."""
    return sorted({file.stem for folder in conf_folders() for file in (folder / group).glob("*.yaml")})


def summary(group: str, choice: str) -> str:
    """The first comment line of a choice's file, a sentence about it."""
    comments = takewhile(lambda line: not line or line.startswith("#"), conf_text(f"{group}/{choice}.yaml").splitlines())
    return next((line.lstrip("# ").rstrip() for line in comments if line and "@package" not in line), "")


def is_simulated(dataset: str) -> bool:
    """Whether the file of a data set declares it as simulated."""
    return "source: simulated" in conf_text(f"dataset/{dataset}.yaml").splitlines()


def is_file_name(word: str) -> bool:
    """Whether a word is no override; an existing file may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


def find_pipeline(name: str) -> Path | None:
    """A pipeline by path or by name: as given, then ./pipelines, then the packaged ones."""
    given = Path(name)
    file = f"{given.name.removesuffix('.yaml')}.yaml"
    return next((path for path in (given, Path("pipelines") / file, packaged_pipelines() / file) if path.is_file()), None)


def pipeline_names() -> list[str]:
    """Names of the pipelines in ./pipelines and in the package."""
    return sorted({file.stem for folder in (Path("pipelines"), packaged_pipelines()) for file in folder.glob("*.yaml")})
