"""Collections of features: what they hold, against the run's own tables; who may read them; hostile requests."""

import dataclasses
import json
import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlsplit

import finished_runs as runs
import geopandas
import jsonschema
import numpy as np
import pyogrio
import pytest
import shapely
import small_buildings as small
from examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live_service import serving, settings_in

from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import KEYS, SCHEMAS
from pipeline.runtime.manifest import RunStatus
from service.disk import has_no_space
from service.errors import RequestError, StartUpError
from service.features import cql2, pages
from service.features.cql2 import MAX_DEPTH, MAX_LENGTH, MAX_NESTED, parsed
from service.features.feature_writing import IndexWriter
from service.features.runs import check_published, published_runs
from service.keys import Scope

TABLES = ("buildings", "planes", "rejected")


@dataclasses.dataclass(frozen=True)
class Served:
    """A job of nine tiles, and its run directory."""

    service: runs.Service
    name: str
    run_dir: Path

    def items(self, table: str = "buildings", **query: Any) -> dict[str, Any]:
        answer = self.service.client.get(f"/collections/{self.name}.{table}/items", params=query)
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return found

    def pages(self, table: str = "buildings", **query: Any) -> Iterator[dict[str, Any]]:
        """All pages, by their links."""
        while True:
            found = self.items(table, **query)
            yield found
            following = [link["href"] for link in found["links"] if link["rel"] == "next"]
            if not following:
                return
            query = dict(parse_qsl(urlsplit(following[0]).query))


@pytest.fixture(scope="module")
def served(service: runs.Service) -> Served:
    job_id = service.finished(lambda run_dir: runs.write_run(run_dir, runs.nine_tiles(8)))
    return Served(service, job_id, service.folder.run(job_id, 1))


def ids(found: dict[str, Any]) -> list[str]:
    return [feature["id"] for feature in found["features"]]


# --- content ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", TABLES)
def test_features_have_the_ids_columns_and_geometries_of_the_table(served: Served, table: str) -> None:
    stored = read_table(str(served.run_dir), table).to_pylist()
    found = [
        one
        for page in served.pages(table, limit=7, crs="http://www.opengis.net/def/crs/EPSG/0/28992")
        for one in page["features"]
    ]
    features = {tuple(one["properties"][name] for name in KEYS[table]): one for one in found}
    assert len(features) == len(found) == len(stored) > 8
    for row in stored:
        key = tuple(row[name] for name in KEYS[table])
        feature = features[key]
        assert feature["id"] == ".".join(map(str, key))
        own = None if row["geometry"] is None else shapely.from_wkb(row["geometry"])
        shown = None if feature["geometry"] is None else shapely.from_geojson(json.dumps(feature["geometry"]))
        assert (own is None) == (shown is None)
        if own is not None:
            assert own.normalize() == shown.normalize()
            assert shapely.has_z(own) == shapely.has_z(shown)
        left_out = {"geometry", "bbox", "wall_outline", "boxes"}
        expected = {k: v for k, v in row.items() if k not in left_out and not k.startswith("solid")}
        times = {k: v.isoformat().replace("+00:00", "Z") for k, v in expected.items() if hasattr(v, "isoformat")}
        assert feature["properties"] == expected | times


@pytest.mark.parametrize("table", TABLES)
def test_each_feature_is_found_by_its_id_and_fits_the_schema(served: Served, table: str) -> None:
    place = f"/collections/{served.name}.{table}"
    schema = served.service.client.get(f"{place}/schema").json()
    strict = nullable(schema)
    jsonschema.Draft202012Validator.check_schema(strict)
    for feature in served.items(table, limit=20, start=3)["features"]:
        one = served.service.client.get(f"{place}/items/{feature['id']}").json()
        assert {name: value for name, value in one.items() if name != "links"} == feature
        jsonschema.validate(one, strict)
    left_out = {"coefficients"} if table == "planes" else set()
    shown = set(served.items(table)["features"][0]["properties"])
    assert set(schema["properties"]["properties"]["properties"]) == shown - left_out
    for other in ("", "a.0", f"{runs.ident('0 0 0')}.07", f"{runs.ident('0 0 0')}.99", runs.ident("nothing"), "%00"):
        answer = served.service.client.get(f"{place}/items/{other}")
        assert answer.status_code == 404, answer.text


def nullable(schema: Any) -> Any:
    """The schema with `nullable` of OpenAPI 3.0 in the words of JSON Schema."""
    if not isinstance(schema, dict):
        return schema
    found = {name: nullable(value) for name, value in schema.items() if name != "nullable"}
    if schema.get("nullable") is True:
        found["type"] = [found["type"], "null"]
        if "enum" in found:
            found["enum"] = [*found["enum"], None]
    return found


