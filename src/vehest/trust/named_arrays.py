"""Named tuples of arrays as views of one flat array, in Python and in compiled code.

    fields with shapes + sizes -> views (Python), open_views (compiled)

A field is declared in one place, as ``past_x: Annotated[FloatArray, "order channels"]``: the words
are sizes, or numbers. Fields that are ``int`` or ``float`` are scalars, and a field ``all_values``
holds all that follow it. A kernel receives the flat array, since passing eighty arrays one by
one takes longer than a row.
"""

from __future__ import annotations

import math
from functools import cache, partial, reduce
from itertools import accumulate
from typing import Any, get_args, get_type_hints

import numpy as np
from numba import config, types
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, lower_getattr_generic, models, register_model
from numba.np.arrayobj import make_array, populate_array

from vehest.constants import FloatArray

ALL_VALUES = "all_values"
"""Field that has the values of all fields after it, in one array."""
SCALARS = {int: np.int64, float: np.float64}  # declared type of a scalar field -> data type


@cache
def _fields(kind: Any) -> dict[str, Any]:
    """Fields of a named tuple: name -> another named tuple, or (data type, words of the shape); the
    shape of a scalar is None.
    """
    declared_fields: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if hasattr(hint, "_fields"):
            declared_fields[name] = hint
        elif hint in SCALARS:
            declared_fields[name] = SCALARS[hint], None
        else:
            array, shape = get_args(hint)
            declared_fields[name] = np.float64 if array == FloatArray else np.int64, shape.split()
    return declared_fields


def views(kind: Any, flat: FloatArray, sizes: Any, begin: int = 0) -> tuple[Any, int]:
    """A named tuple of views of a flat array from ``begin`` on, and the index behind the last.

    Scalars are arrays without dimensions.

    Parameters
    ----------
    kind : type
        Named tuple whose fields are declared as in the module.
    flat : array
        float64; integers are views of the same bytes.
    sizes : any
        Object whose attributes are the words of the shapes.
    begin : int
        Place of the first number.
    """
    arrays = {}
    for name, declared in _fields(kind).items():
        if hasattr(declared, "_fields"):
            arrays[name], begin = views(declared, flat, sizes, begin)
            continue
        dtype, words = declared
        shape = [int(word) if word.isdigit() else getattr(sizes, word) for word in words or ()]
        end = begin + math.prod(shape)
        arrays[name] = flat[begin:end].view(dtype).reshape(shape)
        begin = begin if name == ALL_VALUES else end
    return kind(**arrays), begin


def allocated(kind: Any, sizes: Any) -> FloatArray:
    """A flat array of zeros for a named tuple.

    Its length follows from views of an array without memory.
    """
    return np.zeros(views(kind, np.broadcast_to(0.0, 1 << 40), sizes)[1])


class Views(types.Type):  # type: ignore[misc]
    """numba's type of a named tuple of views: where they begin in the flat array, and the sizes.

    Passing all fields would compile a fifth longer.
    """

    def __init__(self, kind: Any, sizes: Any) -> None:
        super().__init__(f"views({kind.__qualname__}, {sizes})")
        self.kind = kind
        self.sizes = sizes


@register_model(Views)
class _Model(models.StructModel):  # type: ignore[misc]
    """LLVM's representation of `Views`: a pointer and the sizes."""

    def __init__(self, manager: Any, view_type: Views) -> None:
        super().__init__(manager, view_type, [("data", types.voidptr), ("sizes", view_type.sizes)])


def _compiled_type(field_type: Any, sizes: Any) -> Any:
    """numba's type of a field: an array, a number, `Views`, or a tuple of numbers for a named tuple
    of scalars.
    """
    if hasattr(field_type, "_fields"):
        inner = [_compiled_type(field, sizes) for field in _fields(field_type).values()]
        return (
            types.BaseTuple.from_types(inner, field_type)
            if set(inner) <= {types.int64, types.float64}
            else Views(field_type, sizes)
        )
    scalar = types.int64 if field_type[0] is np.int64 else types.float64
    return scalar if field_type[1] is None else types.Array(scalar, len(field_type[1]), "C")


