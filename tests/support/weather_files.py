"""Files of a typical year as EnergyPlus and PVGIS write them, made from given hours."""

from pathlib import Path

import numpy as np

from pipeline.extras.solar.weather import Site, Weather


def write_epw(path: Path, weather: Weather, site: Site, *, utc_offset_h: int, rows: int = 8760) -> None:
    """Hours in local standard time, numbered 1 to 24, each the mean of the hour that ends then."""
    head = f"LOCATION,Town,-,NLD,X,0,{site.latitude_deg},{site.longitude_deg},{utc_offset_h},{site.altitude_m}"
    lines = [head, *["COMMENTS"] * 7]
    columns = [np.roll(values, utc_offset_h) for values in (weather.ghi, weather.dni, weather.dhi)]
    for hour in range(rows):
        day = weather.times[hour]
        ghi, dni, dhi = (f"{values[hour]:.3f}" for values in columns)
        before = ["2001", str(day.month), str(day.day), str(day.hour + 1), "60", "?", *["0"] * 7]
        lines.append(",".join([*before, ghi, dni, dhi, *["0"] * 19]))
    path.write_text("\n".join(lines) + "\n")


def write_pvgis(path: Path, weather: Weather, site: Site, *, offset_h: float) -> None:
    """Hours in UTC; the values are of an instant `offset_h` later."""
    lines = [
        f"Latitude (decimal degrees): {site.latitude_deg}",
        f"Longitude (decimal degrees): {site.longitude_deg}",
        f"Elevation (m): {site.altitude_m}",
        f"Irradiance Time Offset (h): {offset_h}",
        "month,year",
        *(f"{month},2005" for month in range(1, 13)),
        "time(UTC),T2m,RH,G(h),Gb(n),Gd(h),IR(h),WS10m,WD10m,SP",
    ]
    for hour in range(8760):
        ghi, dni, dhi = (f"{values[hour]:.3f}" for values in (weather.ghi, weather.dni, weather.dhi))
        time = f"2005{weather.times[hour]:%m%d:%H}00"
        lines.append(f"{time},10.0,80.0,{ghi},{dni},{dhi},300.0,3.0,90.0,101300.0")
    path.write_text("\n".join(lines) + "\n")
