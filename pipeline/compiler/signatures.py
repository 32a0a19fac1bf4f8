"""Signatures of kernels as JSON, used to compile kernels before anything calls them.

| type | JSON |
| --- | --- |
| number, boolean, none | its name: `"float64"` |
| array | `["float64", 2, "C"]`: items, dimensions, layout; then `"readonly"` if it is |
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

types: Any = numba.types


def to_json(kind: Any) -> Any:
    """A numba type as JSON; raises TypeError for a type that no kernel takes yet: add it here."""
    if isinstance(kind, types.Array):
        return [to_json(kind.dtype), kind.ndim, kind.layout, *(() if kind.mutable else ("readonly",))]
    if isinstance(kind, types.BaseNamedTuple):
        named = kind.instance_class
        return {"class": f"{named.__module__}:{named.__qualname__}", "fields": [to_json(one) for one in kind]}
    if isinstance(kind, types.BaseTuple):
        return {"tuple": [to_json(one) for one in kind]}
    if isinstance(kind, types.Record):
        return {"record": np.lib.format.dtype_to_descr(as_dtype(kind))}
    if isinstance(kind, types.Omitted):
        return {"default": kind.value}
    if isinstance(kind, types.Number | types.Boolean | types.NoneType):
        return str(kind)
    raise TypeError(f"{kind} has no JSON form yet")


def from_json(document: Any) -> Any:
    """The numba type that `to_json` wrote.

    >>> print(from_json(["float64", 2, "C", "readonly"]), from_json({"tuple": ["int64", "boolean"]}))
    readonly array(float64, 2d, C) Tuple(int64, bool)
    """
    if isinstance(document, str):
        return getattr(types, {"bool": "boolean"}.get(document, document))
    if isinstance(document, list):
        items, dimensions, layout, *readonly = document
        return types.Array(from_json(items), dimensions, layout, readonly=bool(readonly))
    if "record" in document:
        return numba.from_dtype(np.lib.format.descr_to_dtype([tuple(field) for field in document["record"]]))
    if "default" in document:
        return types.Omitted(document["default"])
    if "tuple" in document:
        return types.BaseTuple.from_types([from_json(one) for one in document["tuple"]])
    module, name = document["class"].split(":")
    return types.BaseTuple.from_types(
        [from_json(one) for one in document["fields"]], getattr(importlib.import_module(module), name)
    )
