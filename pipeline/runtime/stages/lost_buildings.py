"""Buildings that ended their process or met a fault of ours: their records, and their bundles in the quarantine."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import RunError
from pipeline.model import BuildingResult, Reason, Status
from pipeline.runtime.isolation.process_limits import BUNDLE_SUFFIX
from pipeline.runtime.stages.batch_figures import LOST, BatchFigures
from pipeline.runtime.stages.sites import CandidateSite

if TYPE_CHECKING:
    from pipeline.runtime.isolation.replay_bundle import Bundle


NO_BUNDLE = "there is no bundle, since its points cannot be put together"


def bundles_are_whole(folder: str, figures: BatchFigures) -> bool:
    """Whether the bundles that a batch left in the quarantine are whole; not each loss has one."""
    from pipeline.runtime.isolation.replay_bundle import is_whole

    lost = (model.building_id for model in figures.notable if model.reason in LOST)
    bundles = [Path(folder, f"{building_id}{BUNDLE_SUFFIX}") for building_id in lost]
    return all(is_whole(bundle) for bundle in bundles if bundle.is_file())


def quarantined(folder: str, result: BuildingResult, bundle: Bundle | None) -> BuildingResult:
    """Write the bundle of a building; its result, which mentions a bundle that there is not. No folder takes none."""
    if not folder:
        return result
    if bundle is None:
        return dataclasses.replace(result, reason_detail=f"{result.reason_detail}; {NO_BUNDLE}")
    from pipeline.runtime.isolation.replay_bundle import write_bundle

    try:
        write_bundle(folder, bundle)
    except (OSError, RunError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        detail = f"{result.reason_detail}; there is no bundle: {why}"
        return dataclasses.replace(result, reason_detail=detail)
    return result


def failed_site(site: CandidateSite, method: str, reason: Reason, detail: str) -> BuildingResult:
    """The record of a candidate whose points could not be gathered."""
    return BuildingResult(
        building_id=site.building_id,
        origin=(0.0, 0.0, 0.0),
        source_id=site.source_id,
        status=Status.FAILED,
        reason=reason,
        reason_detail=detail,
        method=method,
        footprint=site.footprint,
        ground_z_m=math.nan,
        n_points=site.points,
        density_per_m2=math.nan,
        touches_data_edge=False,
    )
