"""What a request gives beside its inputs; each reader is loaded where there is something to read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pipeline.errors import InputError
from pipeline.io import shown
from pipeline.methods import method_named
from pipeline.runtime.plan import Plan
from pipeline.runtime.request import RunRequest
from pipeline.settings import RunSettings

if TYPE_CHECKING:
    from pipeline.runtime.overrides.overrides_file import Override
    from pipeline.runtime.stages.given_footprints import GivenFootprints
    from pipeline.runtime.stages.given_guides import GivenGuides


def footprints_for(request: RunRequest, plan: Plan) -> GivenFootprints | None:
    """The footprints of a run; None without a file, a layer or a column of them."""
    named = (request.footprints, request.footprints_layer)
    if named == (None, None) and not request.settings.footprints.columns:
        return None
    from pipeline.runtime.stages.given_footprints import footprints_of_run

    return footprints_of_run(request.footprints, plan, request.settings.footprints, request.footprints_layer)


def overrides_for(request: RunRequest, plan: Plan, settings: RunSettings) -> Sequence[Override]:
    """The overrides of a run."""
    if request.overrides is None:
        return ()
    from pipeline.runtime.overrides.overrides_file import read_overrides

    return read_overrides(request.overrides, plan.reference, settings)


def guides_for(request: RunRequest, plan: Plan, variants: Sequence[RunSettings]) -> GivenGuides | None:
    """The guides of a run; None without a file. Raises InputError if they, or one of the methods, cannot be used."""
    if request.guides is None:
        return None
    from pipeline.runtime.stages.given_guides import given_guides

    for one in variants:
        if not one.building.arranges(method_named(one.general.method)):
            raise InputError(
                shown(request.guides),
                f"{one.general.method} traces roof faces from labelled points and takes no guides",
                'Use faces = "arranged" or the method arrangement, or leave --guides out',
            )
    return given_guides(request.guides, plan, variants[0].building.guides.kind_column)
