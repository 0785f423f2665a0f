"""Signals of ASAM MDF files, each with the times of its group."""

from __future__ import annotations

from pathlib import Path

from vehest.data.errors import DataError
from vehest.data.limits import check_limit
from vehest.sources.mdf.files import Wanted, names_in_groups, read_measurement
from vehest.sources.signals import Signal
from vehest.sources.surveys.log import Log, RawColumn

MOST_SIGNALS = 2000


def survey_mdf(file: Path) -> Log:
    """What a measurement holds: every signal of numbers whose group has times.

    Raises:
        DataError: it is no such file, is damaged, or is more than the limits allow.
    """
    places = names_in_groups(file)
    check_limit("columns", len(places), f"'{file}' has {len(places)} signals")
    doubled = {name for name, _ in places if sum(name == other for other, _ in places) > 1} if len(places) < MOST_SIGNALS else set()
    columns, skipped = [], []
    groups: dict[int, list[str]] = {}
    for name, group in places:
        groups.setdefault(group, []).append(name)
    for group, names in groups.items():
        wanted = {f"{name} (group {group})" if name in doubled else name: Wanted(name, group) for name in dict.fromkeys(names)}
        found, failed = _read(file, wanted)
        skipped += failed
        for shown, signal in found.items():
            place: dict[str, object] = {"column": wanted[shown].name} | ({"group": group} if wanted[shown].name in doubled else {})
            columns.append(RawColumn(shown, signal.unit, signal.values, place, signal.stamps))
    return Log(file, "mdf", tuple(columns), skipped=tuple(skipped))


def _read(file: Path, wanted: dict[str, Wanted]) -> tuple[dict[str, Signal], list[str]]:
    """Signals together where all can be read, else one after another."""
    try:
        return dict(read_measurement(file, wanted).signals), []
    except DataError as error:
        if len(wanted) == 1:
            return {}, [str(error).removeprefix(f"'{file}': ")]
    found: dict[str, Signal] = {}
    skipped: list[str] = []
    for shown, one in wanted.items():
        own, failed = _read(file, {shown: one})
        found |= own
        skipped += failed
    return found, skipped
