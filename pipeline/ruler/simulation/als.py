"""An airborne laser scanner over a scene: parallel strips, scan lines, beams with a footprint, several returns.

Every pulse draws its random numbers from a state of its own (seed, strip, line, pulse). Its measurement depends neither
on the order nor on the chunks in which the pulses are made.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.model import BoolArray, ByteArray, FloatArray, LabelArray, PointCloud
from pipeline.ruler.simulation.beam import COLUMNS, MAX_RETURNS, FlightLine, Survey, scan_lines
from pipeline.ruler.simulation.scene_arrays import SceneArrays, scene_arrays
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.strips import ScannerSettings, flight_lines, lines_over, reach_m
from pipeline.ruler.simulation.survey_faults import fault_rows, move_faulty

__all__ = ["ScanBlock", "ScannerSettings", "joined", "reach_m", "scan", "scan_all", "strip_count"]

_PULSES_PER_BLOCK = 131_072
"""Work unit of a thread, which bounds its memory."""

_Job = tuple[FlightLine, range]
"""Consecutive scan lines of one strip."""


class _Beneath(NamedTuple):
    """A scene without its glass."""

    arrays: SceneArrays
    number_of: LabelArray
    """(n,) int32, number in the scene of each building that is left."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScanBlock:
    """Returns in the order of time, with their truth. All arrays have one length n."""

    points: PointCloud
    """CRS coordinates; classification is the true one: 1 small things, 2 ground, 5 vegetation, 6 building."""
    intensity: npt.NDArray[np.uint16]
    """(n,) uint16, share of the beam times the surface's reflectance."""
    scan_angle_deg: FloatArray
    """(n,) float64, from nadir, positive to the right of the flight."""
    building: LabelArray
    """(n,) int32, number of the building that was hit; -1 for none."""
    face: LabelArray
    """(n,) int32, number of its roof face; -1 for walls and other objects."""
    mixed: BoolArray
    """(n,) bool, True where echoes of different surfaces melted into this return."""

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.points)

    @property
    def wall(self) -> BoolArray:
        """(n,) bool, True where a wall was hit."""
        return (self.building >= 0) & (self.face < 0)


def strip_count(scene: Scene, settings: ScannerSettings) -> int:
    """Number of strips flown over the scene, or over the survey of which it is a tile."""
    return len(flight_lines(scene, settings, 0))