@infer_getattr
class _Attributes(AttributeTemplate):  # type: ignore[misc]
    """Typing rule of a field of `Views`."""

    key = Views

    def generic_resolve(self, view_type: Views, name: str) -> Any:
        """Type of the field of this name."""
        return _compiled_type(_fields(view_type.kind)[name], view_type.sizes)


@lower_getattr_generic(Views)  # type: ignore[untyped-decorator]
def _opened_field(context: Any, builder: Any, view_type: Views, value: Any, name: str) -> Any:
    """Write the code of reading a field: its place behind the fields before it, then a view or a
    number. Places are computed from the sizes at run time.
    """
    proxy = context.make_helper(builder, view_type, value)
    integer = partial(context.get_constant, types.intp)

    def lengths(declared: Any) -> list[Any]:
        words = declared[1] or ()
        return [
            integer(int(w))
            if w.isdigit()
            else builder.extract_value(proxy.sizes, view_type.sizes.fields.index(w))
            for w in words
        ]

    def numbers(declared: Any) -> Any:
        """How many a field has."""
        if not hasattr(declared, "_fields"):
            return reduce(builder.mul, lengths(declared), integer(1))
        return reduce(
            builder.add,
            (numbers(inner) for field, inner in _fields(declared).items() if field != ALL_VALUES),
            integer(0),
        )

    fields = _fields(view_type.kind)
    before = [
        numbers(fields[field])
        for field in list(fields)[: list(fields).index(name)]
        if field != ALL_VALUES
    ]
    data = builder.gep(
        proxy.data, [builder.mul(reduce(builder.add, before, integer(0)), integer(8))]
    )
    of = _compiled_type(fields[name], view_type.sizes)
    if not isinstance(of, types.Array):
        return _loaded(context, builder, of, data, proxy.sizes)
    array = make_array(of)(context, builder)
    shape = lengths(fields[name])
    strides = list(accumulate(reversed(shape[1:]), builder.mul, initial=integer(8)))[::-1]
    populate_array(
        array,
        builder.bitcast(data, context.get_value_type(of.dtype).as_pointer()),
        shape,
        strides,
        integer(8),
        None,
    )
    return array._getvalue()


@intrinsic
def open_views(typing_context, kind, flat, sizes):  # type: ignore[no-untyped-def]
    """`views` from the first number on, compiled.

    They have no references, so that the flat array has to outlive them.
    """

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        data = builder.bitcast(
            make_array(flat)(context, builder, values[1]).data,
            context.get_value_type(types.voidptr),
        )
        return _loaded(context, builder, signature.return_type, data, values[2])

    return _compiled_type(kind.instance_class, sizes)(kind, flat, sizes), code


def _loaded(context: Any, builder: Any, of: Any, data: Any, sizes: Any) -> Any:
    """Write the code that reads `Views`, a tuple of numbers or a number at ``data``."""
    if isinstance(of, Views):
        opened = context.make_helper(builder, of)
        opened.data = data
        opened.sizes = sizes
        return opened._getvalue()
    if isinstance(of, types.BaseTuple):
        places = [
            builder.gep(data, [context.get_constant(types.intp, 8 * at)]) for at in range(len(of))
        ]
        return context.make_tuple(
            builder,
            of,
            [
                _loaded(context, builder, inner_type, at, sizes)
                for inner_type, at in zip(of, places, strict=True)
            ],
        )
    return builder.load(builder.bitcast(data, context.get_value_type(of).as_pointer()))


if config.DISABLE_JIT:

    def open_views(kind: Any, flat: FloatArray, sizes: Any) -> Any:
        """`views` from the first number on, in plain Python."""
        return views(kind, flat, sizes)[0]
