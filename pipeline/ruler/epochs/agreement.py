"""Whether two runs can be compared, and warnings about differences between them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.errors import CrsError
from pipeline.io.crs import horizontal_part, vertical_part
from pipeline.io.crs_units import states_unit_alone
from pipeline.ruler.epochs.change_records import Doubt
from pipeline.ruler.epochs.epoch import Epoch


def check_agreement(old: Epoch, new: Epoch) -> tuple[str, ...]:
    """Warnings about two runs that are compared, one sentence each; CrsError if their CRS or units differ."""
    warnings = _check_reference(old, new)
    for epoch in (old, new):
        manifest = epoch.manifest
        if manifest.failed_tiles:
            count = len(manifest.failed_tiles)
            warnings.append(f"{count} {'tile' if count == 1 else 'tiles'} of {epoch.name} failed")
        warnings += [f"{epoch.name}: {note}" for note in epoch.coverage.notes]
    differing = differing_makers(old, new)
    warnings += [f"the {what} differ: {how}" for what, how in differing.items()]
    if differing:
        warnings.append(
            f"other {' and '.join(differing)} may draw outlines and roofs anew where nothing was built: areas, volumes "
            f"and iou show that, too, and reshaped rows have the doubt {Doubt.OTHER_VERSION.value}. For changes of the "
            "place alone run the points of OLD again as NEW was run"
        )
    given = [epoch.manifest.request.get("footprints") is not None for epoch in (old, new)]
    if given[0] != given[1]:
        which, other = ("OLD", "NEW") if given[0] else ("NEW", "OLD")
        warnings.append(
            f"{which} was modelled in given footprints, {other} was not: outlines differ by their source, and {which} "
            "has no building without a footprint"
        )
    return tuple(warnings)


def differing_makers(old: Epoch, new: Epoch) -> dict[str, str]:
    """How versions, methods or settings of two runs differ, in words by what differs; empty if none do."""
    before, after = old.manifest, new.manifest
    found = {}
    if before.engine_version != after.engine_version:
        found["versions"] = f"OLD is of {before.engine_version}, NEW of {after.engine_version}"
    if before.method != after.method:
        found["methods"] = f"OLD is of {before.method}, NEW of {after.method}"
    elif before.settings_hash != after.settings_hash:
        found["settings"] = _differing(before.settings, after.settings) or "see run.json of both"
    return found


def _check_reference(old: Epoch, new: Epoch) -> list[str]:
    """Warnings about the reference systems; rejects different ones."""
    first, second = old.reference, new.reference
    fix = "Compare runs of one coordinate reference system: reproject the points of one and run it again"
    for axis, a, b in (
        ("horizontal", first.horizontal_unit_m, second.horizontal_unit_m),
        ("vertical", first.vertical_unit_m, second.vertical_unit_m),
    ):
        if abs(a - b) > 1e-9:
            unit_fix = fix if axis == "horizontal" else "Run one of them again with the right --vertical-unit"
            raise CrsError(new.run_dir, f"its {axis} unit is {b:g} m, that of {old.run_dir} is {a:g} m", unit_fix)
    before, after = first.crs, second.crs
    if before is None or after is None:
        if before is None and after is None:
            return ["the reference systems of both runs are unknown: taken as one and the same"]
        which = "OLD" if before is None else "NEW"
        return [f"the reference system of {which} is unknown: taken as that of the other"]
    if not horizontal_part(before).equals(horizontal_part(after), ignore_axis_order=True):
        raise CrsError(new.run_dir, f"its CRS is {second.name!r}, that of {old.run_dir} is {first.name!r}", fix)
    heights = [_vertical_part(crs) for crs in (before, after)]
    if heights[0] is not None and heights[1] is not None and not heights[0].equals(heights[1]):
        raise CrsError(
            new.run_dir,
            f"its elevations are of {heights[1].name!r}, those of {old.run_dir} of {heights[0].name!r}",
            fix,
        )
    if (heights[0] is None) != (heights[1] is None):
        which = "OLD" if heights[0] is None else "NEW"
        return [f"the vertical reference system of {which} is unknown: taken as that of the other"]
    return []


def _vertical_part(crs: Any) -> Any | None:
    """The vertical CRS of a compound one; None without one, and for one that states a unit alone."""
    part = vertical_part(crs)
    return None if part is None or states_unit_alone(part) else part


def _differing(before: Mapping[str, Any], after: Mapping[str, Any], most: int = 6) -> str:
    """The settings that differ, as `[table] name OLD / NEW`."""
    found = []
    for table in sorted({*before, *after}):
        first, second = (dict(one.get(table) or {}) for one in (before, after))
        found += [
            f"[{table}] {name} {first.get(name)} / {second.get(name)}"
            for name in sorted({*first, *second})
            if first.get(name) != second.get(name)
        ]
    more = f" and {len(found) - most} more" if len(found) > most else ""
    return ", ".join(found[:most]) + more
