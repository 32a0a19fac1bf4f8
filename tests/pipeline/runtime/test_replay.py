"""Quarantine bundles: everything that modelling a building needs, safe to open, replayed by one command."""

import dataclasses
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from command_line import invoke
from faults.asked import environment

import pipeline.recipe
from pipeline.errors import SettingsError, UnreadableInputError
from pipeline.extras.papers.paper_settings import FuzzySartSettings
from pipeline.io.crs import SpatialReference
from pipeline.methods import ReconstructSettings
from pipeline.model import Candidate, Guide, GuideKind, Status
from pipeline.recipe import reconstruct_building
from pipeline.roof.roof_settings import ArrangementSettings, GuideSettings, RoofSettings
from pipeline.runtime.isolation import child_pool
from pipeline.runtime.isolation.replay_bundle import Bundle, Incident, read_bundle, write_bundle
from pipeline.runtime.replay_building import replay

FEET = SpatialReference(name="feet", horizontal_unit_m=0.3048, vertical_unit_m=0.3048)


@pytest.fixture
def bundle() -> Bundle:
    """A gable of 10 x 10 m that once crashed."""
    spacing = np.arange(0.25, 10.0, 0.5)
    x, y = (axis.ravel() for axis in np.meshgrid(spacing, spacing, indexing="ij"))
    lattice = np.arange(-4.5, 15.0)
    east, north = (axis.ravel() for axis in np.meshgrid(lattice, lattice, indexing="ij"))
    candidate = Candidate(
        building_id="abcdefghijklmnopqrstuvwx",
        origin=(500000.0, 5900000.0, 30.0),
        points=np.round(np.column_stack((x, y, 9.0 - 0.6 * np.abs(y - 5.0))), 3),
        ground=np.column_stack((east, north, np.full(len(east), -0.1))),
        ground_z_m=-0.1,
        split_returns=np.array([[0.25, 0.25, 6.15], [9.75, 0.25, 6.15]]),
        beside=np.array([[5.0, -0.1, 3.0], [6.0, -1.0, 0.0]]),
        beside_later=np.array([[7.0, 0.1, 2.0]]),
        elsewhere=np.array([[0.5, 9.5, -0.1]]),
        footprint=shapely.box(0.0, 0.0, 10.0, 10.0),
        source_id="house 7",
        outline=shapely.MultiPolygon([shapely.box(0.0, 0.0, 10.0, 9.9)]),
        touches_data_edge=True,
        strip_offset_m=0.25,
        guides=(Guide(kind=GuideKind.HIP, line=shapely.LineString([(0.5, 0.25), (3.0, 4.0)])),),
    )
    return Bundle(
        candidate=candidate,
        method="fuzzy-sart",
        settings=ReconstructSettings(
            method=FuzzySartSettings(vigilance=0.9),
            roof=RoofSettings(min_roof_height_m=1.0),
            plan=ArrangementSettings(line_reach_m=0.7),
            guides=GuideSettings(distance_m=0.9),
            lods=("1.2", "2.2"),
        ),
        incident=Incident(reason="crashed", detail="by signal 11", seconds=1.5, memory_bytes=7, stderr="Fatal: ä\n"),
        reference=FEET,
    )


@pytest.fixture
def path(bundle: Bundle, tmp_path: Path) -> Path:
    return Path(write_bundle(str(tmp_path / "quarantine"), bundle))


