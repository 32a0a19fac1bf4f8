"""The table of solar energy on roofs: GeoParquet, one row per roof plane, written tile by tile."""

from __future__ import annotations

from pipeline.export.columns import COUNT, FLOAT32S, FLOAT64, HORIZONTAL, INT32, NONE, SHARE, TEXT, WKB, Column
from pipeline.export.result_file import ResultTable, with_bbox

FACTS = "gablework_solar"
"""The key of the file's metadata that holds the assumptions, as JSON."""


COLUMNS = (
    Column("tile", TEXT, NONE, "tile of the run", required=True),
    Column("building_id", TEXT, NONE, "as in the run", required=True),
    Column("plane_id", INT32, NONE, "as in the run", required=True),
    Column("geometry", WKB, HORIZONTAL, "faces of the plane in 3D, as in the run; null without a face"),
    Column("azimuth_deg", FLOAT64, "deg", "of descent, clockwise from true north; 0 if level", required=True),
    Column("tilt_deg", FLOAT64, "deg", "angle to the horizontal", required=True),
    Column("area_m2", FLOAT64, "m2", "true area, along the slope", required=True),
    Column("samples", INT32, COUNT, "points that looked at the sky; 0 without a face", required=True),
    Column("sky_view", FLOAT64, SHARE, "sky view factor, (1 + cos tilt) / 2 in the open; null without a face"),
    Column(
        "horizon_deg",
        FLOAT32S,
        "deg",
        "elevation of the horizon in 72 azimuths, 5 degrees apart, from north clockwise, mean of the points; "
        "null without a face",
    ),
    Column(
        "irradiation_kwh_m2",
        FLOAT64,
        "kWh/m2",
        "energy of a year per true area, of beam, sky and ground; this and what follows is null without a face, and "
        "with `--sky-only`",
    ),
    Column("irradiation_kwh", FLOAT64, "kWh", "the same for the whole plane"),
    Column("beam_kwh_m2", FLOAT64, "kWh/m2", "the part of the sun's beam"),
    Column("sky_kwh_m2", FLOAT64, "kWh/m2", "the part of the sky"),
    Column("ground_kwh_m2", FLOAT64, "kWh/m2", "the part that the ground reflects"),
    Column("beam_loss", FLOAT64, SHARE, "share of the beam that roofs take away; null without any beam"),
)
"""The columns, in the order of the file; `bbox` follows."""

SCHEMA = with_bbox(COLUMNS)
"""The schema of the file."""


TABLE = ResultTable(COLUMNS, FACTS)
"""The table."""
