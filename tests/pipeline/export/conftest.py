"""Fixtures of the export tests."""

import datetime as dt
from typing import Any

import pytest
import small_buildings as small

from pipeline.export.record_rows import RecordContext, RejectedObject
from pipeline.model import Reason

FOOT_M = 0.3048
US_FOOT_M = 1200.0 / 3937.0


def _reference(epsg: int, **units: float) -> small.Reference:
    """A reference with PROJ's own PROJJSON."""
    pyproj = pytest.importorskip("pyproj")
    return small.Reference(epsg=epsg, projjson=pyproj.CRS.from_epsg(epsg).to_json_dict(), **units)


@pytest.fixture(scope="session")
def references() -> dict[str, small.Reference]:
    """A compound CRS in metres, one in feet with elevations in metres, one wholly in feet, and none at all."""
    return {
        "compound": _reference(7415),
        "feet and metres": _reference(2992, horizontal_unit_m=FOOT_M),
        "US feet": _reference(2225, horizontal_unit_m=US_FOOT_M, vertical_unit_m=US_FOOT_M),
        "unknown": small.Reference(),
    }


@pytest.fixture(scope="session")
def contexts(references: dict[str, small.Reference]) -> dict[str, RecordContext]:
    """A context a reference."""
    facts: dict[str, Any] = {
        "settings_hash": "0f" * 32,
        "engine_version": "0.1.0",
        "acquired_from": dt.datetime(2014, 3, 1, 10, 0, 0, 125, tzinfo=dt.UTC),
        "acquired_to": dt.datetime(2014, 3, 1, 11, tzinfo=dt.UTC),
    }
    return {name: RecordContext(reference=reference, **facts) for name, reference in references.items()}


@pytest.fixture(scope="session")
def rejected_objects() -> list[RejectedObject]:
    """One with an outline, one without."""
    shared: dict[str, Any] = {"origin": small.ORIGIN, "reason_detail": "as measured"}
    return [
        RejectedObject(
            object_id="tree",
            reason=Reason.VEGETATION,
            outline=small.Polygon([(60, 0), (64, 0), (62, 5)]),
            area_m2=10.0,
            height_m=7.25,
            n_points=55,
            **shared,
        ),
        RejectedObject(
            object_id="pole",
            reason=Reason.TOO_SMALL,
            outline=None,
            area_m2=float("nan"),
            height_m=float("nan"),
            n_points=1,
            **shared,
        ),
    ]
