"""The picture of a run: it shows what is there, by its colours, and nothing else."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
import small_buildings as small
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import PathPatch

from pipeline.errors import RunError
from pipeline.model import FaceKind, RoofType
from pipeline.report.palette import ROOF_COLOURS
from pipeline.report.perspective import MAP_SUN, View, ViewedFace, draw_view, lambert
from pipeline.report.pictures import drawn_path, paths_of
from pipeline.report.render import FAILED_COLOUR, render_run

TRUTH_COLOUR = "#0050a0"
DPI = 50
LEGEND_TOP = 0.94
"""The legend lies below this share of the picture's height."""


def pixels_of(png: Path) -> np.ndarray:
    """The picture above the legend, (h, w, 3) from 0 to 1."""
    picture = imread(png)[:, :, :3]
    return picture[: int(LEGEND_TOP * len(picture))]


def count(picture: np.ndarray, colour: str) -> int:
    """Pixels that have a colour's hue, in any light."""
    wanted = np.array(to_rgb(colour))
    brightness = picture.max(axis=2) / wanted.max()
    near = np.abs(picture / np.maximum(brightness, 1e-9)[:, :, None] - wanted).max(axis=2) < 0.03
    return int(np.sum(near & (brightness > 0.4)))


def faces_of(solid: small.Solid, colour: str = "#ffffff") -> list[ViewedFace]:
    """All faces of a solid in one colour."""
    return [
        ViewedFace(rings=tuple(solid.vertices[list(ring)] for ring in face.rings), colour=colour)
        for face in solid.faces
    ]


def test_roof_types_have_their_colours_and_absent_ones_do_not_show(street_run: Path, tmp_path: Path) -> None:
    render_run(street_run, tmp_path / "run.png", dpi=DPI)
    picture = pixels_of(tmp_path / "run.png")
    assert count(picture, ROOF_COLOURS[RoofType.GABLE]) > 800
    assert count(picture, ROOF_COLOURS[RoofType.FLAT]) > 800
    assert count(picture, ROOF_COLOURS[RoofType.PENT]) == 0
    assert count(picture, ROOF_COLOURS[RoofType.HIP]) == 0


def test_a_failed_candidate_is_hatched_in_red(make_run: Callable[..., Path], street_run: Path, tmp_path: Path) -> None:
    render_run(street_run, tmp_path / "with.png", dpi=DPI)
    render_run(make_run([small.gable()], "sound"), tmp_path / "without.png", dpi=DPI)
    assert count(pixels_of(tmp_path / "with.png"), FAILED_COLOUR) > 40
    assert count(pixels_of(tmp_path / "without.png"), FAILED_COLOUR) == 0


def test_truth_is_drawn_over_the_map(make_run: Callable[..., Path], street_run: Path, tmp_path: Path) -> None:
    render_run(street_run, tmp_path / "alone.png", dpi=DPI)
    render_run(street_run, tmp_path / "truth.png", truth=make_run([small.gable()], "truth"), dpi=DPI)
    assert count(pixels_of(tmp_path / "alone.png"), TRUTH_COLOUR) == 0
    assert count(pixels_of(tmp_path / "truth.png"), TRUTH_COLOUR) > 20


def test_a_run_in_feet_looks_as_one_in_metres(make_run: Callable[..., Path], tmp_path: Path) -> None:
    pictures = []
    for unit_m in (1.0, 0.3048):
        run = make_run([small.gable()], f"run{unit_m}", unit_m)
        render_run(run, tmp_path / "unit.png", dpi=DPI)
        pictures.append(pixels_of(tmp_path / "unit.png"))
    assert np.mean(np.abs(pictures[0] - pictures[1]) > 0.02) < 0.002


def test_coarser_levels_of_detail_are_not_drawn_over_the_finest(make_run: Callable[..., Path], tmp_path: Path) -> None:
    pictures = []
    for name, result in (("all", small.levelled()), ("finest", dataclasses.replace(small.levelled(), coarser=()))):
        render_run(make_run([result], name), tmp_path / f"{name}.png", dpi=DPI)
        pictures.append(pixels_of(tmp_path / f"{name}.png"))
    assert np.array_equal(*pictures)


