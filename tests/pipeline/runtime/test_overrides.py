"""Overrides of single buildings take effect, are reported, and change no other building."""

import dataclasses
import functools
import json
import re
import shutil
import weakref
from pathlib import Path
from typing import Any

import geopandas
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from run_tables import rows_by_id, write_footprints

import pipeline.extras.overrides.apply_overrides as applying
import pipeline.extras.overrides.rerun
import pipeline.recipe
from pipeline.errors import RunCancelledError, RunError, SettingsError
from pipeline.extras.overrides.earlier import Record
from pipeline.extras.overrides.overrides_file import overrides_of, own_modelling, read_overrides
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.io import SpatialReference
from pipeline.io.storage import sha256_of
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.stages.sites import CandidateSite
from pipeline.settings import RunSettings
from pipeline.tiling import Tile

TILES = {"tile_size_m": 40.0, "candidates": {"min_area_m2": 88.0}}
"""Small tiles, so that houses cross their borders; and small houses are rejected, so that there is what to accept."""
METRES = SpatialReference()


def others(found: dict[str, dict[str, Any]], *names: str) -> dict[str, dict[str, Any]]:
    return {name: row for name, row in found.items() if name not in names}


def files(run_dir: str) -> dict[str, bytes]:
    paths = [path for path in Path(run_dir).rglob("*") if path.is_file() and path.name != "run.json"]
    return {path.relative_to(run_dir).as_posix(): path.read_bytes() for path in paths}


def outline(row: dict[str, Any]) -> Any:
    return shapely.from_wkb(row["geometry"])


