"""A segmentation method that is a function of the test."""

import dataclasses
from collections.abc import Callable
from typing import Any

from pipeline.model import PreparedCloud, Segmentation
from pipeline.parameters import Parameters


@dataclasses.dataclass(frozen=True)
class MethodByHand:
    """Stands in for `pipeline.methods.Method`."""

    name: str
    segment: Callable[[PreparedCloud, Any], Segmentation]
    settings_type: type[Parameters] = Parameters
