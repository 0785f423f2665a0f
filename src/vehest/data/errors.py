"""Errors that a user can act on; each message is one line that names the cause and the remedy.

Functions that read a file raise `MissingError` where it is not there, and `DataError` where it is
damaged, more than the limits or lacks something. Functions that take plain values of a
configuration (``…_from_config``, settings) raise `ConfigurationError`.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches


class VehestError(Exception):
    """Base of all errors caused by input or environment rather than by a defect of vehest.

    Attributes
    ----------
    exit_code
        Status that the command line leaves with (documented in docs/cli.md).
    """

    exit_code = 1


class ConfigurationError(VehestError):
    """An option, override or choice that does not exist, or whose value makes no sense."""

    exit_code = 2


class DataError(VehestError):
    """A file, recording or channel that cannot be used as it is."""

    exit_code = 3


class MissingError(VehestError):
    """Something that should be there is not: a data root, an artefact, an optional package."""

    exit_code = 4


class JobsFailedError(VehestError):
    """Some jobs of a sweep failed; the others were finished and kept."""

    exit_code = 5


def listed(words: Sequence[str]) -> str:
    """Words joined as text: ``a``, ``a and b``, ``a, b and c``."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def counted(names: Sequence[str]) -> str:
    """Text of the number of names and, in brackets, of the first six of them."""
    return f"{len(names)} ({first_of(names, 6)})" if names else "0"


def first_of(names: Sequence[str], max_named: int) -> str:
    """The first of some names, followed by ``…`` where there are more."""
    return ", ".join([*names[:max_named], *["…"] * (len(names) > max_named)])


def number_of(count: int, noun: str) -> str:
    """A number with its noun, of which the plural ends with s: ``1 gap``, ``2 gaps``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def abbreviated(names: Sequence[str], max_named: int) -> str:
    """The first of some names, and the number of the others: ``a, b and 3 more``."""
    n_more = len(names) - max_named
    return ", ".join(names[:max_named]) + (f" and {n_more} more" if n_more > 0 else "")


def closest(name: str, choices: Iterable[str]) -> str:
    """The choice that is spelt most like a name; empty if none is close."""
    return next(iter(get_close_matches(name, list(choices), n=1)), "")


def suggestion(name: str, choices: Iterable[str], prefix: str = "") -> str:
    """Text with what was probably meant by an unknown name, to append to a message.

    Empty if no choice is close.
    """
    close = closest(name, choices)
    return f"; did you mean '{prefix}{close}'?" if close else ""


def unknown_option(family: str, option: str, names: Mapping[str, Sequence[str]]) -> str:
    """Message on an option that a family of estimators does not have, with the one that was
    probably meant.

    Parameters
    ----------
    family : str
        Name of the estimator.
    option : str
        Name of the option without ``estimator.``.
    names : mapping
        Family -> names of its options.

    Returns
    -------
    str
        The error. It suggests the closest option of the family, else the other families that have
        an option of this name but for case and underscores.
    """
    hint = suggestion(option, names.get(family, ()), "estimator.")
    if not hint:
        families = {
            candidate: name
            for candidate, options in names.items()
            for name in options
            if candidate != family and _spelling(name) == _spelling(option)
        }
        if families:
            name = next(iter(families.values()))
            hint = f"; '{name}' is an option of {listed(list(families))};"
    listing = f"'vehest config train estimator={family}' prints the options there are"
    return f"unknown option 'estimator.{option}' of {family}{hint or ';'} {listing}"


def _spelling(name: str) -> str:
    """A name without underscores and in lower case, for comparisons."""
    return name.replace("_", "").lower()


def printable(text: str, keep: str = "") -> str:
    """Text from a file as it can be shown: control characters but those to keep, and bytes that are
    no UTF-8, as escapes.
    """
    return "".join(
        character
        if is_printable(character) or character in keep
        else character.encode("unicode_escape").decode()
        for character in text
    )


def is_printable(character: str) -> bool:
    """Whether a character shows as itself: none that controls a terminal, changes the direction of
    writing, or has no meaning.
    """
    return unicodedata.category(character) not in {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
