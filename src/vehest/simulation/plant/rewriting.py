"""The source of CommonRoad's multi-body equations, with a few named places of it changed.

The library's function returns derivatives, and neither the tyres' forces nor a way to replace them at standstill or in
a spin. Instead of writing its 200 lines a second time, its syntax tree is changed where that is needed and compiled
again. Every change must be found in the source as often as expected; a library that reads differently is an error.

- the function also takes ``contact`` and returns the twelve tyre forces;
- its own switch to a kinematic model below 0.1 m/s goes: the plant has regimes of its own (regimes.py);
- wheel velocities that slips are divided by stay at or above SMALLEST_WHEEL_VELOCITY;
- wheel loads stay at or above SMALLEST_LOAD: a wheel that lifts off does not pull at the road;
- rear tyres read their parameters from ``p.tire_rear``;
- the forces of the tyre formulas pass through ``contact_forces``, which the plant binds.

At vx of 0.1 m/s and more, with loads and wheel velocities above the two limits and equal tyres front and rear, the
derivatives are the library's own, bit by bit.
"""

from __future__ import annotations

import ast
import inspect
from collections import Counter
from collections.abc import Callable
from typing import Any

from vehest.data.errors import MissingError

SMALLEST_WHEEL_VELOCITY = 0.5
"""What slips are divided by at least [m/s]; below, a rolling wheel still has no slip, and slip stiffness stays finite."""

SMALLEST_LOAD = 1.0
"""Of a wheel [N]: what is left of it in the air. Tyre formulas divide by the load."""

CONTACT_FORCES = "contact_forces"
WHEELS = ("LF", "RF", "LR", "RR")
FORCES = tuple(f"{force}_{wheel}" for force in ("F_x", "F_y", "F_z") for wheel in WHEELS)
"""The twelve forces in the order in which they are returned, by the library's names."""

_LONGITUDINAL_SLIPS = ("s_lf", "s_rf", "s_lr", "s_rr")
_SLIP_ANGLES = ("alpha_LF", "alpha_RF", "alpha_LR", "alpha_RR")
_EXPECTED = {
    "argument list (x, uInit, p)": 1,
    "switch abs(x[3]) < 0.1": 4,
    "longitudinal slip 1 - a/b": 4,
    "slip angle atan(a/b)": 4,
    "wheel load F_z": 4,
    "rear tyre parameters": 8,
    "last tyre force F_y_RR": 1,
    "return f": 1,
}


def rewritten_source(function: Callable[..., Any], library: str) -> str:
    """Source of the changed function, under its own name, to be executed with the library's globals and CONTACT_FORCES.

    Args:
        function: ``vehiclemodels.vehicle_dynamics_mb.vehicle_dynamics_mb``.
        library: name and version, for messages.

    Raises:
        MissingError: the source is not at hand, or does not read as expected.
    """
    try:
        source = inspect.getsource(function)
    except OSError as error:
        raise MissingError(f"{library}: the source of {function.__name__} is not at hand ({error}); install it as files") from error
    rewriter = _Rewriter()
    tree = ast.fix_missing_locations(rewriter.visit(ast.parse(source)))
    wrong = [f"{what}: {rewriter.found[what]} instead of {times}" for what, times in _EXPECTED.items() if rewriter.found[what] != times]
    if wrong:
        raise MissingError(
            f"{library}: {function.__name__} does not read as the simulation expects ({'; '.join(wrong)}); "
            f"install commonroad-vehicle-models==3.0.2"
        )
    return ast.unparse(tree)


class _Rewriter(ast.NodeTransformer):
    def __init__(self) -> None:
        self.found: Counter[str] = Counter()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        if [argument.arg for argument in node.args.args] == ["x", "uInit", "p"]:
            self.found["argument list (x, uInit, p)"] += 1
            node.args.args.append(ast.arg("contact"))
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> Any:
        if ast.unparse(node.test) != "abs(x[3]) < 0.1":
            return self.generic_visit(node)
        self.found["switch abs(x[3]) < 0.1"] += 1
        kept: list[ast.stmt] = []
        for statement in node.orelse:
            changed = self.visit(statement)
            kept.extend(changed if isinstance(changed, list) else [changed])
        return kept

    def visit_Assign(self, node: ast.Assign) -> Any:
        name = node.targets[0].id if isinstance(node.targets[0], ast.Name) else ""
        if name in _LONGITUDINAL_SLIPS:
            node.value = self._bounded_slip(node.value)
        elif name in _SLIP_ANGLES:
            node.value = _BoundedSlipAngle(self.found).visit(node.value)
        elif name in FORCES[8:]:
            self.found["wheel load F_z"] += 1
            node.value = _call("max", node.value, ast.Constant(SMALLEST_LOAD))
        self.generic_visit(node)
        if name == "F_y_RR":
            self.found["last tyre force F_y_RR"] += 1
            return [node, _contact_statement()]
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        wheels = {argument.id[-2:].upper() for argument in node.args if isinstance(argument, ast.Name)}
        if wheels & {"LR", "RR"}:
            for position, argument in enumerate(node.args):
                if ast.unparse(argument) == "p.tire":
                    self.found["rear tyre parameters"] += 1
                    node.args[position] = ast.parse("p.tire_rear", mode="eval").body
        return self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> ast.AST:
        if node.value is not None and ast.unparse(node.value) == "f":
            self.found["return f"] += 1
            node.value = ast.parse(f"(f, ({', '.join(FORCES)}))", mode="eval").body
        return node

    def _bounded_slip(self, value: ast.expr) -> ast.expr:
        """1 - a/b above the limit, (b - a)/limit below: what both are at the limit itself."""
        match value:
            case ast.BinOp(ast.Constant(1), ast.Sub(), ast.BinOp(rolling, ast.Div(), velocity)):
                self.found["longitudinal slip 1 - a/b"] += 1
                b = ast.unparse(velocity)
                below = f"({b} - {ast.unparse(rolling)}) / {SMALLEST_WHEEL_VELOCITY}"
                return ast.parse(f"{ast.unparse(value)} if {b} > {SMALLEST_WHEEL_VELOCITY} else {below}", mode="eval").body
        return value


class _BoundedSlipAngle(ast.NodeTransformer):
    def __init__(self, found: Counter[str]) -> None:
        self.found = found

    def visit_Call(self, node: ast.Call) -> ast.AST:
        match node:
            case ast.Call(ast.Attribute(ast.Name("math"), "atan"), [ast.BinOp(_, ast.Div(), velocity) as quotient]):
                self.found["slip angle atan(a/b)"] += 1
                quotient.right = _call("max", velocity, ast.Constant(SMALLEST_WHEEL_VELOCITY))
        return node


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def _contact_statement() -> ast.stmt:
    changed = ", ".join(FORCES[:8])
    return ast.parse(f"{changed} = {CONTACT_FORCES}(contact, x, u, p, {', '.join(FORCES)})").body[0]
