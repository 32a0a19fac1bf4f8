"""Records: their columns, their units and what is unknown."""

import dataclasses
import datetime as dt
import re

import numpy as np
import pytest
import shapely
import small_buildings as small
from small_buildings import Builder, Contexts, RejectedObjects

from pipeline.export.record_rows import (
    BUILDINGS,
    PLANES,
    REJECTED,
    CandidateFacts,
    building_row,
    plane_rows,
    rejected_row,
)
from pipeline.export.stored_coordinates import crs_coordinates, decimals, epsg_code
from pipeline.model import Plane
from pipeline.quality.detection import detection_confidence

DESIGNED = """building_id, source_id, source_attributes, status, reason, reason_detail, overridden, method, roof_type,
geometry, lod, solid, solid_parts, solid_surfaces, solid_planes, solid_lod12, solid_lod12_parts, solid_lod12_surfaces,
solid_lod13, solid_lod13_parts, solid_lod13_surfaces, solid_lod20, solid_lod20_parts, solid_lod20_surfaces,
solid_lod23, solid_lod23_parts, solid_lod23_surfaces, solid_lod23_planes, boxes, ground_z, ground_source, eave_z,
ridge_z, h_min, h_50p, h_70p, h_max, height_m, height_source, footprint_area_m2, footprint_share, roof_area_m2,
volume_m3, n_points, density_per_m2, through_share, detection_confidence, n_planes, rmse_m, p95_m, coverage,
point_spacing_m, noise_m, share_within_0_2m, share_below_roof, unexplained_m2, extrapolated_share, largest_hole_m,
ridge_z_sigma_m, outline_sigma_m, bic_margin, is_curved, valid, validity_codes, touches_data_edge, strip_offset_m,
ground_noise_m, wall_outline, overhang_m, overhang_sigma_m, overhang_source, lod23_reason, n_boxes, guides_followed,
guides_not_followed, acquired_from, acquired_to, mesh_path, input_hash, settings_hash, engine_version"""
CRSES = ["compound", "feet and metres", "US feet", "unknown"]


def test_buildings_have_the_designed_columns_in_order() -> None:
    assert BUILDINGS.names == re.split(r",\s", DESIGNED)


@pytest.mark.parametrize("crs", CRSES)
def test_rows_have_the_columns_of_their_schemas(
    contexts: Contexts, rejected_objects: RejectedObjects, crs: str
) -> None:
    for build in (small.gable, small.courtyard, small.failed):
        assert list(building_row(build(), contexts[crs])) == BUILDINGS.names
        assert all(list(row) == PLANES.names for row in plane_rows(build(), contexts[crs]))
    assert all(list(rejected_row(entry, contexts[crs])) == REJECTED.names for entry in rejected_objects)


def test_a_gable_in_metres_reads_as_built(contexts: Contexts) -> None:
    row = building_row(small.gable(), contexts["compound"], mesh_path="meshes/t/gable.obj")
    elevations = [row[name] for name in ("ground_z", "eave_z", "ridge_z", "h_min", "h_50p", "h_70p", "h_max")]
    assert elevations == [2.0, 5.0, 8.0, 5.0, 6.5, 7.1, 8.0]
    assert (row["height_m"], row["footprint_area_m2"], row["roof_area_m2"], row["volume_m3"]) == (6.0, 80.0, 100.0, 360)
    assert (row["status"], row["reason"], row["valid"], row["n_planes"], row["lod"]) == ("ok", None, True, 2, "2.2")
    assert shapely.from_wkb(row["geometry"]).equals(shapely.box(85_000, 447_000, 85_010, 447_008))


def test_the_share_of_a_given_footprint_is_reported_and_null_without_one(contexts: Contexts) -> None:
    assert building_row(small.gable(footprint_share=2.0 / 3.0), contexts["US feet"])["footprint_share"] == 0.6667
    assert building_row(small.gable(), contexts["US feet"])["footprint_share"] is None


def test_the_quality_of_a_model_is_reported_as_it_was_measured(contexts: Contexts) -> None:
    row = building_row(small.gable(), contexts["US feet"])
    figures = ("point_spacing_m", "noise_m", "share_within_0_2m", "share_below_roof", "unexplained_m2")
    assert [row[name] for name in figures] == [0.48, 0.029, 0.981, 0.0625, 1.25]
    known = [row[name] for name in ("extrapolated_share", "largest_hole_m", "ridge_z_sigma_m", "bic_margin")]
    assert known == [0.0625, 1.4, 0.017, 12.5]
    assert row["is_curved"] is False
    curved = dataclasses.replace(small.gable(), quality=dataclasses.replace(small.QUALITY, is_curved=True))
    assert building_row(curved, contexts["US feet"])["is_curved"] is True


