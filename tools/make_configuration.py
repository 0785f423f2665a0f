"""Write the settings in conf/estimator and conf/training as the classes declare them: key, default, text, unit, values and bounds.

The head of a file, up to and including the line of its name, is written by hand: what it is, and what Hydra composes it of. Run by
``make reference``; tests/test_docs.py checks that the files are up to date.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from vehest.run.setting_lines import as_commented_yaml, setting_lines

CONF = Path(__file__).resolve().parents[1] / "conf"
NAME = re.compile(r"^ *name: .*\n", re.MULTILINE)
TRAINING = re.compile(r"override /training: (\w+)")
COMPOSED = re.compile(r"^  - \w+@(\w+)", re.MULTILINE)
DEFAULT_TRAINING = "supervised"
NOT_USED = {"identification": {"curves_from"}}
"""Training -> settings that it inherits and that its estimators do not read."""


def files() -> dict[Path, str]:
    """Every file of conf/estimator and conf/training with settings of a class, by its path: what it should hold."""
    from vehest.estimators.registry import estimator_class

    contents = {}
    for file in sorted((CONF / "estimator").glob("*.yaml")):
        head = _head(file)
        kind = estimator_class(file.stem)
        indent = "  " if "\nestimator:\n" in head else ""
        contents[file] = head + "".join(
            as_commented_yaml(setting_lines(kind.settings_type()), indent)
        )
        named = TRAINING.search(head)
        training = CONF / "training" / f"{named[1] if named else DEFAULT_TRAINING}.yaml"
        contents[training] = _training(training, kind.training_type())
    composed = CONF / "training" / "identification.yaml"
    from vehest.training.noise_tuning import IdentificationSettings

    contents[composed] = _training(composed, IdentificationSettings())
    return contents


def _training(file: Path, settings: Any) -> str:
    head = _head(file)
    skipped = {*COMPOSED.findall(head), *NOT_USED.get(file.stem, ())}
    return head + "".join(as_commented_yaml(setting_lines(settings, skipped)))


def _head(file: Path) -> str:
    """What is written by hand."""
    text = file.read_text(encoding="utf-8")
    name = NAME.search(text)
    assert name is not None, f"'{file}' has no name"
    return text[: name.end()]


def main() -> None:
    """Write the files that have changed and name them."""
    for path, text in files().items():
        if path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(path.relative_to(CONF.parent))


if __name__ == "__main__":
    main()
