"""The page of a run: it shows the content of the run, at any size, and text is never markup."""

import base64
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import small_buildings as small
from command_line import app
from page_reader import Reader, assert_links_stay_within, count
from typer.testing import CliRunner

from pipeline.errors import RunError
from pipeline.model import Reason, Status
from pipeline.report import class_map, run_page
from pipeline.report.run_page import write_run_page
from pipeline.runtime.manifest import PAGE, InputFile, RunManifest, RunStatus, SlowBuilding, write_manifest
from pipeline.runtime.manifest_reading import read_manifest


def change(run: Path, **values: Any) -> RunManifest:
    manifest = dataclasses.replace(read_manifest(run), **values)
    write_manifest(run, manifest)
    return manifest


def page_of(run: Path) -> tuple[str, Reader]:
    where = write_run_page(str(run))
    assert where == f"{run.resolve()}/{PAGE}"
    text = Path(where).read_text(encoding="utf-8")
    read = Reader(text)
    assert read.open == []
    return text, read


def words(read: Reader) -> str:
    return " ".join(" ".join(read.texts).split())


def test_the_page_shows_the_content_of_the_run(street_run: Path) -> None:
    change(
        street_run, timings_s={"split": 3.0, "reconstruct": 6.0, "total": 9.5}, peak_memory_bytes={"driver": 5 * 10**8}
    )
    _, read = page_of(street_run)
    found = words(read)
    for text in ("too few points", "invalid solid", "500 MB", "Failures by reason"):
        assert text in found
    assert "25.00%" in found
    assert sum("bar-of" in (one.get("class") or "") for one in read.all("i")) == 2
    pictures = [one for one in read.all("img") if (one["alt"] or "").startswith("Map:")]
    assert len(pictures) == 1
    png = base64.b64decode(str(pictures[0]["src"]).split(",")[1])
    colours = {status: colour for status, (_, colour, _) in run_page._STATUSES.items()}
    assert count(png, colours[Status.OK]) > 100
    assert count(png, colours[Status.FALLBACK]) > 100
    assert_links_stay_within(read)


def test_the_slowest_are_listed_with_their_facts_and_lost_ones_without(street_run: Path) -> None:
    name = small.gable().building_id
    slowest = (SlowBuilding(building_id="gone", seconds=9.0), SlowBuilding(building_id=name, seconds=1.5))
    manifest = change(
        street_run, slowest=slowest, status=RunStatus.INCOMPLETE, tiles=("x0_y0",), failed_tiles=("x0_y0",)
    )
    assert read_manifest(street_run) == manifest
    text, read = page_of(street_run)
    found = words(read)
    for table in text.split('<table class="sortable">')[1:]:
        rows = table.split("</table>")[0].split("<tr>")[1:]
        assert len({row.count("<td") + row.count("<th ") for row in rows}) == 1  # a script sorts by any column
    assert "gone 9.00 in a tile that could not be published" in found
    assert f"{name} 1.50" in found
    assert "1 of 1 tiles could not be published" in found


def test_a_tile_without_points_has_its_buildings(street_run: Path) -> None:
    lattice = {"tile_size_m": 100.0, "origin_x_m": 0.0, "origin_y_m": 0.0}
    change(street_run, tiles=("x850_y4471",), tiles_without_points=("x850_y4471",), warnings=(), lattice=lattice)
    text, read = page_of(street_run)
    assert "The points of 1 of 1 tiles could not be written ; this does not affect the buildings" in words(read)
    assert "could not be published" not in text


def test_a_tile_without_terrain_has_its_buildings(street_run: Path) -> None:
    change(street_run, tiles=("x850_y4471",), tiles_without_terrain=("x850_y4471",), warnings=())
    text, read = page_of(street_run)
    assert "The terrain of 1 of 1 tiles could not be written ; this does not affect the buildings" in words(read)
    assert "could not be published" not in text


def test_a_failed_tile_is_on_the_map(street_run: Path) -> None:
    lattice = {"tile_size_m": 100.0, "origin_x_m": 0.0, "origin_y_m": 0.0}
    change(
        street_run, status=RunStatus.INCOMPLETE, tiles=("x850_y4471",), failed_tiles=("x850_y4471",), lattice=lattice
    )
    _, read = page_of(street_run)
    (seen,) = (one["alt"] for one in read.all("img"))
    assert "tile that could not be published: 1" in str(seen)


