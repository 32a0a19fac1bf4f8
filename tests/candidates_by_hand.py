"""Candidates made of points, as a run makes them: on the millimetre grid and in canonical order."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.model import Candidate


def candidate(points: npt.ArrayLike, **fields: Any) -> Candidate:
    """A candidate over the floor 0 with these points, (n, 3) metres; `fields` are further ones of `Candidate`."""
    points = np.rint(np.asarray(points, np.float64).reshape(-1, 3) * 1e3) / 1e3
    points = points[np.lexsort((points[:, 2], points[:, 1], points[:, 0]))]
    values = {
        "building_id": "b",
        "origin": (84_000.0, 447_000.0, 0.0),
        "points": points,
        "ground": np.zeros((0, 3)),
        "ground_z_m": 0.0,
    }
    return Candidate(**(values | fields))
