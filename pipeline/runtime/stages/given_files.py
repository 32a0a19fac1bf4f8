"""What a request gives beside its inputs; each reader is loaded where there is something to read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pipeline.errors import InputError
from pipeline.io import shown
from pipeline.methods import method_named
from pipeline.registry import extra
from pipeline.runtime.plan import Plan
from pipeline.runtime.request import RunRequest
from pipeline.settings import RunSettings

if TYPE_CHECKING:
    from pipeline.extras.footprints.given_footprints import GivenFootprints
    from pipeline.extras.guides.given_guides import GivenGuides
    from pipeline.extras.overrides.overrides_file import Override


def footprints_for(request: RunRequest, plan: Plan) -> GivenFootprints | None:
    """The footprints of a run; None without a file, a layer or a column of them."""
    named = (request.footprints, request.footprints_layer)
    if named == (None, None) and not request.settings.footprints.columns:
        return None
    given: GivenFootprints | None = extra("footprints_of_run")(
        request.footprints, plan, request.settings.footprints, request.footprints_layer
    )
    return given


def overrides_for(request: RunRequest, plan: Plan, settings: RunSettings) -> Sequence[Override]:
    """The overrides of a run."""
    if request.overrides is None:
        return ()
    read: Sequence[Override] = extra("read_overrides")(request.overrides, plan.reference, settings)
    return read


def guides_for(request: RunRequest, plan: Plan, variants: Sequence[RunSettings]) -> GivenGuides | None:
    """The guides of a run; None without a file. Raises InputError if they, or one of the methods, cannot be used."""
    if request.guides is None:
        return None
    for one in variants:
        if not one.building.arranges(method_named(one.general.method)):
            raise InputError(
                shown(request.guides),
                f"{one.general.method} traces roof faces from labelled points and takes no guides",
                'Use faces = "arranged" or the method arrangement, or leave --guides out',
            )
    given: GivenGuides | None = extra("given_guides")(request.guides, plan, variants[0].building.guides.kind_column)
    return given
