"""The plan of a run, made before any work: its inputs, its lattice, and whether it fits into memory."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import shapely

from pipeline.errors import (
    CrsError,
    EmptyInputError,
    InconsistentInputError,
    InputError,
    UnreadableInputError,
    all_at_fault,
)
from pipeline.io import ReadOptions, SourceInfo, SpatialReference, is_url, open_source, shown
from pipeline.io.area_of_use import refuse_far_outside
from pipeline.io.crs import with_one_vertical
from pipeline.io.file_facts import Share
from pipeline.io.gps_time import GpsTimeKind
from pipeline.io.source import IMPOSSIBLE_DENSITY
from pipeline.runtime.scratch.folder import POINT
from pipeline.settings import RunSettings
from pipeline.terrain.filter_settings import FILTERS
from pipeline.terrain.terrain_settings import APRON_M, ClassesInUse, GroundSettings
from pipeline.tiling import MM, Tile, TileGrid, Window

WINDOW_BASE_BYTES = 300 * 2**20
"""Memory of a worker, before the first split."""
_TILE_SIZES_M = (1000.0, 500.0, 250.0, 125.0, 62.5)
_ONE_CRS = (
    "Run inputs of different CRS apart, or give --crs if one header is wrong, with its vertical part (such as "
    "EPSG:28992+5709) if their elevations differ"
)
_MOST_TILES = 500_000
"""Tiles that a file may lie over: 700 by 700 km in tiles of 1 km, which take ten seconds to plan."""
_POINTS_PER_WINDOW = 4_000_000
"""Points that a tile with its halo should not exceed: tiles of 500 m up to 11 points per m2."""
_POINTS_PER_SHARE = 2_000_000
"""Points of a file that a task of ingest takes: some seconds of work."""
_MOST_SHARES = 128
"""Tasks of ingest per file: each leaves a file in every tile that it meets."""
MANY_FILES = 256
"""From so many files on tasks look at them: two seconds of work, more than the start of a process takes."""
_ASKED_AT_ONCE = 8
"""Remote files whose headers are read at once: a header takes some ten requests of tens of milliseconds each."""
_BYTES_PER_POINT = 220
"""Bytes per point of the window: measured peak of a split above the size of its process, at 3 and 5 million points."""
_BYTES_PER_JUDGED_POINT = 140
"""The same of the search for duplicates and outliers, where several files share a tile; 80 with one."""
_BLOCK_M = 1000.0
"""About the side of a block of the ground stage. Wider ones look at fewer cells twice, and need more memory."""
LARGEST_TASK_BYTES = _POINTS_PER_WINDOW * _BYTES_PER_POINT
"""Peak of the largest task of plans that choose their tile size."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """What a run will read, and how it is cut into tiles."""

    sources: tuple[SourceInfo, ...]
    """The inputs, in the order of their names."""
    grid: TileGrid
    """The lattice."""
    options: ReadOptions
    """How the inputs are read."""
    points: int
    """Number of points in the headers."""
    density_per_m2: float
    """Points per square metre of the densest input."""
    window_bytes: int
    """Estimated peak of the largest task above the process's own size."""
    warnings: tuple[str, ...]
    """What is odd but usable."""

    @property
    def reference(self) -> SpatialReference:
        """The CRS and units of all inputs."""
        return self.sources[0].reference

    @property
    def gps_kind(self) -> GpsTimeKind:
        """What the GPS times of all inputs are; NONE where the inputs differ."""
        kinds = {info.gps_time_kind for info in self.sources}
        return kinds.pop() if len(kinds) == 1 else GpsTimeKind.NONE


def tile_size_m(density_per_m2: float, halo_m: float, area_m2: float) -> float:
    """The largest usual tile whose window fits a worker, and that leaves work for several workers.

    Large tiles waste less on halos. Sizes up to 250 m suit any area; larger ones need an area of eight tiles.

    >>> tile_size_m(1.0, 50.0, 1e8), tile_size_m(10.0, 50.0, 1e8), tile_size_m(10.0, 50.0, 5e4)
    (1000.0, 500.0, 250.0)
    """
    for size in _TILE_SIZES_M:
        fits = density_per_m2 * (size + 2.0 * halo_m) ** 2 <= _POINTS_PER_WINDOW
        if fits and (size <= 250.0 or area_m2 >= 8.0 * size * size):
            return size
    return _TILE_SIZES_M[-1]


