"""OBJ that others write: names, groups, materials, indices, and what is broken."""

from pathlib import Path

import model_files as files
import numpy as np
import pytest
import shapely

from pipeline.errors import InputError
from pipeline.model import FaceKind
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.ruler.evaluation.reading import read_models

FACES = {"roof": ["5 6 7 8"], "ground": ["4 3 2 1"], "wall": ["1 2 6 5", "2 3 7 6", "3 4 8 7", "4 1 5 8"]}


def corners(east: float = 0.0, height: float = 3.0, more: str = "") -> str:
    plan = ((0, 0), (8, 0), (8, 6), (0, 6))
    return "".join(f"v {x + east} {y} {z}{more}\n" for z in (0, height) for x, y in plan)


def faces(first: int = 1, style: str = "{}") -> str:
    """All faces of a box, without names."""
    listed = [line for lines in FACES.values() for line in lines]
    return "".join("f " + " ".join(style.format(int(i) + first - 1) for i in line.split()) + "\n" for line in listed)


def read(tmp_path: Path, text: str, name: str = "of_others.obj") -> ModelSet:
    path = tmp_path / name
    path.write_text(text)
    return read_models(path)


def test_an_object_is_a_building(tmp_path: Path) -> None:
    text = "# made elsewhere\nmtllib a.mtl\no left-1\n" + corners() + faces() + "o left-2\n" + corners(20) + faces(9)
    models = read(tmp_path, text)
    assert [model.building_id for model in models.models] == ["left-1", "left-2"]
    assert models.models[1].footprint.equals(shapely.box(20, 0, 28, 6))
    assert all(len(model.solids) == 1 and model.lod == "2.2" for model in models.models)
    assert (models.kind, models.name, models.crs, models.has_footprints) == ("obj", "of_others", None, False)
    assert any("taken as metres" in note for note in models.notes)


@pytest.mark.parametrize("word", ["g {}Surfaces\n", "usemtl {}\n", "g house\nusemtl my_{}_7\n"])
def test_names_of_groups_and_materials_tell_what_a_face_is(tmp_path: Path, word: str) -> None:
    names = {"roof": "Roof", "ground": "ground", "wall": "WALL"}
    parts = [word.format(names[kind]) + "".join(f"f {line}\n" for line in lines) for kind, lines in FACES.items()]
    (model,) = read(tmp_path, "o house\n" + corners() + "".join(parts)).models
    assert [face.kind for face in model.solids[0].faces] == [FaceKind.ROOF, FaceKind.GROUND, *[FaceKind.WALL] * 4]
    swapped = "".join(parts).replace("WALL", "Roof") + "g ground\nf 1 2 3 4\n"
    (model,) = read(tmp_path, "o house\n" + corners() + swapped).models
    assert model.solids == ()
    assert [surface.polygon.area for surface in model.surfaces] == [48.0]


def test_indices_from_the_end_slashes_colours_and_comments_are_read(tmp_path: Path) -> None:
    plain = read(tmp_path, "o a\n" + corners() + faces())
    for text in (
        "o a\n" + corners(more=" 0.2 0.3 0.4") + faces(),
        "o a\n" + corners() + "vn 0 0 1\nvt 0 0\n" + faces(style="{}/1/1"),
        "o a\n" + corners() + faces(style="{}//1"),
        "o a\r\n" + corners().replace("\n", "\r\n") + "s off\r\n" + faces(first=-8),
    ):
        files.assert_same_models(plain, read(tmp_path, text))


def test_triangles_are_worth_their_polygon(tmp_path: Path) -> None:
    polygons = read(tmp_path, corners() + faces())
    triangles = "".join(
        f"f {a} {b} {c}\nf {a} {c} {d}\n" for lines in FACES.values() for a, b, c, d in (line.split() for line in lines)
    )
    files.assert_same_models(polygons, read(tmp_path, corners() + triangles))


def test_a_file_without_names_is_one_building_or_all_that_touches(tmp_path: Path) -> None:
    one = read(tmp_path, corners() + faces())
    assert [model.building_id for model in one.models] == ["of_others"]
    text = corners() + faces() + corners(8.0, 5.0) + faces(9) + corners(30.0) + faces(17)
    several = read(tmp_path, text)
    assert [(model.building_id, len(model.solids)) for model in several.models] == [
        ("of_others-0", 2),
        ("of_others-1", 1),
    ]
    assert any("touches in plan" in note for note in several.notes)
    folder = tmp_path / "folder" / "deeper"
    folder.mkdir(parents=True)
    (folder / "x.obj").write_text(text)
    (folder / "y.obj").write_text(corners(60.0) + faces())
    apart = read_models(tmp_path / "folder")
    assert [(model.building_id, len(model.solids)) for model in apart.models] == [("x", 3), ("y", 1)]


def test_groups_without_objects_are_buildings_where_they_are_solids(tmp_path: Path) -> None:
    text = "g first\n" + corners() + faces() + "g second\n" + corners(30.0) + faces(9)
    models = read(tmp_path, text)
    assert [model.building_id for model in models.models] == ["first", "second"]
    single = "".join(f"g face{k}\nf {line}\n" for k, line in enumerate(x for v in FACES.values() for x in v))
    assert [model.building_id for model in read(tmp_path, corners() + single).models] == ["of_others"]


def test_an_open_mesh_is_a_model_without_solid(tmp_path: Path) -> None:
    (model,) = read(tmp_path, corners() + "".join(faces().splitlines(keepends=True)[:-1])).models
    assert model.solids == ()
    assert model.footprint.area == 48.0
    assert model.surfaces[0].elevation(np.array([1.0]), np.array([1.0])) == pytest.approx([3.0])


def test_broken_files_tell_the_line(tmp_path: Path) -> None:
    cases = {
        "line 2: a vertex of 2": "o a\nv 1 2\n",
        "line 1: could not convert": "v 1 2 x\n",
        "line 1: vertex 1 2 nan": "v 1 2 nan\n",
        "line 9: a face names vertex 9": corners() + "f 1 2 9\n",
        "line 9: a face names vertex 0": corners() + "f 0 1 2\n",
        "line 9: a face names vertex -9": corners() + "f -9 1 2\n",
        "line 9: a face of 2": corners() + "f 1 2\n",
        "line 9: invalid literal": corners() + "f 1 2 x\n",
        "the file has no faces": corners(),
    }
    for found, text in cases.items():
        with pytest.raises(InputError, match=r"of_others\.obj") as caught:
            read(tmp_path, text)
        assert caught.value.problem.startswith(found), (found, caught.value.problem)