def rewritten(path: Path, **members: bytes) -> str:
    """The bundle with other members, underscores for dots."""
    with zipfile.ZipFile(path) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    held.update({name.replace("_", "."): content for name, content in members.items()})
    other = path.with_name("other.bundle")
    with zipfile.ZipFile(other, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in held.items():
            if content:
                archive.writestr(name, content)
    return str(other)


def document_of(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        document: dict[str, Any] = json.loads(archive.read("bundle.json"))
    return document


def test_a_bundle_comes_back_as_it_was(bundle: Bundle, path: Path) -> None:
    found = read_bundle(str(path))
    bare = {
        name: np.empty((0, 3)) for name in ("points", "ground", "split_returns", "beside", "beside_later", "elsewhere")
    }
    for name in bare:
        assert np.array_equal(getattr(found.candidate, name), getattr(bundle.candidate, name))
    given, back = (str(dataclasses.replace(one.candidate, **bare)) for one in (bundle, found))
    assert back == given
    assert found.settings == bundle.settings
    assert (found.method, found.incident, found.reference) == (bundle.method, bundle.incident, bundle.reference)
    assert path.name == "abcdefghijklmnopqrstuvwx.bundle"
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_what_is_unknown_comes_back_as_unknown(bundle: Bundle, tmp_path: Path) -> None:
    candidate = dataclasses.replace(bundle.candidate, footprint=None, source_id=None, ground_z_m=float("nan"))
    incident = Incident(reason="internal_error", detail="")
    other = dataclasses.replace(bundle, candidate=candidate, incident=incident)
    found = read_bundle(str(write_bundle(str(tmp_path), other)))
    assert found.candidate.footprint is None
    assert found.candidate.source_id is None
    assert np.isnan(found.candidate.ground_z_m)
    assert np.isnan(found.incident.seconds)


@pytest.mark.parametrize("isolated", [False, True])
def test_a_replay_models_exactly_what_the_run_would(bundle: Bundle, path: Path, isolated: bool) -> None:
    from pipeline.runtime.isolation.process_limits import IsolationLimits

    here = reconstruct_building(bundle.candidate, bundle.method, bundle.settings)
    there = replay(read_bundle(str(path)), IsolationLimits() if isolated else None).result
    assert here.status is Status.OK
    assert pickle.dumps(there.solids) == pickle.dumps(here.solids)
    assert there.planes == here.planes
    child_pool.kill_children()


def test_no_code_in_a_bundle_is_executed(path: Path, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return exec, (f"open('{tmp_path}/executed', 'w').close()",)

    held = io.BytesIO()
    np.save(held, np.array([[Evil(), 1, 2]], dtype=object), allow_pickle=True)
    for name in ("points_npy", "ground_npy"):
        for content in (held.getvalue(), pickle.dumps(Evil())):
            with pytest.raises(UnreadableInputError):
                read_bundle(rewritten(path, **{name: content}))
    assert not (tmp_path / "executed").exists()
    pickle.loads(pickle.dumps(Evil()))
    assert (tmp_path / "executed").exists(), "the code would have worked"


def test_a_bomb_is_refused_before_it_is_unpacked(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.runtime.isolation.replay_bundle._LARGEST_BYTES", 2**20)
    bomb = rewritten(path, points_npy=bytes(2**24))
    assert Path(bomb).stat().st_size < 2**20
    with pytest.raises(UnreadableInputError, match=r"points.npy is larger than 1 MiB"):
        read_bundle(bomb)


def test_an_array_that_promises_more_than_it_holds_is_refused(path: Path) -> None:
    held = io.BytesIO()
    np.lib.format.write_array_header_1_0(held, {"descr": "<f8", "fortran_order": False, "shape": (2**50, 3)})
    with pytest.raises(UnreadableInputError):
        read_bundle(rewritten(path, points_npy=held.getvalue() + bytes(240)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "gablework bundle 1"}, "gablework bundle 1"),
        ({"building_id": "../../etc/passwd"}, "building_id"),
        ({"origin": [1.0, 2.0]}, "odd"),
        ({"origin": None}, "odd"),
        ({"footprint": "00"}, "odd"),
        ({"footprint": shapely.to_wkb(shapely.Point(0, 0), hex=True)}, "Point"),
        ({"reference": {"colour": "red"}}, "colour"),
        ({"settings": 3}, "odd"),
    ],
)
def test_odd_content_is_refused_by_name(path: Path, change: dict[str, Any], words: str) -> None:
    other = rewritten(path, bundle_json=json.dumps(document_of(path) | change).encode())
    with pytest.raises(UnreadableInputError, match=words):
        read_bundle(other)


def test_settings_of_another_version_are_refused_by_name(path: Path) -> None:
    document = document_of(path)
    document["settings"]["roof"]["colour"] = "red"
    with pytest.raises(SettingsError, match=r"\[roof\] colour"):
        read_bundle(rewritten(path, bundle_json=json.dumps(document).encode()))


def test_what_is_no_bundle_is_exit_code_3_and_named(path: Path, tmp_path: Path) -> None:
    whole = path.read_bytes()
    (tmp_path / "text.bundle").write_text("hello")
    (tmp_path / "cut.bundle").write_bytes(whole[: len(whole) // 2])
    middle = whole.index(b"bundle.json") + 40
    (tmp_path / "damaged.bundle").write_bytes(whole[:middle] + b"\xff" * 40 + whole[middle + 40 :])
    (tmp_path / "folder.bundle").mkdir()
    rewritten(path, points_npy=b"")
    names = [f"{name}.bundle" for name in ("text", "cut", "damaged", "folder", "absent", "quarantine/other")]
    for name in names:
        code, _, said = invoke("replay", str(tmp_path / name))
        assert code == 3, said
        assert name in said


def test_replay_shows_the_record_and_writes_the_model(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, said, _ = invoke("replay", str(path), "--no-isolate", "--out", str(out), "--json")
    document = json.loads(said)
    assert code == 0
    assert document["incident"]["reason"] == "crashed"
    assert document["record"]["roof_type"] == "gable"
    assert document["record"]["ridge_z"] == pytest.approx((30.0 + 9.0) / 0.3048, abs=0.4)
    names = {".json", ".obj", ".city.jsonl"}
    assert {entry.name for entry in out.iterdir()} == {f"abcdefghijklmnopqrstuvwx{suffix}" for suffix in names}
    assert sorted(document["written"]) == sorted(str(entry) for entry in out.iterdir())
    assert json.loads((out / "abcdefghijklmnopqrstuvwx.json").read_text()) == document["record"]
    lines = (out / "abcdefghijklmnopqrstuvwx.city.jsonl").read_text().splitlines()
    assert json.loads(lines[1])["id"] == "abcdefghijklmnopqrstuvwx"


def test_a_building_that_fails_again_is_exit_code_1(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> Any:
        raise ZeroDivisionError("again")

    monkeypatch.setattr(pipeline.recipe, "_reconstruct", fails)
    code, said, _ = invoke("replay", str(path), "--no-isolate", "--json")
    assert code == 1
    assert json.loads(said)["record"]["reason"] == "internal_error"


@pytest.mark.parametrize("fault", ["crash", pytest.param("eat_memory", marks=pytest.mark.slow)])
def test_a_building_that_kills_again_kills_only_the_child(
    path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    for name, value in environment(**{fault: ["abcdefghijklmnopqrstuvwx"]}).items():
        monkeypatch.setenv(name, value)
    child_pool.kill_children()
    code, said, _ = invoke("replay", str(path), "--building-memory", "1", "--json")
    child_pool.kill_children()
    document = json.loads(said)
    assert code == 1
    assert document["record"]["reason"] == {"crash": "crashed", "eat_memory": "out_of_memory"}[fault]
    assert ("Segmentation fault" in document["stderr"]) == (fault == "crash")


def test_limits_of_a_replay_are_checked(path: Path) -> None:
    code, _, said = invoke("replay", str(path), "--building-memory", "0.1", "--building-timeout", "0")
    assert code == 2
    assert "0.1 GiB" in said
    assert "0 s" in said
