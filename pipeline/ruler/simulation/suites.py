"""The named suites that `simulate` can make."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from pipeline.errors import SettingsError
from pipeline.ruler.simulation.als import ScannerSettings
from pipeline.ruler.simulation.bridges_and_vans import SCANNER as STREET_SCANNER
from pipeline.ruler.simulation.bridges_and_vans import bridges_and_vans
from pipeline.ruler.simulation.broken_slopes import CELLS as SLOPE_CELLS
from pipeline.ruler.simulation.broken_slopes import broken_slopes
from pipeline.ruler.simulation.city import CITY_SCANNER, TILE_M, CityPlan, Extent, city, hillside
from pipeline.ruler.simulation.curved_roofs import CELLS as CURVED_CELLS
from pipeline.ruler.simulation.curved_roofs import curved_roofs
from pipeline.ruler.simulation.hofmann310 import SCANNER as HOFMANN_SCANNER
from pipeline.ruler.simulation.hofmann310 import hofmann310
from pipeline.ruler.simulation.low_buildings import CELLS as LOW_CELLS
from pipeline.ruler.simulation.low_buildings import SCANNER as LOW_SCANNER
from pipeline.ruler.simulation.low_buildings import low_buildings
from pipeline.ruler.simulation.outline_shapes import CELLS as OUTLINE_CELLS
from pipeline.ruler.simulation.outline_shapes import SCANNER as OUTLINE_SCANNER
from pipeline.ruler.simulation.outline_shapes import outline_shapes
from pipeline.ruler.simulation.roofs import FlatPart, RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain, place_building, undulating_terrain
from pipeline.ruler.simulation.strips import Returns
from pipeline.ruler.simulation.suburb import suburb, tree_at
from pipeline.ruler.simulation.sweep import CELLS, Cell, sweep
from pipeline.ruler.simulation.sweep import SCANNER as SWEEP_SCANNER
from pipeline.ruler.simulation.town import town
from pipeline.ruler.simulation.trust import CELLS as TRUST_CELLS
from pipeline.ruler.simulation.trust import SCANNER as TRUST_SCANNER
from pipeline.ruler.simulation.trust import trust
from pipeline.ruler.simulation.wide_halls import SCANNER as HALL_SCANNER
from pipeline.ruler.simulation.wide_halls import SIZE_M as HALLS_SIZE_M
from pipeline.ruler.simulation.wide_halls import wide_halls


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suite:
    """A kind of scene and the survey that goes with it."""

    name: str
    """As given on the command line."""
    summary: str
    make: Callable[[int, tuple[float, float]], Scene]
    """Scene from a seed and a size in metres."""
    scanner: ScannerSettings
    size_m: tuple[float, float]
    """Default extent east and north."""
    seed: int = 1
    is_sized: bool = True
    """False if the extent follows from the buildings; `size_m` is then an approximate result, not an input."""
    returns: Returns = Returns.ALL
    """The returns of a pulse that the instrument records."""
    cells: tuple[Cell, ...] = ()
    """The surveys of a suite of several; empty for a single one."""
    make_for: Callable[[int, str], Scene] | None = None
    """Scene from a seed and the key of a cell; None if all cells survey the scene of `make`."""
    part: Callable[[int, tuple[float, float], ScannerSettings], Callable[[Extent], Scene]] | None = None
    """From seed, size and survey to a function that makes the scene of the tile of an extent; None if the scene is made
    as a whole."""
    tile_m: float = 0.0
    """Edge of the tiles of a suite that is made in parts."""
    on_slope: Callable[[int, tuple[float, float], ScannerSettings, float], Callable[[Extent], Scene]] | None = None
    """As `part`, on ground with one slope in degrees everywhere; None if the ground of the suite is fixed."""


def _city_on_slope(
    seed: int, size_m: tuple[float, float], settings: ScannerSettings, slope_deg: float
) -> Callable[[Extent], Scene]:
    return CityPlan(seed, size_m, settings, terrain=hillside(seed, slope_deg)).part


def _cube(seed: int, size_m: tuple[float, float]) -> Scene:
    """The test of Shorter and Kasparis: elevations of 0 and 10 m. The cube has edges of 10 m; the seed is ignored."""
    del seed
    terrain = Terrain(base_z_m=0.0)
    middle_x, middle_y = size_m[0] / 2, size_m[1] / 2
    size = RoofDimensions(length_m=10.0, width_m=10.0)
    cube = place_building(
        "cube", RoofShape.FLAT, size, at=(middle_x, middle_y), azimuth_deg=0.0, eave_height_m=10.0, terrain=terrain
    )
    return Scene(
        name="cube", origin=(0.0, 0.0, 0.0), extent=(0.0, 0.0, *size_m), terrain=terrain, buildings=(cube,), crs=None
    )


_SINGLE_SIZES = {
    RoofShape.FLAT: RoofDimensions(length_m=12.0, width_m=9.0),
    RoofShape.PENT: RoofDimensions(length_m=12.0, width_m=8.0, pitch_deg=15.0),
    RoofShape.GABLE: RoofDimensions(length_m=13.0, width_m=9.0, pitch_deg=35.0),
    RoofShape.HIP: RoofDimensions(length_m=14.0, width_m=9.0, pitch_deg=35.0),
    RoofShape.L_SHAPE: RoofDimensions(length_m=15.0, width_m=9.0, pitch_deg=35.0, wing_length_m=6.0, wing_width_m=7.0),
    RoofShape.HALF_HIP: RoofDimensions(length_m=14.0, width_m=9.0, pitch_deg=40.0),
    RoofShape.BENT_HIP: RoofDimensions(length_m=15.0, width_m=10.0, pitch_deg=40.0, second_pitch_deg=25.0),
    RoofShape.PYRAMID: RoofDimensions(length_m=10.0, width_m=10.0, pitch_deg=30.0),
    RoofShape.UNEQUAL_GABLE: RoofDimensions(length_m=13.0, width_m=9.0, pitch_deg=45.0, second_pitch_deg=25.0),
    RoofShape.MANSARD: RoofDimensions(length_m=16.0, width_m=11.0, pitch_deg=60.0, second_pitch_deg=20.0),
    RoofShape.GAMBREL: RoofDimensions(
        length_m=14.0, width_m=10.0, pitch_deg=55.0, second_pitch_deg=25.0, break_share=0.45
    ),
    RoofShape.T_SHAPE: RoofDimensions(
        length_m=18.0, width_m=9.0, pitch_deg=35.0, wing_length_m=6.0, wing_width_m=7.0, wing_offset_m=2.0
    ),
    RoofShape.U_SHAPE: RoofDimensions(length_m=24.0, width_m=9.0, pitch_deg=35.0, wing_length_m=8.0, wing_width_m=7.5),
    RoofShape.CROSS: RoofDimensions(
        length_m=20.0, width_m=9.0, pitch_deg=35.0, wing_length_m=5.0, wing_width_m=8.0, wing_offset_m=1.0
    ),
    RoofShape.COURTYARD: RoofDimensions(length_m=26.0, width_m=22.0, pitch_deg=30.0, wing_width_m=7.0),
    RoofShape.MULTI_LEVEL_FLAT: RoofDimensions(
        length_m=18.0,
        width_m=12.0,
        levels=(
            FlatPart(u_m=-3.0, v_m=0.0, length_m=12.0, width_m=12.0, height_m=3.0),
            FlatPart(u_m=6.0, v_m=0.0, length_m=6.0, width_m=12.0, height_m=0.0),
        ),
    ),
}


def single_building(
    shape: RoofShape,
    seed: int,
    size_m: tuple[float, float] = (40.0, 40.0),
    dimensions: RoofDimensions | None = None,
    *,
    slope_deg: float = 0.0,
    trees: int = 0,
) -> Scene:
    """One building in the middle of a field; the seed turns it and places the trees.

    Without `dimensions` it is a house of about 110 m2 with 35 deg of pitch (pent: 15).
    """
    random = np.random.default_rng([seed, 0x1B])
    terrain = undulating_terrain(100.0, slope_deg, random.uniform(0, 360), 0.0, 100.0, random)
    building = place_building(
        str(shape),
        shape,
        dimensions or _SINGLE_SIZES[shape],
        at=(size_m[0] / 2, size_m[1] / 2),
        azimuth_deg=float(random.uniform(0, 360)),
        eave_height_m=4.0,
        terrain=terrain,
    )
    around = random.uniform(0, 2 * np.pi, trees)
    standing = tuple(
        tree_at(building.x + 13.0 * float(np.cos(a)), building.y + 13.0 * float(np.sin(a)), 2.5, 8.0, terrain)
        for a in around
    )
    return Scene(
        name=str(shape),
        origin=(565_000.0, 5_934_000.0, 0.0),
        extent=(0.0, 0.0, *size_m),
        terrain=terrain,
        buildings=(building,),
        trees=standing,
    )


def _single_suite(shape: RoofShape) -> Suite:
    return Suite(
        name=str(shape),
        summary=f"one {str(shape).replace('_', '-')} building on level ground, 4 points per m2, 3 cm of noise",
        make=lambda seed, size_m: single_building(shape, seed, size_m),
        scanner=ScannerSettings(pulse_density_per_m2=4.0),
        size_m=(40.0, 40.0),
    )


_CUBE_SCANNER = ScannerSettings(
    pulse_density_per_m2=4.0, range_noise_m=0.1, altitude_m=100_000.0, beam_radius_m=0.0, drop_out=0.0, jitter=1.0
)

SUITES: dict[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite(
            name="suburb",
            summary="detached houses of all five roof shapes on gentle terrain, with trees and cars",
            make=suburb,
            scanner=ScannerSettings(pulse_density_per_m2=7.0, flight_azimuth_deg=90.0),
            size_m=(200.0, 200.0),
            seed=7,
        ),
        Suite(
            name="town",
            summary="streets with rows of touching houses of several levels, courtyards and parks, of any size",
            make=town,
            scanner=ScannerSettings(
                pulse_density_per_m2=7.0, altitude_m=900.0, strip_spacing_m=300.0, flight_azimuth_deg=90.0
            ),
            size_m=(400.0, 400.0),
            seed=11,
        ),
        Suite(
            name="cube",
            summary="the cube of Shorter and Kasparis: elevations of 0 and 10 m, 0.1 m of vertical noise",
            make=_cube,
            scanner=_CUBE_SCANNER,
            size_m=(30.0, 30.0),
        ),
        Suite(
            name="hofmann310",
            summary="the 310 buildings of Hofmann, Maas and Streilein: types, sizes, 1.2 m spacing, nuisances",
            make=lambda seed, _: hofmann310(seed),
            scanner=HOFMANN_SCANNER,
            size_m=(700.0, 700.0),
            is_sized=False,
            returns=Returns.LAST,
        ),
        Suite(
            name="sweep",
            summary="all roof shapes under 21 surveys: 0.5 to 50 pulses per m2, 2 to 10 cm of noise; a data set each",
            make=lambda seed, _: sweep(seed),
            scanner=SWEEP_SCANNER,
            size_m=(300.0, 250.0),
            is_sized=False,
            cells=CELLS,
        ),
        Suite(
            name="city",
            summary="rows, courtyards, halls, towers and houses of all shapes up to a hillside, of any size, in tiles",
            make=city,
            scanner=CITY_SCANNER,
            size_m=(1000.0, 1000.0),
            part=lambda seed, size_m, settings: CityPlan(seed, size_m, settings).part,
            tile_m=TILE_M,
            on_slope=_city_on_slope,
        ),
        Suite(
            name="low_buildings",
            summary="sheds of 7 to 25 m2 with roofs 0.5 to 2.5 m above ground, some at houses, for given outlines",
            make=lambda seed, _: low_buildings(seed),
            scanner=LOW_SCANNER,
            size_m=(100.0, 300.0),
            is_sized=False,
            cells=LOW_CELLS,
        ),
        Suite(
            name="bridges_and_vans",
            summary="bridges over cuttings, vans, trucks and containers at the kerb, and no building",
            make=lambda seed, _: bridges_and_vans(seed),
            scanner=STREET_SCANNER,
            size_m=(168.0, 200.0),
            is_sized=False,
        ),
        Suite(
            name="wide_halls",
            summary="halls 40 to 90 m wide that the edge of the data cuts",
            make=lambda seed, _: wide_halls(seed),
            scanner=HALL_SCANNER,
            size_m=(HALLS_SIZE_M, HALLS_SIZE_M),
            is_sized=False,
        ),
        Suite(
            name="outline_shapes",
            summary="round, oblique, bent, trapezoid and ordinary buildings whose outlines must keep their form",
            make=lambda seed, _: outline_shapes(seed),
            scanner=OUTLINE_SCANNER,
            size_m=(150.0, 500.0),
            is_sized=False,
            cells=OUTLINE_CELLS,
        ),
        Suite(
            name="broken_slopes",
            summary="roofs whose slopes break, dormers, parapets: 2, 8 and 30 pulses per m2, 0.5 to 5 cm of noise",
            make=lambda seed, _: broken_slopes(seed),
            scanner=OUTLINE_SCANNER,
            size_m=(150.0, 350.0),
            is_sized=False,
            cells=SLOPE_CELLS,
        ),
        Suite(
            name="curved_roofs",
            summary="barrels, cones, domes and caps: 2, 8 and 30 pulses per m2, 1 to 5 cm of noise",
            make=lambda seed, _: curved_roofs(seed),
            scanner=OUTLINE_SCANNER,
            size_m=(150.0, 250.0),
            is_sized=False,
            cells=CURVED_CELLS,
        ),
        Suite(
            name="trust",
            summary="what is taken for a house, and houses seen badly: small scenes of 21 kinds under several surveys",
            make=lambda seed, _: trust(seed, TRUST_CELLS[0].key),
            scanner=TRUST_SCANNER,
            size_m=(80.0, 80.0),
            is_sized=False,
            cells=TRUST_CELLS,
            make_for=trust,
        ),
        *(_single_suite(shape) for shape in RoofShape),
    )
}
"""All suites by name."""


def suite_named(name: str) -> Suite:
    """The suite of that name; a SettingsError lists the valid names."""
    if name not in SUITES:
        raise SettingsError([f"suite is {name!r}: use one of {', '.join(SUITES)}"])
    return SUITES[name]
