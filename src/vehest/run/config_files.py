"""Where configuration files are and which choices they offer; imports nothing heavy, so that help and completion are quick."""

from __future__ import annotations

from pathlib import Path

GROUPS = ("dataset", "split", "vehicle", "estimator", "training", "fault", "tracking")


def packaged_conf() -> Path:
    """The conf folder that came with vehest: inside the installed package, or beside src in a checkout."""
    return _packaged("conf")


def papers_conf() -> Path:
    """The conf folder of the papers' studies: splits that one of them alone uses."""
    return Path(__file__).resolve().parents[2] / "vehest_papers" / "conf"


def conf_folders() -> list[Path]:
    """Where configuration files are looked for, the first one first: ./conf, the packaged folder, that of the papers' studies."""
    return [folder for folder in (local_conf(), packaged_conf(), papers_conf()) if folder is not None]


def packaged_pipelines() -> Path:
    """The pipelines folder that came with vehest."""
    return _packaged("pipelines")


def local_conf() -> Path | None:
    """./conf, which is searched first, if there is one and it is not the packaged folder itself."""
    folder = Path("conf")
    if not folder.is_dir() or folder.resolve() == packaged_conf().resolve():
        return None
    return folder


def choices(group: str) -> list[str]:
    """Names that a group offers, from all folders together."""
    return sorted({file.stem for folder in conf_folders() for file in (folder / group).glob("*.yaml")})


def summary(group: str, choice: str) -> str:
    """The first comment line of a choice's file, which says in a sentence what it is."""
    for folder in conf_folders():
        file = folder / group / f"{choice}.yaml"
        if file.is_file():
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                if line.startswith("#") and "@package" not in line:
                    return line.lstrip("# ").rstrip()
                if line and not line.startswith("#"):
                    break
    return ""


def is_simulated(dataset: str) -> bool:
    """Whether a data set's file says that it is simulated."""
    for folder in conf_folders():
        file = folder / "dataset" / f"{dataset}.yaml"
        if file.is_file():
            return "\nsource: simulated\n" in file.read_text(encoding="utf-8", errors="replace")
    return False


def is_file_name(word: str) -> bool:
    """Whether a word is no override; a file that is there may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


def find_pipeline(name: str) -> Path | None:
    """A pipeline by path or by name: as given, then ./pipelines, then the packaged ones."""
    given = Path(name)
    if given.is_file():
        return given
    stem = given.name.removesuffix(".yaml")
    for folder in (Path("pipelines"), packaged_pipelines()):
        file = folder / f"{stem}.yaml"
        if file.is_file():
            return file
    return None


def pipeline_names() -> list[str]:
    """Names of the pipelines in ./pipelines and in the package."""
    folders = (Path("pipelines"), packaged_pipelines())
    return sorted({file.stem for folder in folders for file in folder.glob("*.yaml")})


def _packaged(name: str) -> Path:
    package = Path(__file__).resolve().parents[1]
    inside = package / name
    return inside if inside.is_dir() else package.parents[1] / name
