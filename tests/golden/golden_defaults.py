"""Defaults of every class of settings with the version that stands for them; `make golden` records
anew.

Options that have their defaults are in no key, so that a default that changes has to raise a
version.
"""

import json
import sys
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import get_args, get_type_hints

from vehest.artefacts.keys import default_of
from vehest.data.transforms import Preparation
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.evaluation.metrics import Protocol
from vehest.run.evaluate_faults import FaultSettings
from vehest.run.versions import FAULTS, VERSIONS

FILE = Path(__file__).with_name("defaults.json")


def subjects():
    """Class of settings -> its version, with the name under which it is raised, and its
    defaults.
    """
    records = {
        "Protocol": record("VERSIONS['evaluate']", VERSIONS["evaluate"], Protocol),
        "FaultSettings": record("FAULTS", FAULTS, FaultSettings),
        "Preparation": record("VERSIONS['downsample']", VERSIONS["downsample"], Preparation),
    }
    for name in estimator_names():
        family = estimator_class(name)
        if family.__module__.startswith("vehest."):
            version_name = f"{family.__name__}.version"
            records[family.__name__] = record(version_name, family.version, family.settings_type)
            training = family.training_type
            records[training.__name__] = record(
                f"{training.__name__}.version", getattr(training, "version", "1"), training
            )
    return dict(sorted(records.items()))


def record(version_name, version, kind):
    """What defaults.json holds of a class; through JSON, so that it compares with what is read."""
    content = {"version": {version_name: version}, "defaults": defaults_of(kind)}
    return json.loads(json.dumps(content))


def defaults_of(kind):
    """Dotted option -> its default, of groups inside too.

    Those of a group that may be absent end in ``(if given)``.
    """
    hints = get_type_hints(kind)
    defaults = {}
    for option in fields(kind):
        default = default_of(option)
        groups = [inner for inner in get_args(hints[option.name]) if is_dataclass(inner)]
        if is_dataclass(default):
            defaults |= _values(option.name, default)
            continue
        if default is not MISSING:
            defaults[option.name] = default
        for group in groups:
            inside = defaults_of(group)
            defaults |= {f"{option.name}.{key} (if given)": inside[key] for key in inside}
    return defaults


def _values(prefix, settings):
    """Dotted option -> its default."""
    values = {}
    for option in fields(settings):
        name = f"{prefix}.{option.name}"
        value = getattr(settings, option.name)
        values |= _values(name, value) if is_dataclass(value) else {name: value}
    return values


def unversioned(recorded, now):
    """Complaints about defaults that are not those recorded although the version is.

    An added or removed option is none.
    """
    complaints = []
    for name in sorted(recorded.keys() & now.keys()):
        if recorded[name]["version"] != now[name]["version"]:
            continue
        then = recorded[name]["defaults"]
        today = now[name]["defaults"]
        (version,) = now[name]["version"]
        complaints += [
            f"the default of {name}.{option} changed from {then[option]!r} to {today[option]!r}: "
            f"raise {version}, then run `make golden`"
            for option in then
            if option in today and then[option] != today[option]
        ]
    return complaints


def main():
    """Record today's defaults, unless a version has to be raised first."""
    former = json.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}
    today = subjects()
    if complaints := unversioned(former, today):
        sys.exit("\n".join(complaints))
    FILE.write_text(json.dumps(today, indent=1) + "\n", encoding="utf-8")
    print(f"{FILE.name}: {'as before' if former == today else 'recorded'}")


if __name__ == "__main__":
    main()