def test_columns_in_metres_stay_in_metres_where_the_crs_is_in_feet(contexts: Contexts) -> None:
    metres = building_row(small.gable(), contexts["unknown"])
    feet = building_row(small.gable(), contexts["US feet"])
    for name in BUILDINGS.names:
        if name.endswith(("_m", "_m2", "_m3", "_per_m2")):
            assert feet[name] == metres[name], name
    for name in ("ground_z", "eave_z", "ridge_z", "h_50p"):
        assert feet[name] == pytest.approx(metres[name] * 3937.0 / 1200.0, abs=1e-4), name


def test_elevations_follow_the_vertical_unit_and_plans_the_horizontal_one(contexts: Contexts) -> None:
    row = building_row(small.gable(), contexts["feet and metres"])
    assert row["ridge_z"] == 8.0
    west, south, _, _ = shapely.from_wkb(row["geometry"]).bounds
    assert (west, south) == pytest.approx((85_000 / 0.3048, 447_000 / 0.3048), abs=1e-4)


def test_what_a_failed_candidate_lacks_is_null_and_not_zero(contexts: Contexts) -> None:
    row = building_row(small.failed(), contexts["compound"])
    empty = {name for name, value in row.items() if value is None}
    assert empty == {
        *("source_id", "geometry", "lod", "eave_z", "ridge_z", "h_min", "h_50p", "h_70p", "h_max", "height_m"),
        *("footprint_area_m2", "footprint_share", "roof_area_m2", "volume_m3", "density_per_m2", "rmse_m", "p95_m"),
        *("point_spacing_m", "noise_m", "share_within_0_2m", "unexplained_m2", "largest_hole_m", "ridge_z_sigma_m"),
        *("share_below_roof", "extrapolated_share", "outline_sigma_m"),
        *("strip_offset_m", "ground_noise_m", "wall_outline", "overhang_m", "overhang_sigma_m"),
        *("overhang_source", "lod23_reason"),
        *("through_share", "detection_confidence", "ground_source", "height_source"),
        *("guides_followed", "guides_not_followed", "boxes", "n_boxes"),
        *("bic_margin", "source_attributes", "overridden", "mesh_path", "input_hash"),
        *("solid", "solid_parts", "solid_surfaces", "solid_planes"),
        *("solid_lod12", "solid_lod12_parts", "solid_lod12_surfaces"),
        *("solid_lod13", "solid_lod13_parts", "solid_lod13_surfaces"),
        *("solid_lod20", "solid_lod20_parts", "solid_lod20_surfaces"),
        *("solid_lod23", "solid_lod23_parts", "solid_lod23_surfaces", "solid_lod23_planes"),
    }
    assert (row["valid"], row["n_planes"], row["coverage"], row["ground_z"]) == (False, 0, 0.0, 2.0)


def test_facts_of_a_candidate_stand_above_those_of_the_run(contexts: Contexts) -> None:
    moment = dt.datetime(2020, 5, 5, tzinfo=dt.UTC)
    facts = {"gable": CandidateFacts(input_hash="ab", acquired_from=moment, acquired_to=moment)}
    context = dataclasses.replace(contexts["compound"], facts=facts)
    own, other = building_row(small.gable(), context), building_row(small.pent(), context)
    assert (own["input_hash"], own["acquired_from"]) == ("ab", moment)
    assert (other["input_hash"], other["acquired_from"]) == (None, contexts["compound"].acquired_from)


def test_only_a_building_found_in_the_points_alone_has_a_confidence(contexts: Contexts) -> None:
    def confidence(overridden: str | None = None, **changes: str) -> float | None:
        facts = {"gable": CandidateFacts(through_share=0.1, overridden=overridden)}
        row = building_row(small.gable(**changes), dataclasses.replace(contexts["compound"], facts=facts))
        assert row["through_share"] == 0.1
        found: float | None = row["detection_confidence"]
        return found

    gable = small.gable()
    assert gable.footprint is not None
    plane_area_m2 = gable.footprint.area / len(gable.planes)
    expected = detection_confidence(small.QUALITY.noise_m, plane_area_m2)
    assert confidence() == confidence("method") == pytest.approx(expected, abs=5e-4)
    assert confidence("accept, method") is confidence("footprint") is None
    assert confidence(source_id="parcel 7") is None


