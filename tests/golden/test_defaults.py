"""An option with its default is in no key: a default that changes has to raise the version of its
class.
"""

import json
from dataclasses import dataclass

from golden_defaults import FILE, record, subjects, unversioned

RECORDED = json.loads(FILE.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Group:
    width: int = 4


@dataclass(frozen=True)
class Settings:
    step: float = 0.1
    group: Group = Group(width=8)
    optional_group: Group | None = None


@dataclass(frozen=True)
class Longer(Settings):
    added: bool = False


@dataclass(frozen=True)
class ChangedStep(Settings):
    step: float = 0.2
    group: Group = Group()


def test_defaults_are_those_recorded_unless_a_version_was_raised():
    today = subjects()
    assert not unversioned(RECORDED, today), "\n".join(unversioned(RECORDED, today))
    assert today == RECORDED, "options were added or removed, or a version raised: `make golden`"


def test_a_changed_default_names_the_version_to_raise():
    recorded = {"Settings": record("Settings.version", "1", Settings)}
    assert recorded["Settings"]["defaults"] == {
        "step": 0.1,
        "group.width": 8,
        "optional_group": None,
        "optional_group.width (if given)": 4,
    }
    changed = {"Settings": record("Settings.version", "1", ChangedStep)}
    assert unversioned(recorded, changed) == [
        "the default of Settings.step changed from 0.1 to 0.2: "
        "raise Settings.version, then run `make golden`",
        "the default of Settings.group.width changed from 8 to 4: "
        "raise Settings.version, then run `make golden`",
    ]
    assert not unversioned(recorded, {"Settings": record("Settings.version", "2", ChangedStep)})
    assert not unversioned(recorded, {"Settings": record("Settings.version", "1", Longer)})
