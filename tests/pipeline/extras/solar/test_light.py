"""What planes receive of the sun and the sky, held against pvlib's own sums."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from weather_files import write_epw, write_pvgis

from pipeline.errors import UnreadableInputError
from pipeline.extras.solar.sectors import SECTORS
from pipeline.extras.solar.sky_view import sky_views
from pipeline.extras.solar.sunlight import light_above, received
from pipeline.extras.solar.weather import Site, Weather, YearOfLight, clear_sky, weather_of, year_of_light
from pipeline.model import FloatArray

pvlib = pytest.importorskip("pvlib", reason="the extra solar is not installed")

DELFT = Site(longitude_deg=4.36, latitude_deg=52.01, altitude_m=0.0)
SYDNEY = Site(longitude_deg=151.2, latitude_deg=-33.9, altitude_m=40.0)
OPEN = np.zeros((1, SECTORS))


@pytest.fixture(scope="module")
def weather() -> Weather:
    """A clear year in Delft."""
    return clear_sky(DELFT, 3.0)


@pytest.fixture(scope="module")
def light(weather: Weather) -> YearOfLight:
    """Its light."""
    return year_of_light(DELFT, weather)


def normal_of(tilt_deg: float, azimuth_deg: float) -> FloatArray:
    """(1, 3) the normal of a plane."""
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    level = math.sin(tilt)
    return np.array([[level * math.sin(azimuth), level * math.cos(azimuth), math.cos(tilt)]])


def sun_of(weather: Weather, site: Site) -> Any:
    """The places of the sun at the hours of a year, a data frame."""
    return pvlib.solarposition.get_solarposition(
        weather.times, site.latitude_deg, site.longitude_deg, altitude=site.altitude_m
    )


@pytest.fixture(scope="module")
def sun(weather: Weather) -> Any:
    """Those of the clear year in Delft."""
    return sun_of(weather, DELFT)


def by_pvlib(weather: Weather, sun: Any, tilt_deg: float, azimuth_deg: float) -> tuple[float, float, float]:
    """kWh/m2 a year of beam, sky and ground that pvlib has for a plane in the open, with an albedo of 0.2."""
    found = pvlib.irradiance.get_total_irradiance(
        tilt_deg,
        azimuth_deg,
        sun["apparent_zenith"],
        sun["azimuth"],
        weather.dni,
        weather.ghi,
        weather.dhi,
        dni_extra=pvlib.irradiance.get_extra_radiation(weather.times),
        albedo=0.2,
        model="haydavies",
    )
    sums = (found[name].sum() / 1000.0 for name in ("poa_direct", "poa_sky_diffuse", "poa_ground_diffuse"))
    return tuple(map(float, sums))


def ours(light: YearOfLight, tilt_deg: float, azimuth_deg: float, tangents: FloatArray = OPEN) -> tuple[float, float]:
    """kWh/m2 a year of beam and sky."""
    normal = normal_of(tilt_deg, azimuth_deg)
    sky = received(tangents, normal, light.circumsolar) + light.isotropic * sky_views(tangents, normal)
    return float(received(tangents, normal, light.beam)[0]), float(sky[0])


@pytest.mark.parametrize("site", [DELFT, SYDNEY], ids=["Delft", "Sydney"])
def test_a_level_plane_in_the_open_receives_what_pvlib_says(site: Site) -> None:
    weather = clear_sky(site, None)
    beam, sky, _ = by_pvlib(weather, sun_of(weather, site), 0.0, 180.0)
    found = ours(year_of_light(site, weather), 0.0, 180.0)
    assert found[0] == pytest.approx(beam, rel=1e-9)
    assert found[1] == pytest.approx(sky, rel=2e-4)
    assert 800.0 < beam < 2500.0


@settings(deadline=None, max_examples=examples(30))
@given(tilt=st.floats(0.0, 75.0), azimuth=st.floats(0.0, 360.0))
def test_an_inclined_plane_in_the_open_receives_what_pvlib_says(
    weather: Weather, sun: Any, light: YearOfLight, tilt: float, azimuth: float
) -> None:
    beam, sky, ground = by_pvlib(weather, sun, tilt, azimuth)
    found = ours(light, tilt, azimuth)
    assert found[0] == pytest.approx(beam, rel=0.004, abs=1.0)
    assert found[1] == pytest.approx(sky, rel=0.004, abs=0.5)
    assert 0.2 * light.ground * (1.0 - math.cos(math.radians(tilt))) / 2.0 == pytest.approx(ground, rel=1e-6, abs=1e-6)


@settings(deadline=None, max_examples=examples(30))
@given(horizon=st.floats(0.0, 60.0))
def test_below_a_horizon_all_round_the_sun_gives_nothing(
    weather: Weather, sun: Any, light: YearOfLight, horizon: float
) -> None:
    elevation = sun["apparent_elevation"].to_numpy()
    beam = weather.dni * np.sin(np.radians(elevation)) / 1000.0
    tangents = np.full((1, SECTORS), math.tan(math.radians(horizon)))
    found = ours(light, 0.0, 0.0, tangents)[0]
    # the suns of the band that the horizon cuts are divided evenly
    assert beam[elevation > math.floor(horizon) + 1.0].sum() - 1e-9 <= found
    assert found <= beam[elevation > max(0.0, math.floor(horizon))].sum() + 1e-9


def test_a_wall_in_the_south_takes_the_winter_and_one_in_the_north_nothing(light: YearOfLight) -> None:
    azimuth = np.arange(SECTORS) * 2.0 * np.pi / SECTORS
    south = np.maximum(0.0, -np.cos(azimuth))[None] * math.tan(math.radians(40.0))
    free, shaded, north = (
        ours(light, 35.0, 180.0, tangents)[0] for tangents in (OPEN, south, np.roll(south, SECTORS // 2))
    )
    assert 0.4 * free < shaded < 0.85 * free
    assert north == pytest.approx(free, rel=0.002)


def test_a_sun_counts_in_its_own_direction_and_only_above_the_horizon() -> None:
    table = light_above(np.array([90.0, 270.0, 0.0]), np.array([30.0, -5.0, 60.0]), np.array([2.0, 5.0, 1.0]))
    assert table[:, 0].sum(axis=0) == pytest.approx([math.sqrt(3.0), 0.5, 1.0 + math.sqrt(3.0) / 2.0])
    east = SECTORS // 4
    assert table[east, 30] == pytest.approx(table[east, 0])
    assert (table[east, 31] == 0.0).all()
    assert table[0, 60] == pytest.approx([0.0, 0.5, math.sqrt(3.0) / 2.0])


def test_a_band_that_the_horizon_cuts_gives_its_part_above_it() -> None:
    table = light_above(np.array([90.0]), np.array([30.9]), np.array([1.0]))
    whole = math.sin(math.radians(30.9))
    for horizon, share in ((29.9, 1.0), (30.25, 0.75), (30.5, 0.5), (31.0, 0.0), (89.99, 0.0)):
        tangents = np.full((1, SECTORS), math.tan(math.radians(horizon)))
        assert received(tangents, normal_of(0.0, 0.0), table)[0] == pytest.approx(share * whole, abs=1e-9)


def test_files_of_weather_give_what_their_hours_hold(tmp_path: Path, weather: Weather, light: YearOfLight) -> None:
    epw, pvgis = tmp_path / "delft.epw", tmp_path / "delft.csv"
    write_epw(epw, clear_sky(DELFT, 3.0), DELFT, utc_offset_h=1)
    write_pvgis(pvgis, weather, DELFT, offset_h=0.5)
    for path in (epw, pvgis):
        read = weather_of(str(path))
        assert read.times[0].tz_convert("UTC").minute == 30
        assert read.facts["file"] == path.name
        assert len(read.facts["file_sha256"]) == 64
        found = year_of_light(DELFT, read)
        assert found.beam.sum(axis=0)[0] == pytest.approx(light.beam.sum(axis=0)[0], abs=2.0, rel=1e-3)
        assert found.isotropic == pytest.approx(light.isotropic, rel=2e-3)


def test_a_weather_file_that_is_none_is_refused_with_the_fix(tmp_path: Path, weather: Weather) -> None:
    short = tmp_path / "short.epw"
    write_epw(short, weather, DELFT, utc_offset_h=0, rows=100)
    gaps = tmp_path / "gaps.epw"
    write_epw(gaps, Weather(**{**vars(weather), "dni": weather.dni + 9999.0}), DELFT, utc_offset_h=0)
    torn = tmp_path / "torn.csv"
    torn.write_text("Latitude (decimal degrees): x\n")
    other = tmp_path / "year.txt"
    other.write_text("")
    wanted = {
        short: "has 100 rows",
        gaps: "not within 0 to 2000",
        torn: "cannot be read",
        other: r"ends in \.txt",
        tmp_path / "none.epw": "cannot be read",
    }
    for path, words in wanted.items():
        with pytest.raises(UnreadableInputError, match=words) as refused:
            weather_of(str(path))
        assert "PVGIS" in str(refused.value)
