"""Vectors in registers for compiled code: written like code for one window, run on many at once.

`load` makes a vector of 64 bytes of an array: 16 numbers in float32, 8 in float64 (`width`).
Operators, comparisons, `abs` and the functions below work on it lane by lane, with a number as the
same in every lane; a product and a sum are fused where the processor can, but not of vectors from
`load_unfused`.

    array --load, load_unfused--> vector --operators, choose, root, each--> vector --store--> array
                                                                           --total--> number

Each function below exists twice. Its Python body is what uncompiled code runs, where vectors are
NumPy arrays; beside it a typing rule and a code generator are registered with numba, which write
LLVM instructions for the whole vector. A vector has the type `Lanes` in compiled code. Compiled
loads and stores do not check bounds: whoever allocates an array leaves room behind it for one
vector.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model

VECTOR_BYTES = 64  # size of a vector, in either precision
# flags of LLVM that allow a product and a sum to be contracted to one rounding
_FUSED = ("contract",)


class Lanes(types.Type):  # type: ignore[misc]
    """Type of a vector of numbers, or of truth values.

    Parameters
    ----------
    dtype : Any
        numba type of an element: ``float32``, ``float64`` or ``boolean`` (result of a comparison).
    count : int
        Number of lanes.
    fused : bool, default True
        Whether LLVM may contract a product and a sum to one rounding. It is part of the type, so
        that vectors from `load` and from `load_unfused` do not mix in one operation.
    """

    def __init__(self, dtype: Any, count: int, fused: bool = True) -> None:
        super().__init__(f"lanes({dtype}, {count}, {fused})")
        self.dtype = dtype
        self.count = count
        self.fused = fused


@register_model(Lanes)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    """LLVM's representation of `Lanes`: one vector of floats, doubles or bits."""

    def __init__(self, manager: Any, kind: Lanes) -> None:
        """Receive numba's data model manager and the `Lanes` type to represent."""
        bits = {
            types.float32: ir.FloatType(),
            types.float64: ir.DoubleType(),
            types.boolean: ir.IntType(1),
        }
        super().__init__(manager, kind, ir.VectorType(bits[kind.dtype], kind.count))


def width(array: Any) -> int:
    """Number of lanes of a vector of an array's precision: 16 in float32, 8 in float64."""
    return VECTOR_BYTES // array.itemsize


def load(array: Any, at: int) -> Any:
    """Vector that begins at an index of a contiguous array.

    Parameters
    ----------
    array : Any
        Contiguous array of floats of any shape.
    at : int
        Index of the first element, in the flattened array.

    Returns
    -------
    Any
        `width` elements. Beyond the end of the array uncompiled code reads zeros, and compiled code
        whatever lies there.
    """
    vector = np.zeros(width(array), array.dtype)
    there = array.reshape(-1)[at : at + width(array)]
    vector[: len(there)] = there
    return vector


def load_unfused(array: Any, at: int) -> Any:
    """The same vector, of which products and sums are rounded one by one, as those of numbers.

    Results then have the same digits as those of a loop over single numbers.
    """
    return load(array, at)


def store(array: Any, at: int, vector: Any) -> None:
    """Write a vector to where `load` reads it.

    A number is written to every lane. Compiled code writes a whole vector, also beyond the array's
    end; `store_some` is for arrays without room there.
    """
    array.reshape(-1)[at : at + width(array)] = vector


def store_some(array: Any, at: int, vector: Any, count: int) -> None:
    """Write the first lanes of a vector, ``count`` of them, or all if it has no more.

    It uses LLVM's masked store, so that no memory outside of these lanes is touched.
    """
    count = min(count, width(array))
    array.reshape(-1)[at : at + count] = vector[:count]


def choose(condition: Any, one: Any, other: Any) -> Any:
    """Select lane by lane: ``one`` where the condition is true, else ``other``.

    Parameters
    ----------
    condition : Any
        Vector of truth values, from a comparison.
    one, other : Any
        Vectors or numbers, at least one of them a vector. Both are evaluated in every lane; what is
        not selected may be NaN or infinite without an effect on the result.
    """
    return np.where(condition, one, other)


def least(one: Any, other: Any) -> Any:
    """Smaller value of each lane; compiled, a NaN in ``one`` stays and a NaN in ``other`` is
    ignored.
    """
    return np.minimum(one, other)


def most(one: Any, other: Any) -> Any:
    """Larger value of each lane; compiled, a NaN in ``one`` stays and a NaN in ``other`` is
    ignored.
    """
    return np.maximum(one, other)


def total(vector: Any) -> Any:
    """Sum over the lanes, a number; compiled code may add the lanes in any order."""
    return vector.sum()


def root(vector: Any) -> Any:
    """Square root of each lane; NaN where it is negative."""
    return np.sqrt(vector)