def test_a_rejected_object_has_the_confidence_that_it_is_a_building_after_all(
    contexts: Contexts, rejected_objects: RejectedObjects
) -> None:
    tree, pole = rejected_objects
    known = dataclasses.replace(tree, confidence=0.034567)
    rows = [rejected_row(entry, contexts["compound"]) for entry in (known, pole)]
    assert [row["detection_confidence"] for row in rows] == [0.0346, None]


@pytest.mark.parametrize("crs", CRSES)
@pytest.mark.parametrize("build", [small.gable, small.pent, small.courtyard, small.two_parts])
def test_faces_satisfy_the_equation_of_their_plane_in_crs_units(contexts: Contexts, crs: str, build: Builder) -> None:
    for row in plane_rows(build(), contexts[crs]):
        *normal, offset = row["coefficients"]
        xyz = shapely.get_coordinates(shapely.from_wkb(row["geometry"]), include_z=True)
        residuals = (xyz - [row["origin_x"], row["origin_y"], row["origin_z"]]) @ normal + offset
        assert np.abs(residuals).max() < 2e-3
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert normal[2] > 0.0


def test_slope_and_o_distance_are_metric_where_the_units_differ(contexts: Contexts) -> None:
    for crs in CRSES:
        row = plane_rows(small.gable(), contexts[crs])[0]
        assert row["slope_deg"] == pytest.approx(np.degrees(np.arctan(0.75)), abs=1e-4)
        assert row["aspect_deg"] == 180.0
        assert row["o_distance_m"] == pytest.approx(3.0 * 0.8)
        assert row["area_m2"] == pytest.approx(50.0)


def test_an_aspect_just_west_of_north_is_not_a_full_turn(contexts: Contexts) -> None:
    plane = Plane(a=1e-9, b=-0.5, c=3.0, n_points=9, rmse_m=0.0)
    assert plane.aspect_deg > 359.9999
    result = dataclasses.replace(small.pent(), planes=(plane,))
    assert plane_rows(result, contexts["compound"])[0]["aspect_deg"] == 0.0


def test_one_plane_of_several_faces_is_a_multipolygon(contexts: Contexts) -> None:
    result = small.two_parts()
    faces = tuple(dataclasses.replace(face, plane=face.plane % 2) for face in result.faces)
    shared = dataclasses.replace(result, faces=faces, planes=result.planes[:2])
    rows = plane_rows(shared, contexts["compound"])
    assert [shapely.from_wkb(row["geometry"]).geom_type for row in rows] == ["MultiPolygon"] * 2
    assert [row["area_m2"] for row in rows] == pytest.approx([100.0, 100.0])


@pytest.mark.parametrize("unit_m", [1.0, 0.3048, 1200.0 / 3937.0, 0.01, 1000.0])
def test_a_millimetre_survives_the_way_through_any_unit(unit_m: float) -> None:
    reference = small.Reference(horizontal_unit_m=unit_m, vertical_unit_m=unit_m)
    local = np.random.default_rng(3).integers(-100_000, 100_000, (500, 3)) / 1000.0
    out = crs_coordinates(local, small.ORIGIN, reference)
    written = [[f"{v:.{decimals(unit_m)}f}" for v in row] for row in out]
    back = np.array(written, dtype=np.float64) * unit_m - small.ORIGIN
    assert np.array_equal(np.round(back * 1000.0), np.round(local * 1000.0))


def test_the_epsg_code_of_a_compound_without_one_is_its_horizontal_part() -> None:
    parts = [{"id": {"authority": "EPSG", "code": 28992}}, {"id": {"authority": "EPSG", "code": 5709}}]
    assert epsg_code(small.Reference(projjson={"type": "CompoundCRS", "components": parts})) == 28992
    assert epsg_code(small.Reference(epsg=7415, projjson={"components": parts})) == 7415
    assert epsg_code(small.Reference(projjson={"name": "local grid"})) is None
    assert epsg_code(small.Reference()) is None


def test_the_geometry_does_not_depend_on_where_a_ring_starts_or_which_way_it_runs(contexts: Contexts) -> None:
    result = small.courtyard()
    shell, hole = (list(ring.coords)[:-1] for ring in (result.footprint.exterior, result.footprint.interiors[0]))
    turned = small.Polygon([*shell[2:], *shell[:2]][::-1], [[*hole[1:], hole[0]][::-1]])
    one = building_row(result, contexts["compound"])["geometry"]
    two = building_row(dataclasses.replace(result, footprint=turned), contexts["compound"])["geometry"]
    assert one == two
    assert shapely.from_wkb(one).exterior.is_ccw
    assert not shapely.from_wkb(one).interiors[0].is_ccw
