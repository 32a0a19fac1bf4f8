"""The digest of a run: blind to files, order and storage, awake to every millimetre."""

import dataclasses
import datetime as dt
import functools
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
import small_buildings as small
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from small_buildings import Contexts, RejectedObjects

from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import BUILDINGS, SCHEMAS, CandidateFacts
from pipeline.export.tile import write_tile
from pipeline.runtime.digest import ADDED, FIGURES_ONLY, NOT_CONTENT, canonical_rows, run_digest

BUILT = (
    small.gable,
    small.courtyard,
    small.two_parts,
    small.failed,
    small.pent,
    small.levelled,
    small.overhung,
    functools.partial(small.boxed, "with_boxes"),
)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory, contexts: Contexts, rejected_objects: RejectedObjects) -> Path:
    folder = tmp_path_factory.mktemp("run")
    write_tile(folder, "t1", [build() for build in BUILT], rejected_objects, contexts["compound"])
    return folder


def rewritten(run_dir: Path, target: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> Path:
    """A copy of a run, one table of which went through a function."""
    shutil.copytree(run_dir, target, dirs_exist_ok=True)
    path = target / table / "tile=t1" / "part-0.parquet"
    pq.write_table(change(pq.ParquetFile(path).read()), path)
    return target


def with_value(table: pa.Table, column: str, row: int, value: object) -> pa.Table:
    """A table with one value changed."""
    values = table[column].to_pylist()
    values[row] = value
    index = table.schema.get_field_index(column)
    field = table.schema.field(column).with_nullable(True)
    return table.set_column(index, field, pa.array(values, field.type))


@settings(max_examples=examples(15), deadline=None)
@given(data=st.data())
def test_rows_may_lie_in_any_files_row_groups_and_order(
    data: st.DataObject, run_dir: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    target = tmp_path_factory.mktemp("split")
    for name in SCHEMAS:
        table = read_table(str(run_dir), name).drop_columns("tile")
        order = data.draw(st.permutations(range(table.num_rows)))
        tiles = data.draw(st.lists(st.sampled_from("abc"), min_size=len(order), max_size=len(order)))
        group, compression = data.draw(st.integers(1, 5)), data.draw(st.sampled_from(["none", "zstd", "snappy"]))
        (target / name).mkdir()
        for tile in sorted(set(tiles)):
            (target / name / f"tile={tile}").mkdir()
            rows = [row for row, place in zip(order, tiles, strict=True) if place == tile]
            path = target / name / f"tile={tile}" / "part-0.parquet"
            pq.write_table(table.take(rows), path, row_group_size=group, compression=compression)
    assert run_digest(str(target)) == run_digest(str(run_dir))


def test_tile_mesh_path_and_input_hash_are_no_content(
    run_dir: Path, tmp_path: Path, contexts: Contexts, rejected_objects: RejectedObjects
) -> None:
    same = contexts["compound"]
    hashed = CandidateFacts(input_hash="another", acquired_from=same.acquired_from, acquired_to=same.acquired_to)
    other = dataclasses.replace(same, facts={build().building_id: hashed for build in BUILT})
    write_tile(tmp_path, "t1", [build() for build in BUILT[:2]], [], other, "none")
    write_tile(tmp_path, "t2", [build() for build in BUILT[2:]], rejected_objects, other, "tile")
    assert run_digest(str(tmp_path)) == run_digest(str(run_dir))


@pytest.mark.parametrize("name", sorted(set(BUILDINGS.names) - NOT_CONTENT))
def test_every_column_of_content_counts(run_dir: Path, tmp_path: Path, name: str) -> None:
    def change(table: pa.Table) -> pa.Table:
        row = next((i for i, value in enumerate(table[name].to_pylist()) if value is not None), 0)
        value = table[name][row].as_py()
        kind = table.schema.field(name).type
        if value is None and (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            value = 0.0 if pa.types.is_floating(kind) else 0
        kinds = {
            bool: lambda: not value,
            int: lambda: value + 1,
            float: lambda: value + 0.001,
            list: lambda: value[:-1],
            bytes: lambda: value + b"x",
            dt.datetime: lambda: value + dt.timedelta(microseconds=1),
        }
        other = kinds.get(type(value), lambda: f"{value} 7" if name == FIGURES_ONLY else f"{value}x")
        return with_value(table, name, row, other())

    assert run_digest(str(rewritten(run_dir, tmp_path, "buildings", change))) != run_digest(str(run_dir))


def test_columns_of_later_options_count_only_where_they_have_a_value(run_dir: Path) -> None:
    # a run from before there were such columns has the digest of one that asks for none of these options
    table = read_table(str(run_dir), "buildings").combine_chunks()
    (batch,) = table.to_batches()
    (older,) = table.drop_columns(sorted(ADDED)).to_batches()
    same = [new == old for new, old in zip(canonical_rows(batch), canonical_rows(older), strict=True)]
    unasked = pa.compute.and_(*(pa.compute.is_null(table[name]) for name in ("solid_lod23", "boxes")))
    assert same == unasked.to_pylist()
    assert same.count(False) == 2


def test_only_the_figures_of_a_reason_count(run_dir: Path, tmp_path: Path) -> None:
    def detail(text: str) -> str:
        target = tmp_path / str(len(text))
        other = rewritten(run_dir, target, "buildings", lambda table: with_value(table, FIGURES_ONLY, 0, text))
        return run_digest(str(other))

    first = detail("12 points, fewer than min_points 24.5")
    assert detail("min_points is 24.5, and the candidate has 12 points") == first
    assert detail("12 points, fewer than 24.6") != first


@pytest.mark.parametrize("column", ["settings_hash", "engine_version"])
def test_names_of_settings_and_the_version_are_not_content(run_dir: Path, tmp_path: Path, column: str) -> None:
    other = rewritten(run_dir, tmp_path, "buildings", lambda table: with_value(table, column, 0, "another"))
    assert run_digest(str(other)) == run_digest(str(run_dir))


@pytest.mark.parametrize("table", list(SCHEMAS))
def test_a_vertex_that_moves_by_a_millimetre_changes_the_digest(run_dir: Path, tmp_path: Path, table: str) -> None:
    def change(found: pa.Table) -> pa.Table:
        row = next(i for i, wkb in enumerate(found["geometry"].to_pylist()) if wkb is not None)
        polygon = shapely.from_wkb(found["geometry"][row].as_py())
        corners = shapely.get_coordinates(polygon, include_z=polygon.has_z)
        corners[1, 0] += 0.001
        moved = shapely.to_wkb(shapely.set_coordinates(polygon, corners), flavor="iso")
        return with_value(found, "geometry", row, moved)

    assert run_digest(str(rewritten(run_dir, tmp_path, table, change))) != run_digest(str(run_dir))


def test_a_lost_row_changes_the_digest(run_dir: Path, tmp_path: Path) -> None:
    before = run_digest(str(run_dir))
    for table in SCHEMAS:
        assert run_digest(str(rewritten(run_dir, tmp_path / table, table, lambda found: found.slice(1)))) != before


def test_how_arrow_holds_the_values_does_not_count(run_dir: Path) -> None:
    (batch,) = read_table(str(run_dir), "buildings").combine_chunks().to_batches()
    reported = list(canonical_rows(batch))
    casts = {"method": pa.large_string(), "n_planes": pa.int64()}
    casts |= {"acquired_from": pa.timestamp("ns", tz="UTC"), "validity_codes": pa.large_list(pa.int64())}
    columns = {name: batch[name].cast(casts.get(name, batch[name].type)) for name in reversed(batch.schema.names)}
    other = pa.RecordBatch.from_pydict(columns | {"status": batch["status"].dictionary_encode()})
    assert list(canonical_rows(other)) == reported
    assert [row for i in range(len(reported)) for row in canonical_rows(batch.slice(i, 1))] == reported


def test_null_zero_and_nothing_are_three_things() -> None:
    def row(**columns: pa.Array) -> bytes:
        return next(canonical_rows(pa.RecordBatch.from_pydict(columns)))

    whole = {row(a=pa.array([value], pa.float64())) for value in (None, 0.0, 1e-9)}
    assert len(whole) == 3
    assert row(a=pa.array([0.0])) == row(a=pa.array([-0.0]))
    texts = [("a", "bc"), ("ab", "c"), (None, "abc"), ("", "abc"), ("abc", "")]
    assert len({row(a=pa.array([one], pa.string()), b=pa.array([two], pa.string())) for one, two in texts}) == 5
    lists = [([1], [2, 3]), ([1, 2], [3]), (None, [1, 2, 3]), ([], [1, 2, 3])]
    assert len({row(a=pa.array([one], pa.list_(pa.int32())), b=pa.array([two])) for one, two in lists}) == 4


def test_one_object_in_two_files_is_an_error(run_dir: Path, tmp_path: Path, contexts: Contexts) -> None:
    shutil.copytree(run_dir, tmp_path, dirs_exist_ok=True)
    write_tile(tmp_path, "t2", [small.pent()], [], contexts["compound"])
    with pytest.raises(RunError, match="more than one row of building_id 'pent'"):
        run_digest(str(tmp_path))


def test_a_directory_without_a_run_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="buildings is not a folder"):
        run_digest(str(tmp_path))