def make_plan(
    paths: Sequence[str],
    options: ReadOptions,
    settings: RunSettings,
    look: Callable[[Sequence[str], ReadOptions], tuple[SourceInfo, ...]] | None = None,
) -> Plan:
    """Read every input's header, by `look` if given, and lay out the lattice.

    Raises InputError if an input cannot be used, or two inputs disagree about their CRS.
    """
    sources = (look or looked_at)(sorted(paths), options)
    if options.crs is not None:
        references = with_one_vertical([info.reference for info in sources])
        pairs = zip(sources, references, strict=True)
        sources = tuple(dataclasses.replace(info, reference=reference) for info, reference in pairs)
    first = sources[0].reference
    odd: dict[str, list[str]] = {}
    for info in sources:
        for text in info.warnings:
            odd.setdefault(text, []).append(info.path)
    # one warning for all inputs: a city has thousands of them, all with the same oddity
    warnings = [
        f"{of[0]}{f' and {len(of) - 1} more inputs' if len(of) > 1 else ''}: {text}" for text, of in odd.items()
    ]
    faults: list[InputError] = []
    for info in sources[1:]:
        other = info.reference
        same_units = (
            other.horizontal_unit_m == first.horizontal_unit_m and other.vertical_unit_m == first.vertical_unit_m
        )
        if not same_units or (other.crs is None) != (first.crs is None) or other.crs != first.crs:
            fault = CrsError(
                info.path,
                f"its CRS is {other.name}, that of {sources[0].path} is {first.name}",
                _ONE_CRS,
            )
            faults.append(fault)
    if faults:
        raise all_at_fault(faults)
    sources = _sharing(sources)
    densities = [info.density_per_m2 for info in sources if math.isfinite(info.density_per_m2)]
    density = max(densities, default=1.0)
    halo_m = settings.halo_m
    area = sum((i.bounds_m[3] - i.bounds_m[0]) * (i.bounds_m[4] - i.bounds_m[1]) for i in sources)
    size = settings.general.tile_size_m or tile_size_m(density, halo_m, area)
    grid = TileGrid(
        size_mm=round(size * MM),
        halo_mm=math.ceil(halo_m * MM),
        origin_x_mm=round(settings.general.lattice_x_m * MM),
        origin_y_mm=round(settings.general.lattice_y_m * MM),
    )
    faults = [too_wide for info in sources for too_wide in _too_wide(info, options, size)]
    if faults:
        raise all_at_fault(faults)
    return Plan(
        sources=sources,
        grid=grid,
        options=options,
        points=sum(info.point_count for info in sources),
        density_per_m2=density,
        window_bytes=max(
            int(density * (size + 2.0 * halo_m) ** 2 * _BYTES_PER_POINT), _block_bytes(grid, sources, settings)
        ),
        warnings=tuple(warnings),
    )


def _too_wide(info: SourceInfo, options: ReadOptions, size_m: float) -> list[InputError]:
    """The fault of a file whose points lie over too many tiles, if they do."""
    left, bottom, right, top = wanted_bounds_m(info, options) or (0.0, 0.0, 0.0, 0.0)
    if (right - left) * (top - bottom) <= _MOST_TILES * size_m**2:
        return []
    fault = UnreadableInputError(
        info.path,
        f"its points lie over {(right - left) / 1000.0:,.0f} by {(top - bottom) / 1000.0:,.0f} km, more than "
        f"{_MOST_TILES:,} tiles of {size_m:g} m",
        "Points far from the others have damaged coordinates: remove them, or cut the region with --bbox. If they are "
        "right, choose larger tiles (tile_size_m)",
    )
    return [fault]


def _sharing(sources: Sequence[SourceInfo]) -> tuple[SourceInfo, ...]:
    """The sources with one object for all equal CRS and lists of dimensions: what a task looked at has copies."""
    reference = sources[0].reference
    held: dict[object, Any] = {}
    shared = []
    for info in sources:
        crs, dimensions = info.facts.crs, info.facts.dimensions
        facts = dataclasses.replace(
            info.facts,
            crs=None if crs is None else held.setdefault(crs.srs, crs),
            dimensions=held.setdefault(dimensions, dimensions),
        )
        known = reference if info.reference == reference else info.reference
        shared.append(dataclasses.replace(info, reference=known, facts=facts))
    return tuple(shared)


def wanted_bounds_m(info: SourceInfo, options: ReadOptions) -> tuple[float, float, float, float] | None:
    """What the window leaves of a file's bounds: x_min, y_min, x_max, y_max; None for nothing."""
    left, bottom, _, right, top, _ = info.bounds_m
    if options.window is not None:
        unit, window = info.reference.horizontal_unit_m, options.window
        left, bottom = max(left, window.x_min * unit), max(bottom, window.y_min * unit)
        right, top = min(right, window.x_max * unit), min(top, window.y_max * unit)
    return (left, bottom, right, top) if left <= right and bottom <= top else None


