"""Named tuples of arrays as views of one flat array, in Python and in compiled code.

    fields with shapes + sizes -> views (Python), open_views (compiled)

A field is declared in one place, as ``past_x: Annotated[FloatArray, "order channels"]``: the words are sizes, or numbers. Fields that are
``int`` or ``float`` are scalars, and a field ``every`` holds all that follow it. A kernel receives the flat array, since handing over
eighty arrays one by one takes longer than a row.
"""

from __future__ import annotations

import math
from functools import cache, partial
from itertools import accumulate
from typing import Any, get_args, get_type_hints

import numpy as np
from numba import config, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from vehest.constants import FloatArray

SCALARS = {int: np.int64, float: np.float64}


@cache
def _fields(kind: Any) -> dict[str, Any]:
    """Field -> a named tuple, or data type and shape, which is None of a scalar."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if hasattr(hint, "_fields"):
            found[name] = hint
        elif hint in SCALARS:
            found[name] = SCALARS[hint], None
        else:
            array, shape = get_args(hint)
            found[name] = np.float64 if array == FloatArray else np.int64, shape.split()
    return found


def views(kind: Any, flat: FloatArray, sizes: Any, begin: int = 0) -> tuple[Any, int]:
    """Views of a flat array from ``begin`` on, scalars as arrays without dimensions, and the place behind the last."""
    found = {}
    for name, own in _fields(kind).items():
        if hasattr(own, "_fields"):
            found[name], begin = views(own, flat, sizes, begin)
            continue
        dtype, words = own
        shape = [int(word) if word.isdigit() else getattr(sizes, word) for word in words or ()]
        end = begin + math.prod(shape)
        found[name] = flat[begin:end].view(dtype).reshape(shape)
        begin = begin if name == "every" else end
    return kind(**found), begin


def allocated(kind: Any, sizes: Any) -> FloatArray:
    """A flat array of zeros for a named tuple."""
    return np.zeros(views(kind, np.broadcast_to(0.0, 1 << 40), sizes)[1])


@intrinsic
def open_views(typing_context, kind, flat, sizes):  # type: ignore[no-untyped-def]
    """`views` from the first number on, compiled: without references, so that the flat array has to outlive them."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        whole = partial(context.get_constant, types.intp)
        data = builder.bitcast(make_array(flat)(context, builder, values[1]).data, context.get_value_type(types.voidptr))
        place = whole(0)  # in bytes

        def length(word: str) -> Any:
            return whole(int(word)) if word.isdigit() else builder.extract_value(values[2], sizes.fields.index(word))

        def opened(own: Any) -> Any:
            nonlocal place
            found = []
            for (name, declared), of in zip(_fields(own.instance_class).items(), own, strict=True):
                if isinstance(of, types.BaseTuple):
                    found.append(opened(of))
                    continue
                array = make_array(of)(context, builder) if isinstance(of, types.Array) else None
                element = context.get_value_type(of.dtype if array else of).as_pointer()
                pointer = builder.bitcast(builder.gep(data, [place]), element)
                shape = [length(word) for word in declared[1] or ()]
                strides = list(accumulate(reversed(shape), builder.mul, initial=whole(8)))
                if array:
                    populate_array(array, pointer, shape, strides[-2::-1], whole(8), None)
                found.append(array._getvalue() if array else builder.load(pointer))
                if name != "every":
                    place = builder.add(place, strides[-1])
            return context.make_tuple(builder, own, found)

        return opened(signature.return_type)

    return _compiled_type(kind.instance_class)(kind, flat, sizes), code


def _compiled_type(kind: Any) -> Any:
    """Type of a named tuple in compiled code."""

    def of(own: Any) -> Any:
        if hasattr(own, "_fields"):
            return _compiled_type(own)
        scalar = types.int64 if own[0] is np.int64 else types.float64
        return scalar if own[1] is None else types.Array(scalar, len(own[1]), "C")

    return types.BaseTuple.from_types([of(own) for own in _fields(kind).values()], kind)


if config.DISABLE_JIT:

    def open_views(kind: Any, flat: FloatArray, sizes: Any) -> Any:
        """`views` from the first number on, in plain Python."""
        return views(kind, flat, sizes)[0]