@pytest.fixture(scope="module")
def suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tile with a dozen houses: a little more than the other tests of runs need."""
    return simulate("suburb", tmp_path_factory.mktemp("suburb"), 3, size_m=(120.0, 100.0), density_per_m2=2.5).laz


@pytest.fixture(scope="module")
def plain(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    out = str(tmp_path_factory.mktemp("plain") / "run")
    return run(RunRequest(inputs=(str(suburb),), out=out, settings=RunSettings.from_mapping(TILES), resources=SERIAL))


@pytest.fixture
def overridden(suburb: Path, reconstruct: Any, tmp_path: Path) -> Any:
    """A run with overrides: `overridden(text)`."""

    def go(text: str, **fields: Any) -> Any:
        path = tmp_path / "overrides.toml"
        path.write_text(text)
        return reconstruct(suburb, overrides=str(path), settings=fields.pop("settings", TILES), **fields)

    return go


@pytest.fixture
def everything(plain: Any) -> str:
    """Overrides of every kind, of buildings in several tiles."""
    buildings, rejected = rows_by_id(plain.run_dir), rows_by_id(plain.run_dir, "rejected")
    gone, redrawn, other = sorted(buildings, key=lambda name: -buildings[name]["n_points"])[:3]
    found = max(rejected, key=lambda name: rejected[name]["n_points"])
    box = outline(buildings[redrawn]).envelope
    return f"""
        [[building]]
        building_id = "{gone}"
        action = "reject"
        note = "a tent of the fair"

        [[building]]
        point = [{box.centroid.x}, {box.centroid.y}]
        footprint = "{box.wkt}"

        [[building]]
        building_id = "{found}"
        action = "accept"

        [[building]]
        building_id = "{other}"
        method = "kmeans"
        preset = "faithful"
        settings.roof-type.flat_below_deg = 5.0
    """


def test_a_rejected_building_is_listed_among_the_rejected_with_the_user_s_note(plain: Any, overridden: Any) -> None:
    before = rows_by_id(plain.run_dir)
    name = max(before)
    summary = overridden(f'[[building]]\nbuilding_id = "{name}"\naction = "reject"\nnote = "a tent"')
    assert rows_by_id(summary.run_dir) == others(before, name)
    after = rows_by_id(summary.run_dir, "rejected")
    assert others(after, name) == rows_by_id(plain.run_dir, "rejected")
    assert (after[name]["reason"], after[name]["reason_detail"]) == ("overridden", "a tent")
    assert after[name]["n_points"] == before[name]["n_points"]
    assert outline(after[name]).buffer(0.5).contains(outline(before[name]).centroid)
    assert not list(Path(summary.run_dir).glob(f"meshes/*/{name}.obj"))
    assert summary.rejected["overridden"] == 1


def test_the_driver_keeps_only_the_tile_of_an_override_in_memory(
    plain: Any, overridden: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = rows_by_id(plain.run_dir)
    name = max(before)
    apply, seen = applying.apply_overrides, []
    monkeypatch.setattr(applying, "apply_overrides", lambda *a: seen.append(apply(*a)) or seen[0])
    summary = overridden(f'[[building]]\nbuilding_id = "{name}"\nmethod = "kmeans"')
    (applied,) = seen
    assert [site.building_id for site in applied.before.candidates] == [name]
    owner = before[name]["tile"]
    assert [tile.key for tile in applied.owners] == [owner]
    beside = {other for other, row in before.items() if row["tile"] == owner}
    assert {site.building_id for site in applied.sites.candidates} == beside < set(before)
    after = rows_by_id(summary.run_dir)
    assert others(after, name) == others(before, name)


def test_an_accepted_object_is_modelled_under_its_own_id(plain: Any, overridden: Any) -> None:
    before = rows_by_id(plain.run_dir, "rejected")
    name = max(before, key=lambda name: before[name]["n_points"])
    summary = overridden(f'[[building]]\nbuilding_id = "{name}"\naction = "accept"')
    after = rows_by_id(summary.run_dir)
    assert rows_by_id(summary.run_dir, "rejected") == others(before, name)
    assert others(after, name) == rows_by_id(plain.run_dir)
    assert (after[name]["status"], after[name]["overridden"]) == ("ok", "accept")
    assert after[name]["n_points"] == before[name]["n_points"]
    around = outline(before[name]).buffer(1.0)
    assert outline(after[name]).intersection(around).area > 0.8 * outline(after[name]).area


def test_a_doubtful_building_is_ok_once_a_user_accepts_it_or_its_figures(
    reconstruct: Any, suburb: Path, overridden: Any
) -> None:
    strict = {**TILES, "support": {"min_confidence": 1.0}}
    before = rows_by_id(reconstruct(suburb, settings=strict).run_dir)
    doubted = sorted(
        name for name, row in before.items() if row["reason"] == "uncertain" and row["status"] == "doubtful"
    )
    accepted, relaxed = doubted[:2]
    summary = overridden(
        f"""
        [[building]]
        building_id = "{accepted}"
        action = "accept"

        [[building]]
        building_id = "{relaxed}"
        settings.support.min_confidence = 0.0
        """,
        settings=strict,
    )
    after = rows_by_id(summary.run_dir)
    assert others(after, accepted, relaxed) == others(before, accepted, relaxed)
    for name, effect in ((accepted, "accept"), (relaxed, "method")):
        row = after[name]
        assert (row["status"], row["reason"], row["overridden"]) == ("ok", None, effect)
        assert row["geometry"] == before[name]["geometry"]
    assert {status: summary.statuses.get(status, 0) for status in ("ok", "doubtful")} == {
        "ok": 2,
        "doubtful": sum(row["status"] == "doubtful" for row in before.values()) - 2,
    }


def test_another_footprint_is_modelled_with_the_points_inside_it(plain: Any, overridden: Any) -> None:
    before = rows_by_id(plain.run_dir)
    name = min(before)
    west, south, east, north = outline(before[name]).bounds
    half = shapely.box(west, south, (west + east) / 2, north)
    summary = overridden(f'[[building]]\nbuilding_id = "{name}"\nfootprint = "{half.wkt}"')
    after = rows_by_id(summary.run_dir)
    assert others(after, name) == others(before, name)
    assert after[name]["overridden"] == "footprint"
    assert outline(after[name]).symmetric_difference(half).area < 0.02 * half.area
    assert 0.3 * before[name]["n_points"] < after[name]["n_points"] < 0.7 * before[name]["n_points"]


@pytest.mark.slow
def test_overlapping_footprints_of_two_buildings_have_all_their_points_each(plain: Any, overridden: Any) -> None:
    before = rows_by_id(plain.run_dir)
    one, other = sorted(before)[:2]
    box = outline(before[one]).envelope
    entries = {name: f'[[building]]\nbuilding_id = "{name}"\nfootprint = "{box.wkt}"\n' for name in (one, other)}
    alone, both = overridden(entries[one]), overridden(entries[one] + entries[other])
    first = rows_by_id(alone.run_dir)[one]
    found = rows_by_id(both.run_dir)
    assert found[one] == first
    assert found[other]["n_points"] == first["n_points"]


def test_another_method_and_its_settings_are_those_of_one_building(plain: Any, overridden: Any) -> None:
    before = rows_by_id(plain.run_dir)
    name = min(before)
    text = f'[[building]]\nbuilding_id = "{name}"\nmethod = "kmeans"\npreset = "faithful"\n'
    after = rows_by_id(overridden(text).run_dir)
    assert others(after, name) == others(before, name)
    assert (after[name]["method"], after[name]["overridden"]) == ("kmeans", "method")
    assert after[name]["input_hash"] == before[name]["input_hash"]
    whole = RunSettings.from_mapping({**TILES, "method": "kmeans", "preset": "faithful"})
    assert after[name]["settings_hash"] == whole.settings_hash != before[name]["settings_hash"]
    assert after[name]["roof_type"] in {"gable", "unknown", "none", "flat", "pent"}


def test_a_building_with_another_method_is_as_in_a_run_of_that_method(
    plain: Any, overridden: Any, suburb: Path, reconstruct: Any
) -> None:
    name = min(rows_by_id(plain.run_dir))
    text = f'[[building]]\nbuilding_id = "{name}"\nmethod = "parameter-space-3d"\n'
    whole = rows_by_id(reconstruct(suburb, settings={**TILES, "method": "parameter-space-3d"}).run_dir)
    alone = rows_by_id(overridden(text).run_dir)
    assert {**alone[name], "overridden": None} == whole[name]


def test_a_point_names_the_building_around_it_and_far_ones_name_the_nearest(plain: Any, overridden: Any) -> None:
    before = rows_by_id(plain.run_dir)
    name = min(before)
    place = outline(before[name]).representative_point()
    west = min(outline(row).bounds[0] for row in before.values())
    text = f"""
        [[building]]
        point = [{place.x}, {place.y}]
        action = "reject"
        [[building]]
        point = [{west - 20.0}, {place.y}]
        action = "reject"
        [[building]]
        point = [0.0, 0.0]
        action = "accept"
    """
    summary = overridden(text)
    assert set(before) - set(rows_by_id(summary.run_dir)) == {name}
    found = [warning for warning in summary.warnings if warning.startswith("overrides: ")]
    assert "it is in no building; the nearest is" in found[0]
    assert "there is no rejected object within 50 m" in found[1]
    outcomes = json.loads((Path(summary.run_dir) / "overrides.json").read_text())
    assert [entry["building_id"] for entry in outcomes] == [name, None, None]
    assert [entry["effects"] for entry in outcomes] == ["reject", "", ""]


def test_ids_that_are_none_are_warned_of_with_the_nearest(plain: Any, overridden: Any) -> None:
    first, *_, last = sorted(rows_by_id(plain.run_dir))
    text = "".join(f'[[building]]\nbuilding_id = "{name[:-1]}"\naction = "reject"\n' for name in (first, last))
    summary = overridden(text)
    assert summary.digest == plain.digest
    for name in (first, last):
        assert any(f"the nearest is {name}" in warning for warning in summary.warnings)


def test_what_changes_nothing_is_reported(plain: Any, overridden: Any) -> None:
    thing = min(rows_by_id(plain.run_dir, "rejected"))
    summary = overridden(f'[[building]]\nbuilding_id = "{thing}"\naction = "reject"')
    assert summary.digest == plain.digest
    assert any(f"{thing} is rejected already" in warning for warning in summary.warnings)
    summary = overridden(f'[[building]]\nbuilding_id = "{thing}"\nmethod = "kmeans"')
    assert any('give action = "accept", too' in warning for warning in summary.warnings)


@pytest.mark.slow
def test_overrides_do_the_same_whatever_the_tiles(everything: str, overridden: Any) -> None:
    digests = {overridden(everything, settings={**TILES, "tile_size_m": size}).digest for size in (0.0, 47.0)}
    assert len(digests) == 1


def test_given_footprints_are_overridden_by_their_own_id(plain: Any, overridden: Any, tmp_path: Path) -> None:
    known = [outline(row) for _, row in sorted(rows_by_id(plain.run_dir).items())][:3]
    write_footprints(tmp_path / "given.geojson", dict(zip("abc", known, strict=True)), use="flat")
    write_footprints(tmp_path / "better.geojson", {"better": known[2].envelope})
    text = """
        [[building]]
        source_id = "a"
        action = "reject"
        [[building]]
        source_id = "c"
        footprint = { file = "better.geojson", id = "better" }
        [[building]]
        source_id = "d"
        action = "reject"
    """
    summary = overridden(text, footprints=str(tmp_path / "given.geojson"))
    found = {row["source_id"]: row for row in rows_by_id(summary.run_dir).values()}
    assert set(found) == {"b", "c"}
    assert (found["b"]["overridden"], found["c"]["overridden"]) == (None, "footprint")
    assert json.loads(found["c"]["source_attributes"]) == {"id": "c", "use": "flat"}
    assert outline(found["c"]).symmetric_difference(known[2].envelope).area < 0.02 * known[2].area
    assert [row["reason"] for row in rows_by_id(summary.run_dir, "rejected").values()] == ["overridden"]
    assert any("source_id 'd'" in warning and "source_id of this run" in warning for warning in summary.warnings)


# faults


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("buildings = 1", r"buildings is no table of overrides: use \[\[building\]\]"),
        ("[building]\nbuilding_id = 'a'", r"building is no array of tables"),
        ("[[building]]\nbuilding_id = 'a'", "entry 1: does nothing: give one of action"),
        ("[[building]]\naction = 'accept'", "gives no building: give one of building_id, source_id, point"),
        ("[[building]]\nbuilding_id = 'a'\npoint = [1, 2]\naction = 'accept'", "gives building_id and point"),
        ("[[building]]\nbuilding_id = 'a'\naction = 'drop'", "action is 'drop': use one of accept, reject"),
        ("[[building]]\nbuilding_id = 'a'\nactoin = 'accept'", "actoin is no key: use building_id"),
        ("[[building]]\nbuilding_id = 7\naction = 'accept'", "building_id is 7: use text"),
        ("[[building]]\npoint = [1, nan]\naction = 'accept'", "use .easting, northing"),
        ("[[building]]\npoint = 3\naction = 'accept'", "use .easting, northing"),
        ("[[building]]\nsource_id = 1.5\naction = 'accept'", "source_id is 1.5: use text or a whole number"),
        ("[[building]]\nbuilding_id = 'a'\naction = 'reject'\nmethod = 'kmeans'", "rejects and gives method"),
        ("[[building]]\nbuilding_id = 'a'\nmethod = 'magic'", "method is 'magic': use one of"),
        ("[[building]]\nbuilding_id = 'a'\nsettings = 3", "settings are no tables"),
        ("[[building]]\nbuilding_id = 'a'\nsettings.ground.filter = 'none'", r"\[ground\] cannot differ by building"),
        (
            "[[building]]\nbuilding_id = 'a'\nsettings.kmeans.k = 2",
            r"\[kmeans\] cannot .* use roof, plan, roof-type, guides, support, arrangement",
        ),
        ("[[building]]\nbuilding_id = 'a'\nsettings.roof.colour = 1", r"\[roof\] colour is not a setting"),
        ("[[building]]\nbuilding_id = 'a'\nfootprint = 'POLYGO ((0 0))'", "is not WKT"),
        ("[[building]]\nbuilding_id = 'a'\nfootprint = 'POINT (0 0)'", "is not a polygon: use POLYGON"),
        (
            "[[building]]\nbuilding_id = 'a'\nfootprint = 'POLYGON ((0 0, 9 0, 9 4e9, 0 0))'",
            r"is 4e\+09 m wide or long: use at most 20000 m",
        ),
        ("[[building]]\nbuilding_id = 'a'\nfootprint = { file = 1, id = [] }", "footprint has the file 1: use text"),
        (
            "[[building]]\nbuilding_id = 'a'\nfootprint = { file = 'a', id = 1, layer = [] }",
            r"footprint has the layer \[\]: use text",
        ),
        (f"[[building]]\npoint = [1, {'9' * 400}]\naction = 'accept'", r"point is \[1, 9+\.\.\.9+\]: use"),
        ("[[building]]\npoint = [1e308, 1]\naction = 'accept'", r"point is \[1e\+308, 1\]: use"),
        (f"building = {'[' * 5000}", "is not TOML: its brackets are nested too deeply"),
        ("[[building]]\nbuilding_id = 'a'\nfootprint = 'POLYGON ((0 0, 1 1, 1 0, 0 1, 0 0))'", "Self-intersection"),
        ("[[building]]\nbuilding_id = 'a'\nfootprint = 5", "footprint is neither WKT nor a table"),
        ("[[building]]\nbuilding_id = 'a'\nfootprint = {file = 'none.gpkg', id = 1}", "no such file"),
        (2 * "[[building]]\nbuilding_id = 'a'\naction = 'accept'\n", "entry 2: names the same building as entry 1"),
    ],
)
def test_faults_of_an_entry_are_reported_with_the_fix(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "o.toml").write_text(text)
    with pytest.raises(SettingsError, match=fault):
        read_overrides(tmp_path / "o.toml", METRES, RunSettings())


def test_all_faults_are_reported_at_once_and_before_anything_is_touched(
    plain: Any, suburb: Path, reconstruct: Any, tmp_path: Path
) -> None:
    (tmp_path / "o.toml").write_text("[[building]]\naction = 'x'\n[[building]]\nbuilding_id = 'a'\nmethod = 'y'")
    with pytest.raises(SettingsError) as caught:
        reconstruct(suburb, overrides=str(tmp_path / "o.toml"), out=str(tmp_path / "run"))
    assert len(caught.value.faults) == 3
    assert not (tmp_path / "run").exists()
    with pytest.raises(SettingsError, match="cannot be read"):
        read_overrides(tmp_path / "none.toml", METRES, RunSettings())
    (tmp_path / "bad.toml").write_text("[[building")
    with pytest.raises(SettingsError, match="is not TOML"):
        read_overrides(tmp_path / "bad.toml", METRES, RunSettings())


def test_a_file_with_several_layers_needs_the_key_layer(tmp_path: Path) -> None:
    outlines = geopandas.GeoDataFrame({"id": ["A"]}, geometry=[shapely.box(0, 0, 9, 9)], crs="EPSG:28992")
    for layer in ("houses", "sheds"):
        outlines.to_file(tmp_path / "a.gpkg", layer=layer, driver="GPKG")
    entry = {"building_id": "a", "footprint": {"file": str(tmp_path / "a.gpkg"), "id": "A"}}
    with pytest.raises(SettingsError, match="Name one of its layers as layer: houses, sheds"):
        overrides_of({"building": [entry]}, METRES, RunSettings())


KEYS = st.sampled_from(["point", "action", "footprint", "settings", "x"])
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=examples(60), deadline=None)
@given(st.dictionaries(KEYS, ANYTHING, max_size=5))
def test_no_entry_breaks_the_reader(entry: dict[str, Any]) -> None:
    # none of these is a valid entry: what is drawn at random is no action and no polygon
    with pytest.raises(SettingsError, match="entry 1: "):
        overrides_of({"building": [{**entry, "action": entry.get("action")}]}, METRES, RunSettings())


def test_points_and_outlines_are_in_the_units_of_the_crs() -> None:
    feet = SpatialReference(horizontal_unit_m=0.3048)
    entry = {"point": [100, 200], "footprint": "POLYGON ((0 0, 10 0, 10 10, 0 10, 0 0))"}
    (found,) = overrides_of({"building": [entry]}, feet, RunSettings())
    assert found.point_m == pytest.approx((30.48, 60.96))
    assert found.footprint.area == pytest.approx(100 * 0.3048**2)


def test_settings_of_one_building_start_where_the_run_s_are_unless_method_or_preset_is_another() -> None:
    own: dict[str, Any] = {"method": "kmeans", "kmeans": {"outline": "rectangle"}, "roof-type": {"flat_below_deg": 4.0}}
    base = RunSettings.from_mapping(own)
    entry = {"building_id": "a", "settings": {"roof-type": {"flat_below_deg": 3.0}}}
    (found,) = overrides_of({"building": [entry]}, METRES, base)
    kept = own_modelling(found, base)
    assert kept.settings.method == base.building.method
    assert kept.settings.roof_type.flat_below_deg == 3.0
    (found,) = overrides_of({"building": [{"building_id": "a", "preset": "faithful"}]}, METRES, base)
    faithful = RunSettings.from_mapping(
        {"method": "kmeans", "preset": "faithful", "roof-type": {"flat_below_deg": 4.0}}
    )
    assert own_modelling(found, base).settings == faithful.building
    assert own_modelling(found, base).settings_hash == faithful.settings_hash


# rerun


@pytest.fixture
def copied(suburb: Path, plain: Any, reconstruct: Any, tmp_path: Path) -> Any:
    """A run of its own, to be changed: `copied(meshes="building")`; that one a copy of the plain run."""

    def go(meshes: str = "building") -> Any:
        if meshes != "building":
            return reconstruct(suburb, settings=TILES, meshes=meshes)
        copy = shutil.copytree(plain.run_dir, tmp_path / "copied")
        return dataclasses.replace(plain, run_dir=str(copy))

    return go


def again(run_dir: str, **fields: Any) -> Any:
    return rerun(RerunRequest(run_dir=run_dir, resources=SERIAL, **fields))


@pytest.mark.parametrize(
    "meshes", ["building", *(pytest.param(meshes, marks=pytest.mark.slow) for meshes in ("tile", "glb", "none"))]
)
def test_a_rerun_leaves_what_a_whole_run_with_these_overrides_writes(
    everything: str, overridden: Any, copied: Any, tmp_path: Path, meshes: str
) -> None:
    whole = overridden(everything, meshes=meshes)
    first = copied(meshes=meshes)
    before = files(first.run_dir)
    (Path(first.run_dir) / "run.html").write_text("the page about what was there before")
    done = again(first.run_dir, overrides=str(tmp_path / "overrides.toml"))
    assert done.digest == whole.digest != first.digest
    assert files(first.run_dir) == files(whole.run_dir)
    found, expected = (json.loads((Path(run) / "run.json").read_text()) for run in (first.run_dir, whole.run_dir))
    slow = [{one["building_id"] for one in which["slowest"]} for which in (found, expected)]
    assert slow[0] == slow[1] != set()
    times = ("started_at", "finished_at", "timings_s", "peak_memory_bytes", "slowest")
    assert {k: v for k, v in found.items() if k not in times} == {k: v for k, v in expected.items() if k not in times}
    assert len(done.buildings) == 4
    for path in (Path(first.run_dir) / "state").glob("*.json"):
        for name, digest in json.loads(path.read_text())["files"].items():
            assert sha256_of(Path(first.run_dir) / name) == digest
    # and back again, by an empty file
    (tmp_path / "overrides.toml").write_text("")
    assert again(first.run_dir).digest == first.digest
    assert {**files(first.run_dir), "overrides.json": b""} == {**before, "overrides.json": b""}


def test_a_rerun_models_no_other_building_and_splits_only_the_tiles_around(
    plain: Any, copied: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    modelled = []
    real = pipeline.recipe.reconstruct_building

    def watched(candidate: Any, *rest: Any) -> Any:
        modelled.append(candidate.building_id)
        return real(candidate, *rest)

    first = copied()
    monkeypatch.setattr(pipeline.recipe, "reconstruct_building", watched)
    name = max(rows_by_id(first.run_dir))
    (tmp_path / "o.toml").write_text(f'[[building]]\nbuilding_id = "{name}"\nmethod = "kmeans"')
    done = again(first.run_dir, overrides=str(tmp_path / "o.toml"))
    assert modelled == [name]
    assert done.buildings.keys() == {name}
    assert done.tiles_split < first.counts["tiles"]
    assert len(done.tiles) == 1
    # an entry that did not change is not done twice
    assert again(first.run_dir).buildings == {}
    assert modelled == [name]


def test_a_named_building_is_modelled_again_and_comes_out_the_same(plain: Any, copied: Any) -> None:
    first = copied()
    before = files(first.run_dir)
    name = min(rows_by_id(first.run_dir))
    done = again(first.run_dir, only=(name,))
    assert done.buildings == {name: rows_by_id(first.run_dir)[name]["status"]}
    assert done.digest == first.digest == plain.digest
    assert files(first.run_dir) == before


def test_a_unit_without_a_digest_of_its_inputs_is_sought_in_all_tiles() -> None:
    record = Record(points=5, box=None, source_id=None, status="failed", input_hash=None)
    alone = CandidateSite(building_id="a", owner=Tile(0, 0), ranges=(), points=5)
    search: Any = None
    same = functools.partial(pipeline.extras.overrides.rerun._Search._same, search, record)
    assert same(alone)
    assert not same(dataclasses.replace(alone, points=6))
    # its outline depends on units that the split tiles may cut off
    assert not same(dataclasses.replace(alone, block="b"))


@pytest.mark.slow
def test_a_rerun_holds_the_new_files_of_one_tile_at_a_time_and_touches_the_run_when_all_are_written(
    copied: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = copied(meshes="tile")
    before = files(first.run_dir)
    real_update, real_written = pipeline.extras.overrides.rerun.updated_tile, pipeline.extras.overrides.rerun._written
    made: list[Any] = []
    prepared: list[str] = []

    def watched(*args: Any) -> Any:
        assert [update() for update in made] == [None] * len(made)
        update = real_update(*args)
        made.append(weakref.ref(update))
        return update

    def written(*args: Any) -> Any:
        assert {path: data for path, data in files(first.run_dir).items() if not path.startswith("scratch/")} == before
        prepared.extend(path for path in files(first.run_dir) if "/new/" in path)
        return real_written(*args)

    monkeypatch.setattr("pipeline.extras.overrides.rerun.updated_tile", watched)
    monkeypatch.setattr("pipeline.extras.overrides.rerun._written", written)
    done = again(first.run_dir, only=tuple(rows_by_id(first.run_dir)))
    assert len(made) == len(done.tiles) > 1
    assert sum(path.endswith(".city.jsonl") for path in prepared) == len(done.tiles)
    assert files(first.run_dir) == before


@pytest.mark.slow
def test_a_rerun_with_given_footprints_is_a_whole_run_too(
    plain: Any, overridden: Any, suburb: Path, reconstruct: Any, tmp_path: Path
) -> None:
    known = [outline(row) for _, row in sorted(rows_by_id(plain.run_dir).items())]
    given = write_footprints(tmp_path / "given.geojson", {str(k): polygon for k, polygon in enumerate(known)})
    text = "[[building]]\nsource_id = '3'\naction = 'reject'\n[[building]]\nsource_id = '5'\nmethod = 'kmeans'"
    (tmp_path / "area").mkdir()  # the same name, distinguished by the whole path
    area = write_footprints(tmp_path / "area" / given.name, {"area": shapely.union_all(known).envelope.buffer(20.0)})
    whole = overridden(text, footprints=str(given), aoi=str(area))
    first = reconstruct(suburb, settings=TILES, footprints=str(given), aoi=str(area))
    done = again(first.run_dir, overrides=str(tmp_path / "overrides.toml"))
    assert done.digest == whole.digest
    assert files(first.run_dir) == files(whole.run_dir)
    for path in (given, area):
        text = path.read_text()
        path.write_text(text + " ")
        with pytest.raises(RunError, match=f"^{re.escape(str(path))} is not the file that the run read"):
            again(first.run_dir)
        path.write_text(text)


def test_a_rerun_that_is_cancelled_leaves_the_run_as_it_was(plain: Any, copied: Any, tmp_path: Path) -> None:
    first = copied()
    before = files(first.run_dir) | {"run.json": (Path(first.run_dir) / "run.json").read_bytes()}
    name = min(rows_by_id(first.run_dir))
    with pytest.raises(RunCancelledError):
        rerun(RerunRequest(run_dir=first.run_dir, only=(name,), resources=SERIAL), cancelled=lambda: True)
    assert files(first.run_dir) | {"run.json": (Path(first.run_dir) / "run.json").read_bytes()} == before


@pytest.mark.slow
def test_a_building_that_the_split_tiles_cut_off_is_sought_in_all_of_them(
    suburb: Path, reconstruct: Any, overridden: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.extras.overrides.rerun.AROUND_M", 0.0)
    size_m = 60.0
    first = reconstruct(suburb, settings={"tile_size_m": size_m})
    outlines = [outline(row) for row in rows_by_id(first.run_dir).values()]
    across = [o for o in outlines if o.bounds[0] // size_m != o.bounds[2] // size_m]
    house = max(across, key=lambda o: o.bounds[2] % size_m)
    _, south, east, north = house.bounds
    text = f'[[building]]\npoint = [{east - 1.0}, {(south + north) / 2}]\naction = "reject"'
    whole = overridden(text, settings={"tile_size_m": size_m})
    done = again(first.run_dir, overrides=str(tmp_path / "overrides.toml"))
    assert done.tiles_split == first.counts["tiles"]
    assert done.digest == whole.digest != first.digest
    assert files(first.run_dir) == files(whole.run_dir)


@pytest.mark.slow
def test_the_bundle_of_a_building_that_meets_a_fault_comes_with_the_other_files_or_not_at_all(
    copied: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = copied()
    before = files(first.run_dir)
    name = min(rows_by_id(first.run_dir))

    def faulty(*_: Any) -> Any:
        raise ZeroDivisionError

    def called_off(*_: Any) -> Any:
        raise RunCancelledError("cancelled")

    with monkeypatch.context() as patch:
        patch.setattr(pipeline.recipe, "reconstruct_building", faulty)
        with monkeypatch.context() as late:
            late.setattr("pipeline.extras.overrides.rerun._prepared", called_off)
            with pytest.raises(RunCancelledError):
                again(first.run_dir, only=(name,))
        assert files(first.run_dir) == before
        assert again(first.run_dir, only=(name,)).buildings == {name: "failed"}
        assert set(files(first.run_dir)) - set(before) == {f"quarantine/{name}.bundle"}
    again(first.run_dir, only=(name,))
    assert files(first.run_dir) == before


def test_a_rerun_that_fails_among_the_files_says_so(copied: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    first = copied()
    name = min(rows_by_id(first.run_dir))

    def full(*_: Any) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.extras.overrides.rerun._put_state", full)
        with pytest.raises(OSError, match="no space left"):
            again(first.run_dir, only=(name,))
    found = json.loads((Path(first.run_dir) / "run.json").read_text())
    assert (found["status"], found["content_sha256"]) == ("failed", None)
    assert found["warnings"][-1] == "OSError: no space left"
    with pytest.raises(RunError, match="is failed, not finished"):
        again(first.run_dir, only=(name,))


def test_runs_that_cannot_be_continued_are_refused_with_the_reason(
    suburb: Path, reconstruct: Any, tmp_path: Path
) -> None:
    tile = tmp_path / "tile.laz"
    tile.write_bytes(suburb.read_bytes())
    first = reconstruct(tile, settings=TILES)
    name = min(rows_by_id(first.run_dir))
    manifest = Path(first.run_dir) / "run.json"
    text = manifest.read_text()
    found = json.loads(text)
    older = {name: values for name, values in found["settings"].items() if name != "support"}
    for change, message in (
        (
            {"settings": older, "settings_hash": "ab"},
            r"of an older gablework, without support\.\w+\. Run the whole again",
        ),
        ({"status": "running"}, "is running, not finished"),
        ({"engine_version": "0.0.0"}, r"made by gablework 0\.0\.0"),
        ({"request": {}}, "does not tell how the run was asked for"),
        ({"settings_hash": "ab"}, "changed by hand"),
    ):
        manifest.write_text(json.dumps({**found, **change}))
        with pytest.raises(RunError, match=message):
            again(first.run_dir, only=(name,))
    manifest.write_text(text)
    with pytest.raises(RunError, match="abc: no building of"):
        again(first.run_dir, only=("abc",))
    with pytest.raises(RunError, match=r"run\.json does not exist"):
        again(str(tmp_path))
    tile.write_bytes(suburb.read_bytes() + b"\0")
    with pytest.raises(RunError, match="its content changed"):
        again(first.run_dir, only=(name,))
