"""Candidates whose outlines may touch: these are drawn before they are modelled, overlaps divided and slits closed.

A task redraws those candidates of some tiles that come near others, of whichever tiles. It needs the outlines of these
others as they are drawn alone, never what other tasks decide. Candidates near the border of its tiles are drawn twice.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError, GableworkError
from pipeline.io.gps_time import GpsTimeKind
from pipeline.model import Candidate, FloatArray, IntArray
from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.disjoint_outlines import Claim, divided, left_of
from pipeline.roof.footprint import polygons_of
from pipeline.roof.plan import drawn_outline, roof_points
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.slits import GAP_MM, Slit, between, closed, slits, united, widened, without
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.scratch.folder import OpenScratch, Scratch
from pipeline.runtime.scratch.outcomes import Files, InParts, Place, brief_within, drop_outcomes, key_of
from pipeline.runtime.stages.beside import points_beside
from pipeline.runtime.stages.gather import gather, points_of, stored_points
from pipeline.runtime.stages.sites import (
    CandidateSite,
    GroupFigures,
    Joined,
    Stored,
    StoredGroup,
    box_around,
    folders_around,
    near_pairs,
)
from pipeline.runtime.stages.stored_sites import group_figures
from pipeline.runtime.stages.window_points import surroundings_of
from pipeline.terrain.lattice import CELL_MM, NO_DATA
from pipeline.tiling import MM, TileGrid, Window

Result = TypeVar("Result")

STAGE = "touching"
"""The stage under which groups are stored whose candidates were drawn again."""
_BESIDE_MM = 2000.0
"""An outline that ends so near to another one stays as it was compared: with the hidden points at walls, which are
known when it is modelled, it could become that much larger."""
_DIRECTIONS = 16
"""Directions in which outlines may be apart; a multiple of four."""
_CLOSE_MM = 2.0
"""Outlines this near may overlap once their corners are rounded."""
_LEAST_SEEN = 0.1
"""A slit is closed where it holds at least so much of the points that a roof as large would."""
_MOST_GROUND, _GROUND_MM = 0.1, 1000
"""At most so many of them lie at the terrain, or less than this above it."""
ACROSS = 2
"""A task takes so many tiles across: along their borders everything is done twice."""
_HELD = 16
"""Candidates whose points stay in memory from one overlap to the next."""
_MOST_BEFORE = 1000
_drawn_before: dict[tuple[str | None, float, RoofSettings], MultiPolygon | None] = {}
"""Outlines that this process drew, by what they are drawn from: tasks side by side draw some of the same ones."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchTask:
    """The candidates of some owners, and those of others that may touch them."""

    own: tuple[StoredGroup, ...]
    """Groups of these owners."""
    others: tuple[StoredGroup, ...]
    """Groups of other owners whose boxes meet theirs."""
    roof: RoofSettings
    """How outlines are drawn."""
    grid: TileGrid
    """The lattice."""
    scratch: Scratch
    """Holds all of them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchBrief:
    """The own groups in which an outline was drawn, by their numbers; in this order they are parts."""

    groups: Mapping[int, GroupFigures]
    warnings: tuple[str, ...] = ()
    """What could not be drawn or compared."""


def drawn_apart(context: RunContext, roof: RoofSettings, joined: Joined) -> Joined:
    """The candidates of a run, with outlines that neither overlap nor leave slits where they come near each other."""
    started = time.perf_counter()
    owned: dict[tuple[int, int], list[StoredGroup]] = collections.defaultdict(list)
    for group in joined.groups:
        owner = group.figures.owner
        owned[owner.column // ACROSS, owner.row // ACROSS].append(group)
    blocks = sorted(owned)
    reach = [box_around(group.figures.reach_mm for group in owned[block]) for block in blocks]
    boxes = np.array([None if box is None else shapely.box(*box) for box in reach], object)
    near = collections.defaultdict(list)
    for i, j in shapely.STRtree(boxes).query(boxes).T.tolist():
        if i != j:
            near[i].append(j)
    tasks = {}
    for k, (column, row) in enumerate(blocks):
        own, box = tuple(owned[column, row]), boxes[k]
        around = [group for j in sorted(near[k]) for group in owned[blocks[j]] if _meets(group, box)]
        seen = sorted({one for group in (*own, *around) for one in group.figures.tiles})
        digests = [[group.figures.digest for group in groups] for groups in (own, around)]
        key = key_of(roof, context.plan.grid, digests, joined.around(seen))
        tasks[Place(STAGE, f"block_x{column}_y{row}", key)] = TouchTask(
            own=own, others=tuple(around), roof=roof, grid=context.plan.grid, scratch=context.scratch
        )
    drop_outcomes(context.scratch, STAGE, tasks)
    files: Files[TouchTask, TouchBrief] = Files(reads=_read)
    found = context.map_stored("outline", draw_apart, tasks, brief_within, files=files, quiet=True)
    for warning in sorted({warning for brief in found.values() for warning in brief.warnings}):
        context.progress.warn("outline", warning)
    groups: list[StoredGroup] = []
    for place, task in tasks.items():
        part = {number: k for k, number in enumerate(found[place].groups)}
        groups += [
            Stored(place=place, part=part[k], figures=found[place].groups[k]) if k in part else group
            for k, group in enumerate(task.own)
        ]
    timings = context.progress.timings
    timings["outline"] = timings.get("outline", 0.0) + time.perf_counter() - started
    return dataclasses.replace(joined, groups=tuple(groups))


def _meets(group: StoredGroup, box: shapely.Polygon | None) -> bool:
    reach = group.figures.reach_mm
    return box is not None and reach is not None and bool(box.intersects(shapely.box(*reach)))


def _read(task: TouchTask) -> set[str]:
    """The folders of scratch with the sites and the points of a task, and with what lies around them."""
    return {folder for group in (*task.own, *task.others) for folder in folders_around(group, task.grid)}


def draw_apart(task: TouchTask) -> InParts[TouchBrief]:
    """The groups of a task in which outlines had to be drawn.

    Raises MemoryError or OSError if scratch cannot be read, or does not fit into memory.
    """
    task = dataclasses.replace(task, scratch=OpenScratch(task.scratch.root, task.scratch.attempt))
    groups = [group.sites(task.scratch) for group in (*task.own, *task.others)]
    sites = [site for group in groups for site in group]
    owned = sum(len(group) for group in groups[: len(task.own)])
    warnings: list[str] = []
    outlines = _outlines_of(sites, owned, task, warnings)
    changed: dict[int, tuple[CandidateSite, ...]] = {}
    for number, group in enumerate(groups[: len(task.own)]):
        new = tuple(dataclasses.replace(site, outline=outlines.get(site.building_id, site.outline)) for site in group)
        if any(site.building_id in outlines for site in group):
            changed[number] = new
    figures = {number: group_figures(group, task.grid) for number, group in changed.items()}
    return InParts(parts=tuple(changed.values()), brief=TouchBrief(groups=figures, warnings=tuple(warnings)))


def _outlines_of(
    sites: Sequence[CandidateSite], owned: int, task: TouchTask, warnings: list[str]
) -> dict[str, MultiPolygon]:
    """The outlines, metres, of those of the first `owned` sites that end near others, by their building_id.

    What fails without a known reason leaves its candidates as they are drawn alone, or cut, with a warning.
    """
    all_pairs = near_pairs(sites)
    compared = set(all_pairs[all_pairs[:, 0] < owned].ravel().tolist())
    # units of a block that others own are not compared with its own ones, but may lie beside what is
    blocks = {site.block for site in sites[:owned]} - {None}
    compared |= {k for k, site in enumerate(sites) if site.outline is not None and site.block in blocks}
    drawn: dict[int, MultiPolygon] = {}
    extents = _Extents(all_pairs, sites, task.scratch)
    for k in sorted(compared):
        task.scratch.check_cancelled()
        if sites[k].outline is not None or extents.come_near(k):
            outline_mm = _or_warned(warnings, (sites[k],), functools.partial(_drawn_mm, sites[k], task))
            if outline_mm is not None:
                drawn[k] = outline_mm
            extents.set(k, shapely.get_coordinates(outline_mm), 0.0)
    all_pairs = np.array([(i, j) for i, j in all_pairs.tolist() if i in drawn and j in drawn], np.int64).reshape(-1, 2)
    first, second = (np.array([drawn[k] for k in column.tolist()], object) for column in all_pairs.T)
    taken = _taken(all_pairs[shapely.dwithin(first, second, GAP_MM)].tolist(), sites, owned, drawn, task, warnings)
    is_own = all_pairs[:, 0] < owned
    near = all_pairs[is_own & shapely.dwithin(first, second, _BESIDE_MM)]
    close = all_pairs[is_own & shapely.dwithin(first, second, _CLOSE_MM)]

    @functools.lru_cache(maxsize=_HELD)
    def claim(k: int) -> Claim:
        points = points_of(task.scratch, sites[k])
        places: IntArray = np.column_stack([points[axis] for axis in "xyz"]).astype(np.int64)
        return Claim(name=sites[k].building_id, outline_mm=drawn[k], points_mm=places)

    def of_pair(i: int, j: int) -> tuple[MultiPolygon, MultiPolygon]:
        first, second = (
            dataclasses.replace(claim(k), outline_mm=united(drawn[k], pieces)) if pieces else claim(k)
            for k, pieces in ((i, taken.get((i, j))), (j, taken.get((j, i))))
        )
        return divided(first, second)

    # other units of its block were not compared with a unit: it keeps within its part of the block
    kept = {k: {k: shape} if sites[k].block is not None else {} for k, shape in drawn.items()}
    for i, j in sorted({*map(tuple, close.tolist()), *((i, j) for i, j in taken if i < j and i < owned)}):
        task.scratch.check_cancelled()
        parts = _or_warned(warnings, (sites[i], sites[j]), functools.partial(of_pair, i, j))
        if parts is not None:
            kept[i][j], kept[j][i] = parts
        else:  # the first by id has all of the overlap
            one, other = sorted((i, j), key=lambda k: sites[k].building_id)
            kept[one][other], kept[other][one] = drawn[one], _apart(drawn[other], [drawn[one]])
    outlines = {}
    for k in np.unique(near).tolist():
        if k < owned:
            gained = {j: pieces for (of, j), pieces in taken.items() if of == k}
            limits = [
                widened(shape, [piece for other, pieces in gained.items() if other != j for piece in pieces])
                for j, shape in kept[k].items()
            ]
            cut = functools.partial(left_of, drawn[k], limits, task.roof.min_part_area_m2)
            apart = _or_warned(warnings, (sites[k],), cut)
            if apart is None:
                apart = _apart(drawn[k], [kept[j][k] for j in kept[k] if j != k])
            outlines[sites[k].building_id] = shapely.transform(apart, lambda xy: xy / MM)
    return outlines


class _Extents:
    """How far sites may reach in some directions: a site that is apart from all others in any of them is not drawn."""

    def __init__(self, pairs: IntArray, sites: Sequence[CandidateSite], scratch: Scratch) -> None:
        """Pairs (n, 2) are those sites, by their numbers, whose boxes meet."""
        self._pairs = pairs
        self._reach, self._farthest = np.zeros(len(sites)), np.zeros((len(sites), _DIRECTIONS))
        angles = np.arange(_DIRECTIONS) * (2.0 * math.pi / _DIRECTIONS)
        self._directions = np.array([np.cos(angles), np.sin(angles)])
        for k in np.unique(pairs).tolist():
            if sites[k].outline is not None:
                self.set(k, shapely.get_coordinates(sites[k].outline) * MM, 0.0)
            elif (box := sites[k].reach_mm) is not None:
                points = stored_points(scratch, sites[k])
                xy = np.column_stack((points["x"], points["y"])).astype(np.float64)
                self.set(k, xy, float(xy[:, 0].min() - box[0]))

    def set(self, k: int, xy_mm: FloatArray, reach_mm: float) -> None:
        """Site k covers places (n, 2), and others so near to these at most; nothing if there is none."""
        self._farthest[k] = (xy_mm @ self._directions).max(axis=0, initial=-math.inf)
        self._reach[k] = reach_mm

    def come_near(self, k: int) -> bool:
        """Whether site k may come as near to another one as outlines are compared."""
        first, second = self._pairs[(self._pairs == k).any(axis=1)].T
        gap = -self._farthest[first] - np.roll(self._farthest[second], _DIRECTIONS // 2, axis=1)
        return bool((gap <= (self._reach[first] + self._reach[second] + _BESIDE_MM + 1.0)[:, None]).all(axis=1).any())


def _apart(outline_mm: MultiPolygon, others: Sequence[MultiPolygon]) -> MultiPolygon:
    """An outline without others, whatever corners that leaves: models do not overlap even after a fault."""
    return MultiPolygon([part for one in outline_mm.geoms for part in without(one, np.array(others, dtype=object))])


def _taken(
    pairs: Sequence[Sequence[int]],
    sites: Sequence[CandidateSite],
    owned: int,
    drawn: Mapping[int, MultiPolygon],
    task: TouchTask,
    warnings: list[str],
) -> dict[tuple[int, int], list[shapely.Polygon]]:
    """What the first of two candidates takes of the slits beside the second, and the second beside the first.

    It keeps away from third outlines, and from the areas between others.
    """
    ordered = [(j, i) if sites[j].building_id < sites[i].building_id else (i, j) for i, j in pairs]
    around = {}
    for i, j in ordered:
        areas = functools.partial(between, drawn[i], drawn[j])
        around[i, j] = _or_warned(warnings, (sites[i], sites[j]), areas) or []
    taken: dict[tuple[int, int], list[shapely.Polygon]] = {}
    own = [pair for pair in around if min(pair) < owned and around[pair]]
    number, outlines = np.array(list(drawn)), np.array(list(drawn.values()), dtype=object)
    member = np.array([pair for pair, areas in around.items() for _ in areas], np.int64).reshape(-1, 2)
    area = np.array([area for areas in around.values() for area in areas], dtype=object)
    for (i, j), found in _slits(own, area, member, sites, drawn, task, warnings).items():
        parts = _or_warned(warnings, (sites[i], sites[j]), functools.partial(closed, drawn[i], drawn[j], found))
        for k, other, pieces in zip((i, j), (j, i), parts or ([], []), strict=True):
            taken[k, other] = []
            if pieces:
                third = np.concatenate((outlines[~np.isin(number, (i, j))], area[(member != k).all(axis=1)]))
                taken[k, other] = [part for piece in pieces for part in without(piece, third)]
    return taken


def _slits(
    pairs: Sequence[tuple[int, int]],
    area: npt.NDArray[np.object_],
    member: IntArray,
    sites: Sequence[CandidateSite],
    drawn: Mapping[int, MultiPolygon],
    task: TouchTask,
    warnings: list[str],
) -> dict[tuple[int, int], list[Slit]]:
    """The slits between pairs of outlines that a wall or a roof fills, by pair: points lie in them, but no ground.

    Those narrower than the point spacing may be empty. Areas (n,) lie between the outlines of all pairs, `member`
    (n, 2). A task knows all outlines that reach into the boxes of both, so another task finds the same slits.
    """

    def of_pair(i: int, j: int) -> list[Slit]:
        known = shapely.intersection(*(shapely.box(*(sites[k].reach_mm or ())) for k in (i, j)))
        third = [outlines[k] for k in sorted(tree.query(known, "intersects").tolist()) if numbers[k] not in (i, j)]
        third = [one for one in third if shapely.dwithin(one, (drawn[i], drawn[j]), _BESIDE_MM).any()]
        is_own = (member == (i, j)).all(axis=1)
        others = area[~is_own & shapely.intersects(area, known)].tolist()
        return slits((drawn[i], drawn[j]), area[is_own].tolist(), shapely.buffer(known, -GAP_MM), third, others)

    numbers, outlines = list(drawn), list(drawn.values())
    tree = shapely.STRtree(outlines)
    found = {}
    for i, j in pairs:
        found[i, j] = _or_warned(warnings, (sites[i], sites[j]), functools.partial(of_pair, i, j)) or []
    shown = [shape for pair in pairs for slit in found[pair] for shape in (slit.area_mm, *slit.strips_mm)]
    heights = iter(_heights_in(shown, task) if shown else ())
    built: dict[tuple[int, int], list[Slit]] = {}
    for pair in pairs:
        per_mm2 = sum(sites[k].points for k in pair) / sum(drawn[k].area for k in pair)
        shown_in = [(slit, [next(heights) for _ in range(3)]) for slit in found[pair]]
        built[pair] = [
            _without_ground(slit, of_strips) for slit, (own, *of_strips) in shown_in if _is_built(slit, own, per_mm2)
        ]
    return built


def _is_built(slit: Slit, heights_mm: IntArray, per_mm2: float) -> bool:
    """Whether a slit holds points, but no ground; one narrower than the spacing of so many points may be empty."""
    is_thin = (2.0 * slit.area_mm.area / slit.area_mm.length) ** 2 * per_mm2 < 1.0
    least = 0.0 if is_thin else max(1.0, _LEAST_SEEN * per_mm2 * slit.area_mm.area)
    return len(heights_mm) >= least and not _is_ground(heights_mm)


def _without_ground(slit: Slit, of_strips: Sequence[IntArray]) -> Slit:
    """A slit whose strips hold no ground: the area itself in place of one that does."""
    first, second = (
        slit.area_mm if _is_ground(heights_mm) else strip
        for strip, heights_mm in zip(slit.strips_mm, of_strips, strict=True)
    )
    return dataclasses.replace(slit, strips_mm=(first, second))


def _is_ground(heights_mm: IntArray) -> bool:
    return bool(np.count_nonzero(heights_mm < _GROUND_MM) > _MOST_GROUND * len(heights_mm))


def _heights_in(areas_mm: Sequence[shapely.Polygon], task: TouchTask) -> list[IntArray]:
    """The heights of single and last returns above known terrain, millimetres, by the area that holds them."""
    west, south, east, north = (round(value) for value in shapely.total_bounds(areas_mm))
    around = surroundings_of(task.scratch, task.grid, Window(x0_mm=west, y0_mm=south, x1_mm=east + 1, y1_mm=north + 1))
    boxes = shapely.bounds(areas_mm).astype(np.int64) // CELL_MM - np.tile([around.column0, around.row0], 2)
    cells = np.zeros_like(around.occupied)
    for x0, y0, x1, y1 in boxes.tolist():
        cells[y0 : y1 + 1, x0 : x1 + 1] = True
    places = np.concatenate(points_beside(task.scratch, task.grid, np.empty((0, 3), np.int64), cells, around))
    columns, rows = (places[:, :2] // CELL_MM - [around.column0, around.row0]).T
    terrain_mm = around.elevation_mm[rows, columns].astype(np.int64)
    places, heights_mm = places[terrain_mm != NO_DATA], (places[:, 2] - terrain_mm)[terrain_mm != NO_DATA]
    area, inside = shapely.STRtree(shapely.points(places[:, :2])).query(areas_mm, predicate="contains")
    return [heights_mm[inside[area == k]] for k in range(len(areas_mm))]


def _or_warned(warnings: list[str], sites: Sequence[CandidateSite], draw: Callable[[], Result]) -> Result | None:
    """What a function returns; None, and a warning that names the candidates, for a fault that nothing foresaw."""
    try:
        return draw()
    except (MemoryError, OSError, GableworkError):
        raise
    except Exception as error:  # noqa: BLE001 - becomes a warning of the run
        names = ", ".join(site.building_id for site in sites)
        warnings.append(f"the outlines of {names} are not fitted to others: {type(error).__name__}: {error}")
        return None


def _drawn_mm(site: CandidateSite, task: TouchTask) -> MultiPolygon | None:
    """The outline of a candidate without regard to others, integer millimetres of the CRS; None where none is drawn."""
    if site.outline is not None:
        return shapely.transform(site.outline, lambda xy: np.rint(xy * MM))
    if site.points < task.roof.min_points:
        return None
    candidate, facts = gather(task.scratch, task.grid, site, GpsTimeKind.NONE, task.roof)
    key = facts.input_hash, candidate.ground_z_m, task.roof
    if key not in _drawn_before:
        if len(_drawn_before) >= _MOST_BEFORE:
            _drawn_before.clear()
        _drawn_before[key] = _drawn_alone_mm(candidate, task.roof)
    return _drawn_before[key]


def _drawn_alone_mm(candidate: Candidate, settings: RoofSettings) -> MultiPolygon | None:
    """The same from the points of the candidate."""
    try:
        outline_mm = drawn_outline(roof_points(prepare_cloud(candidate, settings.max_points), settings), settings)
    except (BuildingError, shapely.errors.GEOSException):
        return None
    corner = np.array(candidate.origin[:2]) * MM
    if not outline_mm.is_valid:  # a raw outline may cross itself
        outline_mm = MultiPolygon(polygons_of(shapely.set_precision(shapely.make_valid(outline_mm), 1.0)))
    return shapely.transform(outline_mm, lambda xy: xy + corner)
