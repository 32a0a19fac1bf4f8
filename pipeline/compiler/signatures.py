"""Signatures of kernels as JSON, so that kernels can be compiled before anything calls them.

| type | written |
| --- | --- |
| number, boolean, none | its name: `"float64"` |
| array | `["float64", 2, "C"]`: items, dimensions, layout; and `"readonly"` where it is |
| record, the item of an array | `{"record": [["x", "<i8"], ...]}`: numpy's description of it |
| tuple | `{"tuple": [...]}` |
| named tuple | `{"class": "module:Name", "fields": [...]}` |
| argument left out | `{"default": value}` |
"""

from __future__ import annotations

import importlib
from typing import Any

import numba
import numpy as np
from numba.np.numpy_support import as_dtype

from pipeline.compiler.kernel import Kernel

types: Any = numba.types


def written(kind: Any) -> Any:
    """A type of numba's as JSON.

    Raises
    ------
    TypeError
        No kernel takes such an argument yet: add it here.
    """
    if isinstance(kind, types.Array):
        return [written(kind.dtype), kind.ndim, kind.layout, *(() if kind.mutable else ("readonly",))]
    if isinstance(kind, types.BaseNamedTuple):
        named = kind.instance_class
        return {"class": f"{named.__module__}:{named.__qualname__}", "fields": [written(one) for one in kind]}
    if isinstance(kind, types.BaseTuple):
        return {"tuple": [written(one) for one in kind]}
    if isinstance(kind, types.Record):
        return {"record": np.lib.format.dtype_to_descr(as_dtype(kind))}
    if isinstance(kind, types.Omitted):
        return {"default": kind.value}
    if isinstance(kind, types.Number | types.Boolean | types.NoneType):
        return str(kind)
    raise TypeError(f"{kind} is written in no way yet")


def read(told: Any) -> Any:
    """The type of numba's that `written` wrote.

    >>> print(read(["float64", 2, "C", "readonly"]), read({"tuple": ["int64", "boolean"]}))
    readonly array(float64, 2d, C) Tuple(int64, bool)
    """
    if isinstance(told, str):
        return getattr(types, {"bool": "boolean"}.get(told, told))
    if isinstance(told, list):
        items, dimensions, layout, *readonly = told
        return types.Array(read(items), dimensions, layout, readonly=bool(readonly))
    if "record" in told:
        return numba.from_dtype(np.lib.format.descr_to_dtype([tuple(field) for field in told["record"]]))
    if "default" in told:
        return types.Omitted(told["default"])
    if "tuple" in told:
        return types.BaseTuple.from_types([read(one) for one in told["tuple"]])
    module, name = told["class"].split(":")
    return types.BaseTuple.from_types(
        [read(one) for one in told["fields"]], getattr(importlib.import_module(module), name)
    )


def kernel_named(name: str) -> Kernel:
    """A kernel by its name, `module:function`.

    Raises
    ------
    AttributeError, ModuleNotFoundError
        There is none of this name any more.
    """
    module, function = name.split(":")
    found: Kernel = getattr(importlib.import_module(module), function)
    return found