def scan(
    scene: Scene, settings: ScannerSettings, seed: int, *, chunk_points: int = 1_000_000, threads: int = 2
) -> Iterator[ScanBlock]:
    """Scan a scene, chunk by chunk, in the order of time.

    A scene with a `survey_extent` is one tile of a survey: the strips are laid over the whole, and exactly those pulses
    are fired that aim into the tile, so that the tiles together give the returns of the whole. For that each tile holds
    all objects and survey faults within `reach_m` of its extent, in one order everywhere.

    The content depends on scene, settings and seed alone. Each chunk except the last has at least `chunk_points`
    returns and at most some 100,000 more; a scene without any return yields nothing. `threads` work ahead, which costs
    memory. Raises SettingsError if the terrain is so steep that beams graze it.
    """
    margin_m = settings.beam_radius_m + settings.pulse_spacing_m
    arrays = scene_arrays(scene, settings.max_lean, margin_m, settings.beam_radius_m)
    opaque = tuple(number for number, building in enumerate(scene.buildings) if building.glass_share == 0.0)
    beneath = None
    if len(opaque) < len(scene.buildings):
        without = dataclasses.replace(scene, buildings=tuple(scene.buildings[number] for number in opaque))
        beneath = _Beneath(
            arrays=scene_arrays(without, settings.max_lean, margin_m, settings.beam_radius_m),
            number_of=np.array(opaque, dtype=np.int32),
        )
    survey = _survey(scene, settings, seed)
    strips = strip_count(scene, settings)
    jobs = _jobs(scene, settings, seed, min(_PULSES_PER_BLOCK, chunk_points) // survey.pulses_per_line)
    pending: list[ScanBlock] = []
    for block in _in_order(jobs, functools.partial(_block, scene, (arrays, beneath), survey, strips), threads):
        if len(block):
            pending.append(block)
        if sum(len(one) for one in pending) >= chunk_points:
            yield joined(pending)
            pending = []
    if pending:
        yield joined(pending)


def scan_all(scene: Scene, settings: ScannerSettings, seed: int) -> ScanBlock:
    """The whole scan in memory, for small scenes; ValueError if no pulse hit the scene's extent."""
    blocks = list(scan(scene, settings, seed))
    if not blocks:
        raise ValueError(f"no pulse of {settings.pulse_density_per_m2:g} per m2 hit the extent {scene.extent}")
    return joined(blocks)


def joined(blocks: list[ScanBlock]) -> ScanBlock:
    """Blocks one after the other, as one."""
    if len(blocks) == 1:
        return blocks[0]
    clouds = [block.points for block in blocks]
    points = PointCloud(
        **{f.name: np.concatenate([getattr(c, f.name) for c in clouds]) for f in dataclasses.fields(PointCloud)}
    )
    others = [f.name for f in dataclasses.fields(ScanBlock) if f.name != "points"]
    return ScanBlock(points=points, **{name: np.concatenate([getattr(b, name) for b in blocks]) for name in others})


def _survey(scene: Scene, settings: ScannerSettings, seed: int) -> Survey:
    spacing = settings.pulse_spacing_m
    return Survey(
        spacing=spacing,
        half_swath=settings.half_swath_m,
        altitude=settings.altitude_m,
        jitter=settings.jitter,
        range_noise=settings.range_noise_m,
        beam_radius=settings.beam_radius_m,
        range_resolution=settings.range_resolution_m,
        drop_out=settings.drop_out,
        speed=settings.speed_m_s,
        wrong_row_share=settings.wrong_row_share,
        wrong_row_lift=settings.wrong_row_lift_m,
        pulses_per_line=math.ceil(2 * settings.half_swath_m / spacing),
        extent=np.array(scene.extent, dtype=np.float64),
        seed=seed,
    )


def _jobs(scene: Scene, settings: ScannerSettings, seed: int, lines_per_block: int) -> Iterator[_Job]:
    step = max(1, lines_per_block)
    for line in flight_lines(scene, settings, seed):
        needed = lines_over(line, scene, settings)
        for first in needed[::step]:
            yield line, range(first, min(first + step, needed.stop))


def _in_order(jobs: Iterator[_Job], block_of: Callable[[_Job], ScanBlock], threads: int) -> Iterator[ScanBlock]:
    """Blocks in the order of the jobs, a bounded number in flight."""
    if threads < 2:
        yield from map(block_of, jobs)
        return
    with ThreadPoolExecutor(threads) as pool:
        running: deque[Future[ScanBlock]] = deque()
        for job in jobs:
            running.append(pool.submit(block_of, job))
            if len(running) > threads:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()


def _block(
    scene: Scene, seen: tuple[SceneArrays, _Beneath | None], survey: Survey, strips: int, job: _Job
) -> ScanBlock:
    """Scan some lines of one of the strips; the scene, and what is beneath its glass if it has any."""
    flight, _ = job
    arrays, beneath = seen
    floats, integers = _scanned(arrays, survey, job)
    if beneath is not None:
        under, hit = _scanned(beneath.arrays, survey, job)
        on_building = hit[:, 4] >= 0
        hit[on_building, 4] = beneath.number_of[hit[on_building, 4]]
        floats, integers = _through_glass(scene, (floats, integers), (under, hit))
    count = len(floats)
    faults = fault_rows(scene.survey_faults, floats)
    strip = np.full(count, flight.number, np.int32)
    if len(faults):
        lines_of = np.ascontiguousarray(integers[:, 7])
        others = move_faulty(floats, lines_of, faults, survey.seed, flight.number)
        strip = np.where(others >= 0, strips + others, strip)
    return _as_block(floats, integers, scene, strip)


def _scanned(arrays: SceneArrays, survey: Survey, job: _Job) -> tuple[FloatArray, LabelArray]:
    """The columns that `scan_lines` writes, for some lines of a strip."""
    flight, lines = job
    capacity = len(lines) * survey.pulses_per_line * MAX_RETURNS
    floats, integers = np.empty((capacity, 5)), np.empty((capacity, COLUMNS), np.int32)
    count = scan_lines(arrays, flight, survey, lines.start, lines.stop, floats, integers)
    return floats[:count], integers[:count]


def _through_glass(
    scene: Scene, over: tuple[FloatArray, LabelArray], under: tuple[FloatArray, LabelArray]
) -> tuple[FloatArray, LabelArray]:
    """The returns of a scene with glass: of each pulse those from on it (`over`) or from beneath it (`under`).

    A pulse that hits glass goes through with its chance, which is drawn from its time. Both surveys fired the same
    pulses at the same times.
    """
    shares = np.array([building.glass_share for building in scene.buildings])
    floats, integers = over
    is_roof = (integers[:, 4] >= 0) & (integers[:, 5] >= 0)
    share = np.where(is_roof, shares[np.maximum(integers[:, 4], 0)], 0.0)
    gone = np.unique(floats[_chance_of(floats[:, 3]) < share, 3])
    stays, comes = ~np.isin(floats[:, 3], gone), np.isin(under[0][:, 3], gone)
    columns = np.concatenate([floats[stays], under[0][comes]])
    numbers = np.concatenate([integers[stays], under[1][comes]])
    order = np.lexsort((numbers[:, 0], columns[:, 3]))
    return columns[order], numbers[order]


def _chance_of(time: FloatArray) -> FloatArray:
    """A number in [0, 1) for each time (n,), from the bits of it (Steele, Lea, Flood 2014)."""
    bits = np.ascontiguousarray(time).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    chance: FloatArray = (bits ^ (bits >> np.uint64(31))) / 2.0**64
    return chance


def _as_block(floats: FloatArray, integers: LabelArray, scene: Scene, strip: LabelArray) -> ScanBlock:
    def byte(column: int) -> ByteArray:
        return integers[:, column].astype(np.uint8)

    points = PointCloud(
        xyz=np.round(floats[:, :3] + np.array(scene.origin), 3),
        return_number=byte(0),
        return_count=byte(1),
        classification=byte(2),
        gps_time=floats[:, 3].copy(),
        source_id=(strip + 1).astype(np.uint16),
    )
    return ScanBlock(
        points=points,
        intensity=integers[:, 3].astype(np.uint16),
        scan_angle_deg=floats[:, 4].copy(),
        building=integers[:, 4].copy(),
        face=integers[:, 5].copy(),
        mixed=integers[:, 6].astype(np.bool_),
    )
