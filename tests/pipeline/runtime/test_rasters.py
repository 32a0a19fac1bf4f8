"""Rasters of classify: right values at the right places, cloud-optimised, whatever the tiles."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from las_files import write_las

from pipeline.errors import SettingsError
from pipeline.extras.classify.classify import ClassifySummary
from pipeline.extras.classify.raster_files import NO_VALUE, RasterLattice, write_cog
from pipeline.extras.classify.rasters import RASTERS

FOOT = 0.3048


@pytest.fixture
def rasters_of(run_classify: Callable[..., ClassifySummary]) -> Callable[..., ClassifySummary]:
    """Classify with rasters."""
    return functools.partial(run_classify, rasters=True)


def slope(x: Any, y: Any) -> Any:
    return 5.0 + 0.05 * (x - 600_000) - 0.02 * (y - 5_000_000)


@pytest.fixture(scope="session")
def plateau(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A slope of 60 x 60 m at 6 points per square metre, with a flat roof of 20 x 12 m and a hole in the data."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, 60, (2, 60 * 60 * 6))
    hole = (np.abs(x - 45) < 6) & (np.abs(y - 15) < 6)
    x, y = x[~hole] + 600_000, y[~hole] + 5_000_000
    roof = (x > 600_010) & (x < 600_030) & (y > 5_000_030) & (y < 5_000_042)
    z = np.where(roof, 16.0, slope(x, y)) + rng.normal(0, 0.01, len(x))
    path = tmp_path_factory.mktemp("plateau") / "plateau.laz"
    return write_las(path, np.column_stack((x, y, z)), "EPSG:32632+5773")


def cells(summary: ClassifySummary, name: str) -> tuple[Any, Any, Any]:
    """Values (masked) and the eastings and northings of the cells' centres."""
    with rasterio.open(Path(summary.out) / f"{name}.tif") as raster:
        values = raster.read(1, masked=True)
        rows, columns = np.indices(values.shape)
        west, north, side = raster.transform.c, raster.transform.f, raster.transform.a
        return values, west + (columns + 0.5) * side, north - (rows + 0.5) * side


def test_terrain_surface_and_height_are_those_of_the_scene(plateau: Path, rasters_of: Any) -> None:
    summary = rasters_of(plateau)
    terrain, x, y = cells(summary, "terrain")
    surface, _, _ = cells(summary, "surface")
    height, _, _ = cells(summary, "height")
    inside = (x > 600_002) & (x < 600_058) & (y > 5_000_002) & (y < 5_000_058)
    known = inside & ~np.ma.getmaskarray(terrain)
    assert np.abs(terrain - slope(x, y))[known].max() < 0.15
    roof = (x > 600_011) & (x < 600_029) & (y > 5_000_031) & (y < 5_000_041)
    assert np.abs(surface - 16.0)[roof].max() < 0.06
    away = known & ~((x > 600_008) & (x < 600_032) & (y > 5_000_028) & (y < 5_000_044))
    assert np.abs(surface - slope(x, y))[away].max() < 0.2
    assert np.ma.allclose(height, surface - terrain, atol=2e-5)
    assert (np.ma.getmaskarray(height) == np.ma.getmaskarray(terrain) | np.ma.getmaskarray(surface)).all()
    # the middle of the hole is unknown, and nothing is drawn beyond the data
    assert np.ma.getmaskarray(surface)[(np.abs(x - 600_045) < 1) & (np.abs(y - 5_000_015) < 1)].all()
    assert summary.rasters == tuple(str(Path(summary.out) / f"{name}.tif") for name in sorted(RASTERS))


def test_the_files_are_cloud_optimised_and_tell_crs_unit_and_nodata(plateau: Path, rasters_of: Any) -> None:
    summary = rasters_of(plateau, raster_cell=0.1)
    for name, description in RASTERS.items():
        with rasterio.open(Path(summary.out) / f"{name}.tif") as raster:
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert raster.block_shapes == [(512, 512)]
            assert raster.overviews(1) == [2]
            assert (raster.dtypes, raster.nodata, raster.units) == (("float32",), NO_VALUE, ("metre",))
            assert raster.descriptions == (description,)
            assert raster.transform.a == -raster.transform.e == 0.1
            crs = pyproj.CRS.from_wkt(raster.crs.to_wkt())
            assert crs.is_compound == (name != "height")
            horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
            assert horizontal.to_epsg() == 32632
            if crs.is_compound:
                assert crs.sub_crs_list[1].to_epsg() == 5773


@pytest.mark.parametrize("size_m", [20.0, 33.3])
def test_tiles_do_not_show(size_m: float, plateau: Path, rasters_of: Any) -> None:
    whole = rasters_of(plateau, settings={"tile_size_m": 1000.0})
    cut = rasters_of(plateau, settings={"tile_size_m": size_m, "lattice_x_m": 3.7, "lattice_y_m": -8.1})
    for name in RASTERS:
        assert (Path(whole.out) / f"{name}.tif").read_bytes() == (Path(cut.out) / f"{name}.tif").read_bytes(), name


def test_feet_stay_feet(plateau: Path, rasters_of: Any, tmp_path: Path) -> None:
    in_feet = laspy.read(plateau).xyz / FOOT
    write_las(tmp_path / "feet.laz", in_feet, "EPSG:2994")  # Oregon Lambert, international feet
    summary = rasters_of(tmp_path / "feet.laz", vertical_unit="ft", allow_outside_area_of_use=True)
    surface, x, y = cells(summary, "surface")
    roof = (x > 600_011 / FOOT) & (x < 600_029 / FOOT) & (y > 5_000_031 / FOOT) & (y < 5_000_041 / FOOT)
    assert np.abs(surface - 16.0 / FOOT)[roof].max() < 0.06 / FOOT
    with rasterio.open(Path(summary.out) / "surface.tif") as raster:
        assert raster.transform.a == 2.0
        assert raster.units == ("foot",)
        assert raster.crs.to_epsg() == 2994


def test_a_cell_without_extent_or_too_small_for_the_area_is_refused(plateau: Path, rasters_of: Any) -> None:
    with pytest.raises(SettingsError, match="raster cell is -1"):
        rasters_of(plateau, raster_cell=-1.0)
    with pytest.raises(SettingsError, match="are too many"):
        rasters_of(plateau, raster_cell=1e-9)


def test_windows_beyond_the_lattice_are_cut_and_nothing_else_is_left(tmp_path: Path) -> None:
    lattice = RasterLattice.over((10.0, 20.0, 13.9, 22.9), 1.0, 1.0)
    assert (lattice.columns, lattice.rows) == (4, 3)
    block = np.arange(16, dtype=np.float32).reshape(4, 4)
    block[2, 2] = np.nan
    tags = {"crs_wkt": None, "description": "test", "unit": "metre"}
    windows = [(9, 19, block), (900, 900, block)]
    write_cog(tmp_path / "a.tif", tmp_path / "working.tif", lattice, windows, **tags)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs is None
        values = raster.read(1)
    expected = np.full((3, 4), NO_VALUE)
    expected[:, :3] = np.where(np.isnan(block), NO_VALUE, block)[1:, 1:][::-1]
    assert (values == expected).all()
