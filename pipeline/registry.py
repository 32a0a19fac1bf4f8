"""What loads when it is used: tables name it as "module:name"."""

from __future__ import annotations

import functools
import importlib
from typing import Any


@functools.cache
def loaded(place: str) -> Any:
    """What a "module:name" names; the module is imported at the first call.

    Examples
    --------
    >>> loaded("math:hypot")(3.0, 4.0)
    5.0
    """
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
