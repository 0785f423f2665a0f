"""Declarations of an estimator's settings and fitted numbers: bounds, unit and text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any, ClassVar, TypeVar

from vehest.data.errors import ConfigurationError

# largest magnitude of a setting, in SI units: far beyond what any of them means, far below what
# overflows
MAX_SETTING = 1e12
UNSET: Any = None  # default of a number that has to be given, or else follows from others
MAX_WIDTH = 4096  # largest width of a layer, a window or an ensemble: more would take all memory

T = TypeVar("T")  # type of the setting


@dataclass(frozen=True)
class Declaration:
    """Declaration of a setting, besides its type and default."""

    doc: str  # text on the setting, for people
    unit: str = ""  # SI unit; empty for what has none
    positive: bool = False  # whether it has to be more than 0
    least: float | None = None  # smallest value; None: no such bound
    most: float | None = None  # largest value; None: no such bound
    above: float | None = None  # value that it has to exceed; None: no such bound
    below: float | None = None  # value that it has to stay below; None: no such bound
    # values from which the search for a fitted number starts; empty where it has a closed form
    start: tuple[float, ...] = ()
    box: tuple[float, float] = (0.0, 0.0)  # range within which the search stays
    # channel whose largest absolute value in training multiplies start and box; empty: none
    of_largest: str = ""
    is_fitted: bool = False  # whether the fit determines it unless it is given

    def problem(self, value: Any) -> str:
        """Text on what is wrong with a value, which follows its name; empty if it is valid."""
        if value is None:
            return ""
        if isinstance(value, int | float) and not abs(value) <= MAX_SETTING:
            return f"must be a number of at most {MAX_SETTING:g}, not {value}"
        if self.positive and not value > 0:
            return f"must be positive, not {value}"
        low = self.least if self.least is not None else self.above
        high = self.most if self.most is not None else self.below
        fits_low = low is None or (value >= low if self.least is not None else value > low)
        fits_high = high is None or (value <= high if self.most is not None else value < high)
        if fits_low and fits_high:
            return ""
        if low is not None and high is not None:
            unit = f" {self.unit}" if self.unit else ""
            return f"must lie between {low:g} and {high:g}{unit}, not at {value}"
        if low is not None:
            relation = "at least" if self.least is not None else "more than"
            return f"must be {relation} {low:g}, not {value}"
        relation = "at most" if self.most is not None else "less than"
        return f"must be {relation} {high:g}, not {value}"


def setting(
    default: T,
    doc: str,
    *,
    unit: str = "",
    positive: bool = False,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> T:
    """A dataclass field with its default, text, unit and bounds, as in `Declaration`.

    Type checkers take it for a value of the default's type, as they do `dataclasses.field`: a
    default of another type than the annotation is an error, and the setting is optional in the
    constructor.
    """
    declared = Declaration(doc, unit, positive, least, most, above, below)
    return field(default=default, metadata={"declared": declared})


def fitted(doc: str, **declared: Any) -> Any:
    """A number that the fit determines unless it is given; ``declared`` as in `Declaration`."""
    return field(default=None, metadata={"declared": Declaration(doc, is_fitted=True, **declared)})


def declaration(of: Field[Any]) -> Declaration | None:
    """The declaration of a dataclass's field; None if it was not made by `setting` or `fitted`."""
    declared: Declaration | None = of.metadata.get("declared")
    return declared


@dataclass(frozen=True)
class Group:
    """Settings that belong together; their bounds are checked when they are made.

    Raises
    ------
    ConfigurationError
        A value is out of its bounds.
    """

    group: ClassVar[str] = "estimator"  # name of the group in a configuration, for messages

    def __post_init__(self) -> None:
        for name, declared in self.declarations().items():
            problem = declared.problem(getattr(self, name))
            if problem:
                raise ConfigurationError(f"{self.group}.{name} {problem}")

    @classmethod
    def declarations(cls) -> Mapping[str, Declaration]:
        """Name of a setting -> its declaration."""
        declared = {field_.name: declaration(field_) for field_ in fields(cls)}
        return {name: value for name, value in declared.items() if value is not None}
