"""Files of conf/ and pipelines/, the choices they offer; without Hydra, so that it is quick."""

from __future__ import annotations

from pathlib import Path

GROUPS = ("dataset", "split", "vehicle", "estimator", "training", "fault", "tracking")


def packaged(name: str) -> Path:
    """A folder that came with vehest, ``conf`` or ``pipelines``: inside the installed package, or beside src in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / name
    return inside if inside.is_dir() else package.parents[1] / name


def conf_folders() -> list[Path]:
    """Folders of configuration, the first one searched first: ./conf, if there is one, the packaged folder, that of the papers' studies."""
    local = Path("conf")
    ours = packaged("conf")
    own = [local] if local.is_dir() and local.resolve() != ours.resolve() else []
    return [*own, ours, Path(__file__).resolve().parents[2] / "vehest_papers" / "conf"]


def choices(group: str) -> list[str]:
    """Names that a group offers, from all folders together."""
    return sorted(
        {file.stem for folder in conf_folders() for file in (folder / group).glob("*.yaml")}
    )


def is_file_name(word: str) -> bool:
    """Whether a word is no override; an existing file may have an ``=`` in its name."""
    return ("=" not in word and not word.startswith("~")) or Path(word).is_file()


def find_pipeline(name: str) -> Path | None:
    """A pipeline by path or by name: as given, then ./pipelines, then the packaged ones."""
    given = Path(name)
    file = f"{given.name.removesuffix('.yaml')}.yaml"
    return next(
        (
            path
            for path in (given, Path("pipelines") / file, packaged("pipelines") / file)
            if path.is_file()
        ),
        None,
    )


def pipeline_names() -> list[str]:
    """Names of the pipelines in ./pipelines and in the package."""
    return sorted(
        {
            file.stem
            for folder in (Path("pipelines"), packaged("pipelines"))
            for file in folder.glob("*.yaml")
        }
    )