def each(function: Any, vector: Any) -> Any:
    """Apply a function of a number to each lane.

    Parameters
    ----------
    function : Any
        Function of one number; compiled code calls it once a lane, which costs as much as a loop.
        It is for functions without a vector instruction, such as ``math.tan``.
    vector : Any
        Arguments.
    """
    return np.array([function(value) for value in vector], vector.dtype)


def _vector(context: Any, builder: Any, value: Any, kind: Any, wanted: Any) -> Any:
    """A value as a vector: itself, or a number in every lane."""
    if isinstance(kind, Lanes):
        return value
    number = context.cast(builder, value, kind, wanted.dtype)
    first = builder.insert_element(
        ir.Constant(context.get_value_type(wanted), ir.Undefined),
        number,
        ir.Constant(ir.IntType(32), 0),
    )
    mask = ir.Constant(ir.VectorType(ir.IntType(32), wanted.count), [0] * wanted.count)
    return builder.shuffle_vector(first, first, mask)


def _pair(one: Any, other: Any) -> Lanes | None:
    """Type of the vectors that two operands become; none if neither is one."""
    kinds = [kind for kind in (one, other) if isinstance(kind, Lanes)]
    numbers = [kind for kind in (one, other) if isinstance(kind, types.Number)]
    return kinds[0] if len(kinds) + len(numbers) == 2 and kinds and kinds[0] == kinds[-1] else None