def test_a_run_without_models_still_gives_a_picture(make_run: Callable[..., Path], tmp_path: Path) -> None:
    render_run(make_run([]), tmp_path / "empty.png", dpi=DPI)
    render_run(make_run([small.failed()], "failed"), tmp_path / "failed.png", dpi=DPI)
    for name in ("empty", "failed"):
        assert imread(tmp_path / f"{name}.png").shape[:2] == (525, 1000)


def test_a_wide_run_shows_its_densest_square(make_run: Callable[..., Path], tmp_path: Path) -> None:
    def at(name: str, east: float, north: float) -> small.BuildingResult:
        return dataclasses.replace(small.gable(name), origin=(85_000.0 + east, 447_000.0 + north, 2.0))

    lonely = at("lonely", 2000.0, 1500.0)
    together = [at(f"house{i}", 15.0 * (i % 6), 15.0 * (i // 6)) for i in range(30)]
    render_run(make_run([lonely, *together]), tmp_path / "wide.png", dpi=DPI)
    picture = pixels_of(tmp_path / "wide.png")
    right = picture[:, picture.shape[1] // 2 :]
    assert count(right, ROOF_COLOURS[RoofType.GABLE]) > 3_000


def test_a_directory_without_a_run_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is not a folder"):
        render_run(tmp_path, tmp_path / "run.png", dpi=DPI)


def test_a_picture_that_cannot_be_written_is_an_error(street_run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="cannot be written"):
        render_run(street_run, tmp_path / "no" / "folder.png", dpi=DPI)


def test_light_falls_from_the_north_west_on_a_map() -> None:
    north_west, south_east, up = ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (0.0, 0.0, 1.0))
    assert lambert(north_west, MAP_SUN) > lambert(up, MAP_SUN) > lambert(south_east, MAP_SUN) > 0.0
    assert lambert((0.0, 0.0, 5.0), MAP_SUN) == pytest.approx(lambert(up, MAP_SUN))


def test_only_faces_that_look_at_the_eye_are_drawn() -> None:
    axes = Figure().subplots()
    draw_view(axes, [faces_of(small.gable_solid())], View(azimuth_deg=180.0, altitude_deg=20.0))
    shadows, drawn = axes.collections
    assert len(shadows.get_paths()) == len(small.gable_solid().faces)
    # From the south at 20 degrees: the southern roof face and the southern wall.
    assert len(drawn.get_paths()) == 2


def test_nearer_buildings_are_drawn_later() -> None:
    axes = Figure().subplots()
    near = [ViewedFace(rings=(small.gable_solid().vertices[[0, 1, 5, 4]] - [0.0, 50.0, 0.0],), colour="#ff0000")]
    far = [ViewedFace(rings=(small.gable_solid().vertices[[0, 1, 5, 4]],), colour="#00ff00")]
    for order in ([near, far], [far, near]):
        axes.clear()
        draw_view(axes, order, View(azimuth_deg=180.0))
        first, last = axes.collections[1].get_facecolors()[:, :3]
        assert first.argmax() == 1
        assert last.argmax() == 0


def test_faces_of_several_parts_are_drawn_and_missing_ones_take_no_room() -> None:
    faces = shapely.MultiPolygon([shapely.box(100, 100, 110, 110), shapely.box(120, 100, 130, 110)])
    axes = Figure().add_axes((0, 0, 1, 1))
    axes.add_collection(PathCollection(paths_of([faces, None, shapely.Polygon()])))
    assert axes.dataLim.extents.tolist() == [100.0, 100.0, 130.0, 110.0]
    assert len(paths_of([faces])[0].vertices) == 10


def test_a_court_is_a_hole_in_the_drawn_path() -> None:
    solid = small.courtyard().solids[0]
    roof = next(face for face in solid.faces if face.kind is FaceKind.ROOF)
    path = drawn_path([solid.vertices[list(ring), :2] for ring in roof.rings])
    figure = Figure(figsize=(2, 2), dpi=50)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.add_patch(PathPatch(path, color="black"))
    axes.set(xlim=(20, 40), ylim=(0, 20))
    axes.set_axis_off()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    shot = np.asarray(canvas.buffer_rgba())[:, :, 0]
    assert shot[50, 50] == 255
    assert shot[50, 10] == 0
