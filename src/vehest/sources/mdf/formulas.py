"""Formulas of conversions, read by a grammar of their own: numbers, X, + - * / ^ and a dozen functions; nothing is ever executed.

sum      = product {("+" | "-") product}
product  = signed {("*" | "/") signed}
signed   = {"+" | "-"} power
power    = atom [("^" | "**") signed]
atom     = number | "X" | "X1" | function "(" sum ")" | "pow" "(" sum "," sum ")" | "(" sum ")"
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from vehest.constants import FloatArray

Formula = Callable[[FloatArray], FloatArray]

LONGEST = 1000  # characters
MOST_OPERATIONS = 60
FUNCTIONS: dict[str, np.ufunc] = {
    "abs": np.abs,
    "acos": np.arccos,
    "arccos": np.arccos,
    "arcsin": np.arcsin,
    "arctan": np.arctan,
    "asin": np.arcsin,
    "atan": np.arctan,
    "ceil": np.ceil,
    "cos": np.cos,
    "cosh": np.cosh,
    "exp": np.exp,
    "floor": np.floor,
    "ln": np.log,
    "log": np.log,
    "log10": np.log10,
    "sin": np.sin,
    "sinh": np.sinh,
    "sqrt": np.sqrt,
    "tan": np.tan,
    "tanh": np.tanh,
}
_TOKEN = re.compile(r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<sign>\*\*|[-+*/^(),]))", re.ASCII)


class FormulaError(Exception):
    """A formula says more than the grammar allows."""


def parse_formula(text: str) -> Formula:
    """A formula as a function of raw values.

    Args:
        text: such as ``0.5 * X1 ^ 2 + sqrt(X1)``; ``X`` and ``X1`` are the raw value, ``log`` is the natural logarithm.

    Raises:
        FormulaError: it holds something else, or is longer than any formula needs to be.
    """
    if len(text) > LONGEST:
        raise FormulaError(f"it is {len(text)} characters long, more than {LONGEST}")
    reader = _Reader(_tokens(text))
    formula = reader.sum()
    if reader.next is not None:
        raise FormulaError(f"'{reader.next}' stands where it should end")
    return formula


def _tokens(text: str) -> list[str]:
    tokens, at, text = [], 0, text.strip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise FormulaError(f"'{text[at]}' is nothing that a formula may hold")
        tokens.append(str(match["number"] or match["name"] or match["sign"]))
        at = match.end()
    return tokens


class _Reader:
    """Recursive descent: a method a line of the grammar."""

    def __init__(self, tokens: list[str]) -> None:
        self.tokens, self.at, self.operations = tokens, 0, 0

    @property
    def next(self) -> str | None:
        return self.tokens[self.at] if self.at < len(self.tokens) else None

    def sum(self) -> Formula:
        left = self.product()
        while self.next in ("+", "-"):
            left = self._pair(np.add if self._take() == "+" else np.subtract, left, self.product())
        return left

    def product(self) -> Formula:
        left = self.signed()
        while self.next in ("*", "/"):
            left = self._pair(np.multiply if self._take() == "*" else np.divide, left, self.signed())
        return left

    def signed(self) -> Formula:
        if self.next not in ("+", "-"):
            return self.power()
        negative, self.operations = self._take() == "-", self.operations + 1
        self._refuse_long()
        inner = self.signed()
        return (lambda x: -inner(x)) if negative else inner

    def power(self) -> Formula:
        base = self.atom()
        if self.next not in ("^", "**"):
            return base
        self._take()
        return self._pair(np.power, base, self.signed())

    def atom(self) -> Formula:
        token = self._take()
        if token == "(":
            inner = self.sum()
            self._expect(")")
            return inner
        if token.upper() in ("X", "X1"):
            return lambda x: x
        if token.lower() == "pow" or token.lower() in FUNCTIONS:
            return self._call(token.lower())
        if token[0].isdigit() or token[0] == ".":
            value = float(token)
            return lambda x: np.full_like(x, value)
        raise FormulaError(f"'{token[:40]}' is neither a number, X, nor a function that formulas may call")

    def _call(self, name: str) -> Formula:
        self._expect("(")
        first = self.sum()
        if name == "pow":
            self._expect(",")
            second = self.sum()
            self._expect(")")
            return self._pair(np.power, first, second)
        self._expect(")")
        self.operations += 1
        self._refuse_long()
        function = FUNCTIONS[name]
        return lambda x: function(first(x))

    def _pair(self, operation: np.ufunc, left: Formula, right: Formula) -> Formula:
        self.operations += 1
        self._refuse_long()
        return lambda x: operation(left(x), right(x))

    def _refuse_long(self) -> None:
        if self.operations > MOST_OPERATIONS:
            raise FormulaError(f"it has more than {MOST_OPERATIONS} operations")

    def _take(self) -> str:
        token = self.next
        if token is None:
            raise FormulaError("it ends in the middle")
        self.at += 1
        if self.at > 4 * MOST_OPERATIONS:
            raise FormulaError(f"it has more than {MOST_OPERATIONS} operations")
        return token

    def _expect(self, token: str) -> None:
        found = self._take()
        if found != token:
            raise FormulaError(f"'{found}' stands where '{token}' belongs")
