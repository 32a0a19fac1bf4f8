"""The decoder of LAZ: what it can raise, and how it is called so that a damaged file ends nothing but its own reading.

lazrs is written in Rust. Where it meets what its authors thought impossible it panics, and Python gets an exception
that is not an `Exception`: it would end the process, or be reported as a fault of gablework.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator

import laspy
import lazrs

DECODING_ERRORS = (lazrs.LazrsError, laspy.LaspyException, ArithmeticError, OSError, ValueError, struct.error)
"""What decoding a damaged file raises within `decoding`."""
_BINDINGS = "pyo3_runtime"
"""Module of the exceptions that stand for panics; it cannot be imported."""


@contextlib.contextmanager
def decoding() -> Iterator[None]:
    """Raise LazrsError in place of a panic of lazrs, and of memory that it cannot get for what the file claims."""
    try:
        yield
    except MemoryError as fault:
        raise lazrs.LazrsError("the file asks for more memory than there is") from fault
    except Exception:
        raise
    except BaseException as fault:
        if type(fault).__module__ != _BINDINGS:
            raise
        raise lazrs.LazrsError(f"the decoder met what cannot be: {fault}") from fault
