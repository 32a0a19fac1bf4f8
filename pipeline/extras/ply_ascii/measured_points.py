"""What is found out of a file whose header does not tell it: a pass over its points."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.io.file_facts import UNSORTED_CLASSES, FileFacts, PointRecords
from pipeline.io.gps_time import GpsTimeKind, kind_of
from pipeline.io.strays import thinned, typical_bounds


def measured(form: str, pieces: Iterable[PointRecords], **more: Any) -> FileFacts | None:
    """Count, bounds, returns, classes and times of some pieces, with `more` facts; None without any point."""
    low, high, count = np.full(3, np.inf), np.full(3, -np.inf), 0
    earliest, latest, classified, has_returns = np.inf, -np.inf, False, False
    sample = []
    for piece in pieces:
        count += len(piece)
        low, high = np.minimum(low, piece.xyz.min(axis=0)), np.maximum(high, piece.xyz.max(axis=0))
        sample.append(thinned(piece.xyz))
        if piece.gps_time is not None:
            earliest, latest = min(earliest, piece.gps_time.min()), max(latest, piece.gps_time.max())
        if piece.classification is not None:
            classified = classified or not np.isin(piece.classification, UNSORTED_CLASSES).all()
        if piece.return_count is not None:
            has_returns = has_returns or bool((piece.return_count > 1).any())
    if not count:
        return None
    kind, times = GpsTimeKind.NONE, None
    if np.isfinite([earliest, latest]).all():
        times = float(earliest), float(latest)
        kind = kind_of(*times, flagged_as_adjusted=False)
    x_min, y_min, z_min, x_max, y_max, z_max = (float(value) for value in (*low, *high))
    return FileFacts(
        format=form,
        point_count=count,
        bounds=(x_min, y_min, z_min, x_max, y_max, z_max),
        has_returns=has_returns,
        has_classes=bool(classified),
        has_gps_time=kind is not GpsTimeKind.NONE,
        gps_time_kind=kind,
        gps_time_range=None if kind is GpsTimeKind.NONE else times,
        typical_bounds=typical_bounds(sample),
        **more,
    )


def whole(values: npt.NDArray[np.float64], dtype: type[np.integer[Any]]) -> npt.NDArray[Any]:
    """Values as whole numbers of a type, cut to its range; 0 for NaN."""
    return np.clip(np.nan_to_num(values), 0, np.iinfo(dtype).max).astype(dtype)