def wanted_points(info: SourceInfo, options: ReadOptions) -> int:
    """Points of a file in the window, as if they were spread evenly over its bounds."""
    box, (x_min, y_min, _, x_max, y_max, _) = wanted_bounds_m(info, options), info.bounds_m
    if box is None:
        return 0
    whole = (x_max - x_min) * (y_max - y_min)
    return round(info.point_count * ((box[2] - box[0]) * (box[3] - box[1]) / whole if whole > 0.0 else 1.0))


def shares_of(info: SourceInfo, options: ReadOptions) -> list[Share | None]:
    """The shares in which a file is read, each by a task; None stands for a file that is read whole.

    A remote file is fetched whole, and read then, except for a window of COPC: its nodes are read where they are.
    """
    in_place = not is_url(info.path) or is_fetched_by_nodes(info, options)
    if not (info.is_divisible and in_place):
        return [None]
    # only of COPC is less than all of it read
    points = wanted_points(info, options) if info.format == "copc" else info.point_count
    of = min(_MOST_SHARES, -(-points // _POINTS_PER_SHARE))
    return [Share(number=k, of=of) for k in range(of)] if of > 1 else [None]


def is_fetched_by_nodes(info: SourceInfo, options: ReadOptions) -> bool:
    """Whether only a part of a remote file is fetched: the nodes of its octree that meet a window."""
    x_min, y_min, _, x_max, y_max, _ = info.bounds_m
    is_cut = wanted_bounds_m(info, options) != (x_min, y_min, x_max, y_max)
    return is_url(info.path) and info.format == "copc" and info.in_parts and is_cut


def _block_bytes(grid: TileGrid, sources: Sequence[SourceInfo], settings: RunSettings) -> int:
    """Estimated peak of the largest task of the ground stage, above the process's own size."""
    low, high = (
        [pick(info.bounds_m[axis + k] for info in sources) for axis in (0, 1)] for pick, k in ((min, 0), (max, 3))
    )
    size_m = grid.size_mm / MM
    # what the inputs cover, and the tile that their edge may cut
    widths = [min(tiles_per_block(grid.size_mm) * size_m, high[axis] - low[axis] + size_m) for axis in (0, 1)]
    beyond_m = 2.0 * (APRON_M + settings.scene.ground_support_m(ClassesInUse()))
    cells = (widths[0] + beyond_m) * (widths[1] + beyond_m)
    return int(cells * FILTERS[settings.scene.ground.filter].bytes_per_cell)


def looked_at(paths: Sequence[str], options: ReadOptions) -> tuple[SourceInfo, ...]:
    """The headers of all inputs; remote ones are read concurrently, since that is mostly waiting.

    Raises InputError with the faults of all that cannot be used.
    """
    if any(is_url(path) for path in paths):
        with ThreadPoolExecutor(_ASKED_AT_ONCE, thread_name_prefix="gablework-plan") as threads:
            return tuple(threads.map(lambda path: open_source(path, options).info, paths))
    found, faults = usable(paths, options)
    if faults:
        raise all_at_fault(faults)
    return tuple(found)


def usable(paths: Sequence[str], options: ReadOptions) -> tuple[list[SourceInfo], list[InputError]]:
    """The headers of the inputs that can be used, and what is wrong with the others."""
    found, faults = [], []
    for path in paths:
        try:
            found.append(open_source(path, options).info)
        except InputError as fault:
            faults.append(fault)
    return found, faults


def check_places(plan: Plan) -> None:
    """Refuse inputs that would lie far outside the area of use of their CRS; raises CrsError."""
    faults: list[InputError] = []
    for info in plan.sources:
        try:
            refuse_far_outside(info.path, info.location)
        except CrsError as fault:
            faults.append(fault)
    if faults:
        raise all_at_fault(faults)


def without_far_files(plan: Plan, paths: Sequence[str]) -> tuple[Plan, list[str]]:
    """The plan and paths without remote files that lie off --bbox and --aoi by their headers: no need to fetch them.

    Raises EmptyInputError if no file is left.
    """
    window = plan.options.window
    if window is None:
        return plan, list(paths)
    unit = plan.sources[0].reference.horizontal_unit_m
    wanted = shapely.box(window.x_min, window.y_min, window.x_max, window.y_max)
    of_path = {info.path: info for info in plan.sources}
    near = []
    for path in paths:
        info = of_path[shown(path)]
        x_min, y_min, _, x_max, y_max, _ = (value / unit for value in info.bounds_m)
        # headers are exact to a unit; a file of this machine costs only a read
        if not is_url(path) or shapely.box(x_min - 1.0, y_min - 1.0, x_max + 1.0, y_max + 1.0).intersects(wanted):
            near.append(path)
    if not near:
        raise EmptyInputError(
            shown(paths[0]), f"all {len(paths)} inputs lie off --bbox and --aoi", "Check them, and their CRS"
        )
    kept = {shown(path) for path in near}
    sources = tuple(info for info in plan.sources if info.path in kept)
    points = sum(info.point_count for info in sources)
    return dataclasses.replace(plan, sources=sources, points=points), near


def check_memory(plan: Plan, limit_bytes: int | None) -> None:
    """Refuse a plan whose largest task does not fit into a worker with this memory limit, before the first task."""
    if limit_bytes is None or plan.window_bytes <= limit_bytes:
        return
    densest = max(plan.sources, key=lambda info: info.density_per_m2 if math.isfinite(info.density_per_m2) else 0.0)
    if densest.density_per_m2 > IMPOSSIBLE_DENSITY:
        x_min, y_min, _, x_max, y_max, _ = densest.bounds_m
        raise InconsistentInputError(
            densest.path,
            f"its {densest.point_count} points lie within {x_max - x_min:.3g} by {y_max - y_min:.3g} m, denser than "
            "any airborne survey",
            "Check the columns, the scale and the CRS: degrees are not lengths",
        )
    raise InputError(
        plan.sources[0].path,
        f"a tile of {plan.grid.size_mm / MM:g} m needs about {plan.window_bytes / 1e9:.1f} GB a worker, "
        f"its limit is {limit_bytes / 1e9:.1f} GB",
        "Set a smaller tile_size_m, or give the workers more memory",
    )


def split_grid(plan: Plan, settings: RunSettings, *, footprints: bool) -> TileGrid:
    """The plan's lattice with the halo that the split needs: none in given footprints. One set by the user stays."""
    if settings.general.halo_m:
        return plan.grid
    support_m = settings.scene.split_support_m(footprints=footprints)
    return dataclasses.replace(plan.grid, halo_mm=math.ceil(support_m * MM))


def check_windows(plan: Plan, grid: TileGrid, points_by_tile: Mapping[Tile, int], limit_bytes: int | None) -> None:
    """Refuse tiles whose windows have more points than fit into a worker, now that the points are counted.

    Headers can claim wide bounds and hide dense corners, so the plan's own check does not suffice.
    """
    if limit_bytes is None:
        return
    for tile in points_by_tile:
        seen = _points_in_window(grid, tile, points_by_tile)
        if seen * _BYTES_PER_POINT > limit_bytes:
            raise InputError(
                plan.sources[0].path,
                f"tile {tile.key} and its halo hold about {seen:.0f} points, more than a worker's "
                f"{limit_bytes / 1e9:.1f} GB can take",
                "Set a smaller tile_size_m, or give the workers more memory",
            )


def points_bytes(points: int, beside: int) -> int:
    """Estimated peak memory of a process that judges the points of a tile, beside neighbours of at most so many."""
    return WINDOW_BASE_BYTES + points * _BYTES_PER_JUDGED_POINT + beside * POINT.itemsize


def ground_bytes(window: Window, settings: GroundSettings) -> int:
    """Estimated peak memory of a process that finds the ground of a window."""
    cells = (window.x1_mm - window.x0_mm) * (window.y1_mm - window.y0_mm) // MM**2
    return WINDOW_BASE_BYTES + cells * FILTERS[settings.filter].bytes_per_cell


def tiles_per_block(size_mm: int) -> int:
    """Tiles along the side of a block of the ground stage.

    >>> [tiles_per_block(size_mm) for size_mm in (2_000_000, 1_000_000, 500_000, 62_500)]
    [1, 1, 2, 16]
    """
    return max(1, round(_BLOCK_M * MM / size_mm))


def window_bytes(grid: TileGrid, tile: Tile, points_by_tile: Mapping[Tile, int]) -> int:
    """Estimated peak memory of a process that splits a tile of a lattice from `split_grid`."""
    return WINDOW_BASE_BYTES + int(_points_in_window(grid, tile, points_by_tile) * _BYTES_PER_POINT)


def _points_in_window(grid: TileGrid, tile: Tile, points_by_tile: Mapping[Tile, int]) -> float:
    """Points of a tile and its halo, as if those of each tile were spread evenly over it."""
    window, area = grid.window(tile), grid.size_mm**2
    seen = 0.0
    for other in grid.tiles_over(window):
        core = grid.core(other)
        width = min(core.x1_mm, window.x1_mm) - max(core.x0_mm, window.x0_mm)
        depth = min(core.y1_mm, window.y1_mm) - max(core.y0_mm, window.y0_mm)
        seen += points_by_tile.get(other, 0) * (width * depth / area)
    return seen