def test_the_runs_of_a_comparison_are_collections_of_their_own(service: runs.Service) -> None:
    job_id = service.compared()
    for label, n in ((runs.LABELS[0], 6), (runs.LABELS[1], 1)):
        answer = service.client.get(f"/collections/{job_id}.{label}.buildings/items")
        assert answer.json()["numberMatched"] == n
    assert service.client.get(f"/collections/{job_id}.buildings").status_code == 404
    listed = [one["id"] for one in service.client.get("/collections?limit=100").json()["collections"]]
    assert {f"{job_id}.{label}.planes" for label in runs.LABELS} <= set(listed)


# --- which features --------------------------------------------------------------------------------------------------

CRS = ("http://www.opengis.net/def/crs/OGC/1.3/CRS84", "http://www.opengis.net/def/crs/EPSG/0/28992")


@given(
    corners=st.tuples(*[st.floats(-20.0, 320.0)] * 4),
    crs=st.sampled_from(CRS),
    tall=st.sampled_from([None, 4.0, 6.5]),
    limit=st.integers(1, 30),
)
@settings(max_examples=examples(15), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_pages_by_window_and_filter_equal_a_slow_twin(
    served: Served, corners: tuple[float, ...], crs: str, tall: float | None, limit: int
) -> None:
    table = geopandas.read_parquet(served.run_dir / "buildings").to_crs("OGC:CRS84" if crs == CRS[0] else 28992)
    own = geopandas.GeoSeries.from_xy(
        [small.ORIGIN[0] + min(corners[:2]), small.ORIGIN[0] + max(corners[:2])],
        [small.ORIGIN[1] + min(corners[2:]), small.ORIGIN[1] + max(corners[2:])],
        crs=28992,
    ).to_crs(table.crs)
    window = shapely.box(*own.total_bounds)
    keep = table.geometry.isna() | table.intersects(window)
    if tall is not None:
        keep &= table.height_m > tall
    query = {"bbox": ",".join(map(repr, map(float, own.total_bounds))), "bbox-crs": crs, "limit": limit}
    query |= {} if tall is None else {"filter": f"height_m > {tall}"}
    found = list(served.pages(**query))
    assert sorted(name for page in found for name in ids(page)) == sorted(table.building_id[keep])
    assert {page["numberMatched"] for page in found} == {int(keep.sum())}
    assert all(len(page["features"]) == limit for page in found[:-1])


def test_a_page_looks_only_at_the_tiles_that_it_needs(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    original = pages._Rows.selected

    def counted(rows: Any, part: Any) -> Any:
        seen.append(part.first)
        return original(rows, part)

    monkeypatch.setattr(pages._Rows, "selected", counted)
    served.items(limit=3, start=70)
    assert seen == [64]
    seen.clear()
    # a window far away: only tiles with rows that have no geometry, and no plane is one
    assert (served.items("planes", bbox="20,60,21,61")["numberMatched"], seen) == (0, [])


def test_long_searches_are_cut_into_short_pages_without_a_number(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = ids(served.items(limit=1000, filter="roof_type = 'gable'"))
    monkeypatch.setattr(pages, "MAX_COUNTED", 24)
    monkeypatch.setattr(pages, "MAX_READ", 16)
    pages.Search.matched.cache_clear()
    found = list(served.pages(limit=1000, filter="roof_type = 'gable'"))
    assert [name for page in found for name in ids(page)] == wanted
    assert [len(page["features"]) for page in found] == [4, 4, 4, 4, 2]
    assert not any("numberMatched" in page for page in found)
    # an empty page would be taken for the last one
    rare = f"building_id = '{wanted[-1]}'"
    assert [ids(page) for page in served.pages(filter=rare)] == [[wanted[-1]]]


# --- who may read them -----------------------------------------------------------------------------------------------


def test_a_key_reads_its_own_jobs_and_published_runs(starting: Callable[..., Any], tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "old_town")
    local = starting(publish=(str(run_dir),))
    mine, other = local.key(Scope.READ), local.key(Scope.READ)
    owner = next(key.key_id for key in list(local.store.keys()) if key.digest == _digest(mine))
    service = runs.Service(client=local.client, store=local.store, folder=local.client.app.state.folder)
    job_id = service.finished(owner=owner)
    names = {"old_town.buildings", f"{job_id}.buildings"}
    for key, seen in ((mine, names), (other, {"old_town.buildings"})):
        listed = {one["id"] for one in local.client.get("/collections", headers=key).json()["collections"]}
        assert {name for name in listed if name.endswith(".buildings")} == seen
        for name in names:
            for path in ("", "/queryables", "/schema", "/items", f"/items/{runs.ident('gable')}"):
                answer = local.client.get(f"/collections/{name}{path}", headers=key)
                assert answer.status_code == (200 if name in seen else 404), (name, path)
    assert local.client.get("/collections").status_code == 401
    assert local.client.get("/collections/old_town.buildings/items").status_code == 401


def _digest(header: dict[str, str]) -> str:
    from service.keys import digest_of

    return digest_of(header["Authorization"].removeprefix("Bearer "))


@pytest.mark.parametrize("name", ["..", "../old_town", "..%2f..%2fetc", "%2fetc", "old_town%00", "OLD_TOWN", ".", "~"])
def test_no_name_reaches_another_folder(starting: Callable[..., Any], tmp_path: Path, name: str) -> None:
    local = starting(publish=(str(runs.write_run(tmp_path / "old_town")),))
    for path in (f"/collections/{name}.buildings", f"/collections/old_town.{name}", f"/collections/{name}/items"):
        assert local.client.get(path).status_code == 404, path
    for sent in (name, quote(name, safe="")):
        assert local.client.get(f"/collections/old_town.buildings/items/{sent}").status_code in {200, 404}


def test_no_answer_shows_where_a_run_lies(starting: Callable[..., Any], tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "old_town")
    local = starting(publish=(str(run_dir),))
    paths = ("/collections", "/collections/old_town.buildings", "/collections/old_town.planes/items")
    texts = [local.client.get(path).text for path in paths]
    for file in (run_dir / "planes").rglob("*.parquet"):
        file.write_bytes(b"damaged")
    assert local.client.get(paths[-1]).status_code == 200  # the index has all rows, until the run changes
    (run_dir / "run.json").write_text((run_dir / "run.json").read_text() + " ")
    answer = local.client.get(paths[-1])
    assert "are gone or damaged" in runs.problem(answer, 404, "no-such-collection")
    (run_dir / "run.json").unlink()
    answer = local.client.get(paths[1])
    assert "are gone or damaged" in runs.problem(answer, 404, "no-such-collection")
    assert not [text for text in [*texts, answer.text] if str(tmp_path) in text]


# --- published runs --------------------------------------------------------------------------------------------------


def test_published_runs_are_checked_at_the_start(tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "good")
    check_published(published_runs([str(run_dir), f"again={run_dir}"], tmp_path / "state"))
    unknown = runs.write_run(tmp_path / "unknown", epsg=None)
    unfinished = runs.write_run(tmp_path / "unfinished", status=RunStatus.RUNNING)
    for entry, message in (
        (str(tmp_path), "run.json does not exist"),
        (str(unknown), "coordinate reference system of run unknown is unknown"),
        (str(unfinished), "is running, not finished"),
    ):
        with pytest.raises(StartUpError, match=message):
            check_published(published_runs([f"one={entry}"] if entry == str(tmp_path) else [entry], tmp_path / "state"))
    for entries, message in (
        (["a b"], "would have the name 'a b': give NAME=RUN"),
        (["x.y=/srv"], "would have the name 'x.y'"),
        (["/srv/" + "0" * 32], "would have the name '0000"),
        (["/srv/a", "/mnt/a"], "two published runs have the name 'a'"),
    ):
        with pytest.raises(StartUpError, match=message):
            published_runs(entries, tmp_path)


def test_elevations_in_feet_are_stated_and_third_coordinates_are_in_the_unit_of_their_crs(
    starting: Callable[..., Any], tmp_path: Path
) -> None:
    run_dir = runs.write_run(tmp_path / "feet")
    manifest = json.loads((run_dir / "run.json").read_text())
    manifest["crs"]["vertical_unit_m"] = 0.3048
    (run_dir / "run.json").write_text(json.dumps(manifest))
    local = starting(publish=(str(run_dir),))
    place = "/collections/feet.planes"
    schema = local.client.get(f"{place}/schema").json()["properties"]["properties"]["properties"]
    assert (schema["origin_z"]["x-ogc-unit"], schema["origin_x"]["x-ogc-unit"]) == ("[ft_i]", "m")
    assert local.client.get(f"{place}/queryables").json()["properties"]["origin_z"]["x-ogc-unit"] == "[ft_i]"
    assert "units of 0.3048 m (foot)" in local.client.get(place).json()["description"]
    assert "units of" not in local.client.get("/collections/feet.rejected").json()["description"]
    stored = {f"{r['building_id']}.{r['plane_id']}": r for r in read_table(str(run_dir), "planes").to_pylist()}
    for crs in ({}, {"crs": CRS[1]}, {"crs": "http://www.opengis.net/def/crs/EPSG/0/3857"}):
        features = local.client.get(f"{place}/items", params=crs).json()["features"]
        assert len(features) == len(stored) > 3
        for feature in features:
            row = stored[feature["id"]]
            assert feature["properties"]["origin_z"] == row["origin_z"]  # as filters compare it
            z = shapely.get_coordinates(shapely.from_geojson(json.dumps(feature["geometry"])), include_z=True)[:, 2]
            own = shapely.get_coordinates(shapely.from_wkb(row["geometry"]), include_z=True)[:, 2]
            assert sorted({*z}) == pytest.approx(sorted({*np.round(own * 0.3048, 3)}), abs=1e-3)


def test_a_full_disk_is_said_as_one(tmp_path: Path) -> None:
    def fill() -> None:
        with IndexWriter(tmp_path / "index", None) as writer:
            writer.connection.execute("COMMIT")
            writer.connection.execute("PRAGMA max_page_count = 1")
            writer.connection.execute("BEGIN")
            writer.connection.execute("INSERT INTO batch VALUES (zeroblob(100000))")

    with pytest.raises(OSError, match="database or disk is full") as error:
        fill()
    assert has_no_space(error.value)


def test_a_run_that_is_replaced_is_read_again(starting: Callable[..., Any], tmp_path: Path) -> None:
    run_dir = runs.write_run(tmp_path / "town")
    local = starting(publish=(str(run_dir),))
    items = "/collections/town.buildings/items"
    assert local.client.get(items).json()["numberMatched"] == 6
    manifest = json.loads((run_dir / "run.json").read_text())
    (run_dir / "run.json").write_text(json.dumps(manifest | {"status": "running"}))
    assert "running, not finished" in runs.problem(local.client.get(items), 404, "result-not-ready")
    runs.write_run(tmp_path / "new", runs.nine_tiles(8)).rename(tmp_path / "newer")
    run_dir.rename(tmp_path / "old")
    (tmp_path / "newer").rename(run_dir)
    assert local.client.get(items).json()["numberMatched"] == 72
    assert len(list((tmp_path / "state" / "features").iterdir())) == 1


@pytest.mark.parametrize(
    ("write", "found"),
    [
        (lambda run_dir: runs.with_local_crs(runs.write_run(run_dir)), "local (site)"),
        (lambda run_dir: runs.write_run(run_dir, epsg=None), "unknown"),
    ],
)
def test_a_job_without_a_place_on_the_globe_has_no_collections(
    service: runs.Service, write: Callable[[Path], object], found: str
) -> None:
    job_id = service.finished(write)
    answer = service.client.get(f"/collections/{job_id}.buildings/items")
    assert f"is {found}, so its features have no place" in runs.problem(answer, 404, "no-such-collection")
    listed = service.client.get("/collections?limit=100").json()["collections"]
    assert not [one for one in listed if one["id"].startswith(job_id)]
    assert len(service.client.get(f"/jobs/{job_id}/buildings").json()["features"]) == 6


# --- hostile filters -------------------------------------------------------------------------------------------------


def test_filters_that_would_take_the_parser_long_or_end_the_process_are_refused(served: Served) -> None:
    deep = MAX_DEPTH + 1
    hostile = [
        "(" * 5000 + "valid" + ")" * 5000,
        "(" * deep + "valid" + ")" * deep,
        "(" * 40,
        "valid)",
        "status = 'ok",
        "not " * 400 + "valid",
        "height_m = " + "-" * 3000 + "1",
        "height_m = " + "- " * 1900 + "1",
        " and ".join(["valid"] * 1000),
        "x" * (MAX_LENGTH + 1),
        "status IN (" + ",".join(["'ok'"] * 5000) + ")",
        "casei(status) = 'ok'",
        "height_m * 2 > 5",
        "height_m > 1e400",
    ]
    began = time.process_time()
    for text in hostile:
        answer = served.service.client.get(f"/collections/{served.name}.buildings/items", params={"filter": text})
        runs.problem(answer, 400, "invalid-request")
    tree: Any = {"property": "valid"}
    for _ in range(300):
        tree = {"op": "not", "args": [tree]}
    for text in (
        json.dumps(tree),
        "[" * 20000,
        json.dumps({"op": "and", "args": [{"property": "valid"}] * 600})[:4000],
        '{"op": "=", "args": [{"property": "status"}, "\\ud800"]}',
        '{"op": "=", "args": [{"property": "height_m"}, 1' + "0" * 400 + "]}",
    ):
        query = {"filter": text, "filter-lang": "cql2-json"}
        answer = served.service.client.get(f"/collections/{served.name}.buildings/items", params=query)
        runs.problem(answer, 400, "invalid-request")
    assert time.process_time() - began < 10.0


def test_a_filter_may_be_nested_as_deep_as_sqlite_takes_it(served: Served) -> None:
    inner = {"op": "s_intersects", "args": [{"property": "geometry"}, {"bbox": [4.0, 51.0, 5.0, 53.0]}]}
    for operation in ("not", "and", "or"):
        tree: Any = inner
        for _ in range(MAX_NESTED + 1):
            query = {"filter": json.dumps(tree), "filter-lang": "cql2-json", "bbox": "4,51,4.3679,52.0070"}
            tree = {"op": operation, "args": [tree] if operation == "not" else [{"property": "valid"}, tree]}
        assert len(query["filter"]) < MAX_LENGTH
        # an odd number of negations
        assert (served.items(**query)["numberMatched"] == 0) == (operation == "not")
        answer = served.service.client.get(
            f"/collections/{served.name}.buildings/items", params=query | {"filter": json.dumps(tree)}
        )
        assert "too many within one another" in runs.problem(answer, 400, "invalid-request")


@given(st.text(alphabet="()'\"=<>,. \tandorotinlike-1x[]", max_size=60))
@settings(max_examples=examples(200), deadline=None)
def test_any_text_is_parsed_or_refused(text: str) -> None:
    try:
        tree = parsed(text, "cql2-text")
    except RequestError:
        return
    assert isinstance(tree, dict | list | str | float | bool), tree


def test_a_comparison_with_null_is_neither_true_nor_false() -> None:
    kinds = {"a": "number", "b": "boolean"}
    rows = sqlite3.connect(":memory:")
    rows.execute("CREATE TABLE rows (a REAL, b INTEGER)")
    rows.executemany("INSERT INTO rows VALUES (?, ?)", [(1.0, True), (None, False), (3.0, None)])
    for text, wanted in (
        ("a > 2", [False, None, True]),
        ("NOT (a > 2)", [True, None, False]),
        ("a > 2 OR b", [True, None, True]),
        ("a > 2 AND b", [False, False, None]),
        ("a IS NULL", [False, True, False]),
        ("a IN (1, 2)", [True, None, False]),
        ("a BETWEEN 1 AND 2", [True, None, False]),
    ):
        found = cql2.compiled(parsed(text, "cql2-text"), kinds, None, [])  # type: ignore[arg-type]
        assert [one for (one,) in rows.execute(f"SELECT {found.sql} FROM rows", found.values)] == wanted, text


# --- an independent client -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_gdal_reads_a_served_run_with_ids_and_types_of_the_tables(tmp_path: Path) -> None:
    assert "OAPIF" in pyogrio.list_drivers()
    run_dir = runs.write_run(tmp_path / "town", runs.nine_tiles(8))
    kinds = {"string": "string", "double": "double", "bool": "bool", "int32": "int32", "int64": "int32"}
    with serving(settings_in(tmp_path, publish=(str(run_dir),))) as url:
        assert [name for name, _ in pyogrio.list_layers(f"OAPIF:{url}")] == [f"town.{table}" for table in TABLES]
        for table in TABLES:
            meta, found = pyogrio.read_arrow(f"OAPIF:{url}", layer=f"town.{table}")
            stored = read_table(str(run_dir), table)
            assert meta["crs"] == "EPSG:28992"
            assert found.num_rows == stored.num_rows
            names = [
                ".".join(map(str, key)) for key in zip(*(stored[name].to_pylist() for name in KEYS[table]), strict=True)
            ]
            assert sorted(found["id"].to_pylist()) == sorted(names)
            order = np.argsort(np.array(found["id"].to_pylist()))
            own_order = np.argsort(np.array(names))
            for field in SCHEMAS[table]:
                if str(field.type) not in kinds or field.name not in found.column_names:
                    continue
                assert str(found.schema.field(field.name).type) == kinds[str(field.type)], field.name
                values = found[field.name].take(order).to_pylist()
                assert values == stored[field.name].take(own_order).to_pylist(), field.name
            gone = {
                "bbox",
                "geometry",
                "wall_outline",
                "boxes",
                *(name for name in stored.column_names if name.startswith("solid")),
            }
            assert set(stored.column_names) - gone <= set(found.column_names)
