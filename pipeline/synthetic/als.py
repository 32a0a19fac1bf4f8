"""An airborne laser scanner over a scene: parallel strips, scan lines, beams with a footprint, several returns.

Every pulse draws its random numbers from a state of its own (seed, strip, line, pulse), so what it measures depends
neither on the order nor on the chunks in which the pulses are made.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from pipeline.model import BoolArray, ByteArray, FloatArray, LabelArray, PointCloud
from pipeline.parameters import Parameters, parameter
from pipeline.synthetic.beam import COLUMNS, MAX_RETURNS, FlightLine, scan_lines
from pipeline.synthetic.scene import Scene
from pipeline.synthetic.scene_arrays import SceneArrays, scene_arrays

_FIRST_GPS_TIME_S = 427_536_018.0
"""Start of the first strip: 1 April 2025, 10:00 UTC, as adjusted standard GPS time."""
_TURN_S = 120.0
"""From the end of a strip to the start of the next."""
_PULSES_A_BLOCK = 131_072
"""Work unit of a thread: it holds at most this many pulses in memory."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScannerSettings(Parameters):
    """The survey: instrument, flight and noise."""

    pulse_density_per_m2: float = parameter(
        8.0, "Pulses a square metre of one strip.", unit="1/m2", minimum=0.01, maximum=500.0
    )
    range_noise_m: float = parameter(0.03, "Standard deviation along the beam.", unit="m", minimum=0.0, maximum=2.0)
    altitude_m: float = parameter(600.0, "Flying height over the terrain's base.", unit="m", minimum=50.0)
    strip_spacing_m: float = parameter(120.0, "Distance of neighbouring flight lines.", unit="m", minimum=5.0)
    strip_overlap: float = parameter(
        0.15, "Share by which the swath is wider than the spacing.", minimum=0.0, maximum=2.0
    )
    flight_azimuth_deg: float = parameter(
        0.0, "Direction of the strips, clockwise from north.", unit="deg", minimum=0.0, maximum=360.0
    )
    jitter: float = parameter(
        0.5,
        "Random shift of each pulse along and across the line, as a share of the spacing.",
        minimum=0.0,
        maximum=1.0,
    )
    beam_radius_m: float = parameter(0.12, "Radius of the beam's footprint.", unit="m", minimum=0.0, maximum=2.0)
    range_resolution_m: float = parameter(
        1.2, "Echoes of one beam that are closer than this melt into one return.", unit="m", minimum=0.0, maximum=10.0
    )
    drop_out: float = parameter(0.005, "Share of pulses that never come back.", minimum=0.0, maximum=1.0)
    strip_shift_m: float = parameter(
        0.0, "Standard deviation of a strip's own horizontal shift, each axis.", unit="m", minimum=0.0, maximum=5.0
    )
    strip_lift_m: float = parameter(
        0.0, "Standard deviation of a strip's own vertical shift.", unit="m", minimum=0.0, maximum=5.0
    )
    speed_m_s: float = parameter(60.0, "Speed of the aircraft.", unit="m/s", minimum=1.0, maximum=500.0)

    @property
    def half_swath_m(self) -> float:
        """Half the width of a strip on the ground."""
        return self.strip_spacing_m * (1.0 + self.strip_overlap) / 2.0

    @property
    def max_lean(self) -> float:
        """Tangent of the largest scan angle."""
        return self.half_swath_m / self.altitude_m

    @property
    def pulse_spacing_m(self) -> float:
        """Distance of scan lines, and of pulses in a line."""
        return 1.0 / math.sqrt(self.pulse_density_per_m2)


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
    """(n,) int32, number of its roof face; -1 for walls and for what is no building."""
    mixed: BoolArray
    """(n,) bool, True where echoes of different surfaces melted into this return."""

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.points)

    @property
    def wall(self) -> BoolArray:
        """(n,) bool, True where a wall was hit."""
        return (self.building >= 0) & (self.face < 0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Job:
    """Consecutive scan lines of one strip."""

    line: FlightLine
    first: int
    stop: int


def strip_count(scene: Scene, settings: ScannerSettings) -> int:
    """Number of strips that cover the scene."""
    return len(_flight_lines(scene, settings, 0))


def scan(
    scene: Scene, settings: ScannerSettings, seed: int, *, chunk_points: int = 1_000_000, threads: int = 2
) -> Iterator[ScanBlock]:
    """Scan a scene, chunk by chunk, in the order of time.

    Parameters
    ----------
    scene : Scene
        What is scanned.
    settings : ScannerSettings
        The survey.
    seed : int
        Seed of the scanner; content depends on nothing but scene, settings and seed.
    chunk_points : int
        At least so many returns a chunk (the last may be smaller); at most some 100,000 more.
    threads : int
        Threads that work ahead; memory grows with them, content does not change.

    Yields
    ------
    ScanBlock
        A chunk of returns. A scene without any return yields nothing.
    """
    arrays = scene_arrays(scene, settings.max_lean, settings.beam_radius_m + settings.pulse_spacing_m)
    pending: list[ScanBlock] = []
    for block in _in_order(_jobs(scene, settings, seed, chunk_points), arrays, scene, settings, seed, threads):
        if len(block):
            pending.append(block)
        if sum(len(one) for one in pending) >= chunk_points:
            yield joined(pending)
            pending = []
    if pending:
        yield joined(pending)


def scan_all(scene: Scene, settings: ScannerSettings, seed: int) -> ScanBlock:
    """The whole scan in memory: for small scenes.

    Raises
    ------
    ValueError
        If no pulse hit the scene's extent.
    """
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


def _flight_lines(scene: Scene, settings: ScannerSettings, seed: int) -> list[FlightLine]:
    """The strips, every second one flown backwards."""
    azimuth = math.radians(settings.flight_azimuth_deg)
    along = np.array([math.sin(azimuth), math.cos(azimuth)])
    across = np.array([along[1], -along[0]])
    x0, y0, x1, y1 = scene.extent
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    low, high = (corners @ across).min(), (corners @ across).max()
    start, end = (corners @ along).min() - settings.pulse_spacing_m, (corners @ along).max() + settings.pulse_spacing_m
    count = max(1, math.ceil((high - low) / settings.strip_spacing_m))
    first = (low + high) / 2 - (count - 1) / 2 * settings.strip_spacing_m
    random = np.random.default_rng([seed, 0x57])
    time, lines = _FIRST_GPS_TIME_S, []
    for k in range(count):
        sign = 1.0 if k % 2 == 0 else -1.0
        shift = random.normal(0.0, 1.0, 3) * (settings.strip_shift_m, settings.strip_shift_m, settings.strip_lift_m)
        middle = across * (first + k * settings.strip_spacing_m)
        begin = middle + along * (start if sign > 0 else end)
        lines.append(
            FlightLine(
                number=k,
                x=float(begin[0]),
                y=float(begin[1]),
                along_x=float(sign * along[0]),
                along_y=float(sign * along[1]),
                length=float(end - start),
                time=time,
                shift_x=float(shift[0]),
                shift_y=float(shift[1]),
                shift_z=float(shift[2]),
            )
        )
        time += (end - start) / settings.speed_m_s + _TURN_S
    return lines


def _jobs(scene: Scene, settings: ScannerSettings, seed: int, chunk_points: int) -> Iterator[_Job]:
    spacing = settings.pulse_spacing_m
    per_line = math.ceil(2 * settings.half_swath_m / spacing)
    step = max(1, min(_PULSES_A_BLOCK, chunk_points) // per_line)
    for line in _flight_lines(scene, settings, seed):
        count = math.ceil(line.length / spacing)
        for first in range(0, count, step):
            yield _Job(line=line, first=first, stop=min(first + step, count))


def _in_order(
    jobs: Iterator[_Job], arrays: SceneArrays, scene: Scene, settings: ScannerSettings, seed: int, threads: int
) -> Iterator[ScanBlock]:
    """Blocks in the order of the jobs, a bounded number in flight."""
    if threads < 2:
        for job in jobs:
            yield _block(job, arrays, scene, settings, seed)
        return
    with ThreadPoolExecutor(threads) as pool:
        running: deque[Future[ScanBlock]] = deque()
        for job in jobs:
            running.append(pool.submit(_block, job, arrays, scene, settings, seed))
            if len(running) > threads:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()


def _block(job: _Job, arrays: SceneArrays, scene: Scene, settings: ScannerSettings, seed: int) -> ScanBlock:
    """Scan some lines of a strip."""
    spacing = settings.pulse_spacing_m
    per_line = math.ceil(2 * settings.half_swath_m / spacing)
    capacity = (job.stop - job.first) * per_line * MAX_RETURNS
    floats = np.empty((capacity, 5))
    integers = np.empty((capacity, COLUMNS), np.int32)
    survey = np.array(
        [
            spacing,
            settings.half_swath_m,
            settings.altitude_m,
            settings.jitter,
            settings.range_noise_m,
            settings.beam_radius_m,
            settings.range_resolution_m,
            settings.drop_out,
            settings.speed_m_s,
        ]
    )
    count = scan_lines(
        arrays, job.line, survey, np.array(scene.extent), seed, job.first, job.stop, per_line, floats, integers
    )
    return _as_block(floats[:count], integers[:count], scene, job.line.number)


def _as_block(floats: FloatArray, integers: LabelArray, scene: Scene, strip: int) -> ScanBlock:
    def byte(column: int) -> ByteArray:
        return integers[:, column].astype(np.uint8)

    points = PointCloud(
        xyz=np.round(floats[:, :3] + np.array(scene.origin), 3),
        return_number=byte(0),
        return_count=byte(1),
        classification=byte(2),
        gps_time=floats[:, 3].copy(),
        source_id=np.full(len(floats), strip + 1, np.uint16),
    )
    return ScanBlock(
        points=points,
        intensity=integers[:, 3].astype(np.uint16),
        scan_angle_deg=floats[:, 4].copy(),
        building=integers[:, 4].copy(),
        face=integers[:, 5].copy(),
        mixed=integers[:, 6].astype(np.bool_),
    )