def _between(function: Any, write: Any, truth: bool = False) -> None:
    """Let compiled code apply a function of two operands to vectors.

    ``write(builder, one, other, flags)`` writes its LLVM instruction; ``truth``: the result is a
    condition.
    """

    @infer_global(function)
    class _Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            kind = _pair(*args) if len(args) == 2 else None
            return kind and signature(Lanes(types.boolean, kind.count) if truth else kind, *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Write the instruction for two operands, with a number copied to every lane."""
        kind = _pair(*sig.args)
        one, other = (
            _vector(context, builder, value, own, kind)
            for value, own in zip(args, sig.args, strict=True)
        )
        return write(builder, one, other, _FUSED if kind and kind.fused else ())

    for one, other in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(function, one, other)(lower)


for _function, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _between(
        _function,
        lambda builder, one, other, flags, name=_name: getattr(builder, name)(
            one, other, flags=flags
        ),
    )
for _function, _name in ((operator.iadd, "fadd"), (operator.isub, "fsub"), (operator.imul, "fmul")):
    _between(
        _function,
        lambda builder, one, other, flags, name=_name: getattr(builder, name)(
            one, other, flags=flags
        ),
    )
for _function, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _between(
        _function,
        lambda builder, one, other, flags, sign=_sign: builder.fcmp_ordered(sign, one, other),
        truth=True,
    )
# `one` where the two are not ordered, so that a NaN stays
_between(
    least,
    lambda builder, one, other, flags: builder.select(
        builder.fcmp_ordered(">", one, other), other, one
    ),
)
_between(
    most,
    lambda builder, one, other, flags: builder.select(
        builder.fcmp_ordered("<", one, other), other, one
    ),
)


@infer_global(abs)
@infer_global(root)
@infer_global(operator.neg)
class _Own(AbstractTemplate):  # type: ignore[misc]
    """Typing of operations on one vector, whose result is a vector of the same type."""

    def generic(self, args: Any, kws: Any) -> Any:
        """Signature for one argument of the type `Lanes`; None for any other."""
        return signature(args[0], *args) if isinstance(args[0], Lanes) else None


def _by_llvm(name: str) -> Any:
    """Return the code generator of a function of one vector that is an LLVM intrinsic of this
    name.
    """

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Call the intrinsic for the vector's type."""
        own = args[0].type
        return builder.call(
            builder.module.declare_intrinsic(
                f"llvm.{name}.{_name_of(sig.args[0])}", (), ir.FunctionType(own, [own])
            ),
            args,
        )

    return lower


lower_builtin(abs, Lanes)(_by_llvm("fabs"))
lower_builtin(root, Lanes)(_by_llvm("sqrt"))


@lower_builtin(operator.neg, Lanes)  # type: ignore[untyped-decorator]
def _neg(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write LLVM's negation."""
    return builder.fneg(args[0])


def _pointer(context: Any, builder: Any, kind: Any, place: Any, vector: Lanes) -> Any:
    """Return the address of an element of an array, ``place`` = (array, index), as a pointer to
    a vector.
    """
    data = context.make_array(kind)(context, builder, place[0]).data
    return builder.bitcast(
        builder.gep(data, [place[1]]), context.get_value_type(vector).as_pointer()
    )


def _name_of(vector: Lanes) -> str:
    """Return LLVM's suffix of a vector type in names of intrinsics, such as ``v16f32``."""
    return f"v{vector.count}f{vector.dtype.bitwidth}"


def _of(array: Any, fused: bool = True) -> Lanes:
    """Return the type of the vectors of an array type: 64 bytes of its precision."""
    return Lanes(array.dtype, VECTOR_BYTES * 8 // array.dtype.bitwidth, fused)


def _compiled(function: Any, type_of: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of the code generator of one of the functions above.

    ``type_of`` returns the type of the result from those of the arguments.
    """

    @infer_global(function)
    class _Typing(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: Any, kws: Any) -> Any:
            return type_of(*args)

    return lower_builtin(function, types.VarArg(types.Any))  # type: ignore[no-any-return]


@_compiled(width, lambda array: types.intp(array))
def _width(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write the number of lanes as a constant."""
    return context.get_constant(types.intp, _of(sig.args[0]).count)


def _load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write a load that assumes the alignment of one element only, since a vector may begin
    anywhere.
    """
    array = sig.args[0]
    vector = sig.return_type
    return builder.load(
        _pointer(context, builder, array, args, vector), align=array.dtype.bitwidth // 8
    )


_compiled(load, lambda array, at: _of(array)(array, types.intp))(_load)
_compiled(load_unfused, lambda array, at: _of(array, False)(array, types.intp))(_load)


@_compiled(store, lambda array, at, vector: types.none(array, types.intp, vector))
def _store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write a store of a vector, or of a number in every lane, aligned to one element."""
    array = sig.args[0]
    own = _of(sig.args[0])
    value = _vector(context, builder, args[2], sig.args[2], own)
    builder.store(
        value, _pointer(context, builder, array, args, own), align=array.dtype.bitwidth // 8
    )
    return context.get_dummy_value()


@_compiled(
    store_some, lambda array, at, vector, count: types.none(array, types.intp, vector, types.intp)
)
def _store_some(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write a masked store: lane i is written where i < count."""
    array, _, vector, _ = sig.args
    place = _pointer(context, builder, array, args, _of(array))
    lane = ir.IntType(64)
    lanes = vector.count
    splat = builder.insert_element(
        ir.Constant(ir.VectorType(lane, lanes), ir.Undefined),
        args[3],
        ir.Constant(ir.IntType(32), 0),
    )
    splat = builder.shuffle_vector(
        splat, splat, ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    )
    wanted = builder.icmp_signed("<", ir.Constant(splat.type, list(range(lanes))), splat)
    kinds = [args[2].type, place.type, ir.IntType(32), wanted.type]
    name = f"llvm.masked.store.{_name_of(vector)}.p0"
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(ir.VoidType(), kinds), name
    )
    builder.call(
        function, [args[2], place, ir.Constant(ir.IntType(32), array.dtype.bitwidth // 8), wanted]
    )
    return context.get_dummy_value()


@_compiled(
    choose,
    lambda condition, one, other: (kind := _pair(one, other)) and kind(condition, one, other),
)
def _choose(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write LLVM's select, with numbers copied to every lane first."""
    kinds = sig.args[1:]
    return builder.select(
        args[0],
        *(
            _vector(context, builder, v, own, _pair(*kinds))
            for v, own in zip(args[1:], kinds, strict=True)
        ),
    )


@_compiled(total, lambda vector: vector.dtype(vector))
def _total(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write LLVM's reduction, which may reorder the additions (``reassoc``); it begins at -0."""
    number = context.get_value_type(sig.return_type)
    function = ir.FunctionType(number, [number, args[0].type])
    add = builder.module.declare_intrinsic(
        f"llvm.vector.reduce.fadd.{_name_of(sig.args[0])}", (), function
    )
    return builder.call(add, [ir.Constant(number, -0.0), args[0]], fastmath=("reassoc",))


@intrinsic  # type: ignore[untyped-decorator]
def _each(typing: Any, function: Any, vector: Any) -> Any:
    """Intrinsic behind `each`: takes lanes out one by one, calls the function, and puts results
    back.
    """
    own = typing.resolve_function_type(function, (vector.dtype,), {})

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        compute = context.get_function(function, own)
        result = args[1]
        for lane in range(vector.count):
            at = ir.Constant(ir.IntType(32), lane)
            result = builder.insert_element(
                result, compute(builder, [builder.extract_element(args[1], at)]), at
            )
        return result

    return vector(function, vector), lower


overload(least)(
    lambda one, other: None if _pair(one, other) else lambda one, other: min(one, other)
)
overload(most)(lambda one, other: None if _pair(one, other) else lambda one, other: max(one, other))
overload(each, inline="always")(
    lambda function, vector: lambda function, vector: _each(function, vector)
)