def test_feet_are_drawn_in_metres(make_run: Callable[..., Path]) -> None:
    from small_runs import street

    scales = []
    for unit_m in (1.0, 0.3048):
        _, read = page_of(make_run(street(), f"run{unit_m}", unit_m))
        scales.append([text.strip() for text in read.texts if text.strip().endswith(" m")])
    assert scales[0] != []
    assert scales[0] == scales[1]


def test_a_run_of_nothing_has_a_page_too(make_run: Callable[..., Path]) -> None:
    _, read = page_of(make_run([]))
    assert read.all("img") == []
    assert "Failures by reason" not in words(read)


def test_text_of_the_users_is_no_markup(make_run: Callable[..., Path]) -> None:
    evil = "<script>alert(1)</script>"
    failed = dataclasses.replace(small.failed(), reason_detail=evil, source_id=evil)
    run = make_run([failed])
    inputs = (InputFile(path=evil, sha256="0" * 64, size_bytes=1),)
    change(run, warnings=(evil,), source_licence=evil, inputs=inputs)
    text, _ = page_of(run)
    assert "alert(1)" in text
    assert "<script>alert" not in text


def test_what_is_listed_is_bounded_those_without_a_model_first(
    make_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_page, "LISTED", 3)
    monkeypatch.setattr(class_map, "MAX_ORDINARY", 2)
    blocks = [dataclasses.replace(small.courtyard(), building_id=f"b{k}") for k in range(9)]
    assert blocks[0].status in {Status.FALLBACK, Status.OK}
    blocks = [dataclasses.replace(b, status=Status.FALLBACK, reason=Reason.INVALID_SOLID) for b in blocks]
    failed = [dataclasses.replace(small.failed(), building_id=f"f{k}") for k in range(2)]
    _, read = page_of(make_run([*blocks, *failed]))
    table = [one for one in read.all("div") if one.get("aria-label") == "Buildings without a roof of their own"]
    assert len(table) == 1
    listed = words(read).split("One by one")[1]
    assert "3 of 11" in listed
    assert all(name in listed for name in ("f0", "f1"))
    assert listed.index("f1") < listed.index("b0")
    assert "b1 " not in listed


@pytest.mark.parametrize("status", [RunStatus.RUNNING, RunStatus.FAILED])
def test_a_run_that_is_not_over_has_no_page(street_run: Path, status: RunStatus) -> None:
    change(street_run, status=status)
    with pytest.raises(RunError, match=f"is {status.value}: a report needs a run that ended"):
        write_run_page(str(street_run))
    assert not (street_run / PAGE).exists()


def test_the_command_writes_it_and_names_it(street_run: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["report", str(street_run)])
    assert (done.exit_code, done.stderr.strip()[-8:] or done.stdout.strip()[-8:]) == (0, PAGE)
    assert (street_run / PAGE).is_file()
    assert CliRunner().invoke(app, ["report", str(tmp_path / "nowhere")]).exit_code == 4


def test_a_manifest_without_the_slowest_is_read(street_run: Path) -> None:
    text = (street_run / "run.json").read_text()
    assert '"slowest": []' in text
    (street_run / "run.json").write_text(text.replace('"slowest": [],', ""))
    assert read_manifest(street_run).slowest == ()


def test_a_reason_of_a_later_version_is_shown_by_its_name(street_run: Path) -> None:
    part = street_run / "buildings" / "tile=t2" / "part-0.parquet"
    table = pq.read_table(part, partitioning=None)
    place = table.schema.get_field_index("reason")
    later = pa.array([None if reason is None else "too_shiny" for reason in table["reason"].to_pylist()], pa.string())
    pq.write_table(table.set_column(place, table.schema.field(place), later), part)
    assert "too shiny" in words(page_of(street_run)[1])


def test_a_damaged_table_is_named(street_run: Path) -> None:
    (street_run / "rejected" / "tile=t1" / "part-0.parquet").write_bytes(b"torn")
    with pytest.raises(RunError, match="cannot be read as Parquet"):
        write_run_page(str(street_run))
