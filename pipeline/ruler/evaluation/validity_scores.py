"""Validity of solids by ISO 19107, judged by the same code as the solids of this program."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline.quality.validity import DEFAULT_TOLERANCES, ValidityTolerances, check_solid
from pipeline.ruler.evaluation.bootstrap import share
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.models import ModelSet
from pipeline.ruler.evaluation.reading.raw import is_closed
from pipeline.ruler.evaluation.subsets import MODELS_ALONE, measured_all

NO_SOLID = "no_solid"
"""Instead of a code, for a model of surfaces alone."""
_SHARES = ("models_valid", "models_closed", "models_no_solid")

DEFINITIONS = (
    defined(
        "validity.solids_valid",
        "solids valid",
        "Solids without any code of ISO 19107 (val3dity's codes and default tolerances, vertices to 1 mm) / solids.",
    ),
    defined(
        "validity.models_valid",
        "models with all solids valid",
        "Models with at least one solid, all of them valid / models delivered; a model of surfaces alone is not valid.",
    ),
    defined(
        "validity.models_closed",
        "models with closed solids",
        "Models with at least one solid, every edge of each run both ways equally often / models delivered.",
    ),
    defined(
        "validity.models_no_solid",
        "models without a solid",
        "Models of surfaces alone (MultiSurface, open meshes) / models delivered.",
        Better.LOWER,
    ),
    defined("validity.faulty_solids", "faulty solids", "Solids with at least one code.", Better.LOWER, "count"),
)
"""The measures of this chapter."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelValidity:
    """The faults of the solids of one model."""

    building_id: str
    codes: tuple[tuple[int, ...], ...]
    """Codes of each solid, ascending; empty for a valid one."""
    closed: tuple[bool, ...]
    """Whether each solid is closed: every edge occurs equally often in both directions."""

    @property
    def n_solids(self) -> int:
        """Its solids."""
        return len(self.codes)

    @property
    def n_valid(self) -> int:
        """Those without a fault."""
        return sum(not codes for codes in self.codes)

    @property
    def is_valid(self) -> bool:
        """True with at least one solid, all of them valid."""
        return bool(self.codes) and self.n_valid == self.n_solids

    @property
    def is_closed(self) -> bool:
        """True with at least one solid, all of them closed."""
        return bool(self.closed) and all(self.closed)


def validity(models: ModelSet, tolerances: ValidityTolerances = DEFAULT_TOLERANCES) -> tuple[ModelValidity, ...]:
    """The faults of the solids of every model, in their order; vertices are rounded to millimetres."""
    return tuple(
        ModelValidity(
            building_id=model.building_id,
            codes=tuple(check_solid(solid, tolerances) for solid in model.solids),
            closed=tuple(is_closed(solid.vertices, (face.rings for face in solid.faces)) for solid in model.solids),
        )
        for model in models.models
    )


def code_counts(rows: Sequence[ModelValidity]) -> dict[str, int]:
    """How many solids have each code, ascending, then the models without a solid under `no_solid`; none of zero."""
    counts: dict[str, int] = {}
    for code in sorted({code for row in rows for codes in row.codes for code in codes}):
        counts[str(code)] = sum(code in codes for row in rows for codes in row.codes)
    without = sum(row.n_solids == 0 for row in rows)
    return {**counts, NO_SOLID: without} if without else counts


def measures(rows: Sequence[ModelValidity]) -> list[Measure]:
    """The figures of `DEFINITIONS` over some models, each model a unit of the bootstrap."""
    columns = {
        "models": np.ones(len(rows)),
        "solids": np.array([row.n_solids for row in rows], np.float64),
        "solids_valid": np.array([row.n_valid for row in rows], np.float64),
        "models_valid": np.array([row.is_valid for row in rows], np.float64),
        "models_closed": np.array([row.is_closed for row in rows], np.float64),
        "models_no_solid": np.array([row.n_solids == 0 for row in rows], np.float64),
    }
    n_solids = int(columns["solids"].sum())
    figures = [
        ("validity.solids_valid", share("solids_valid", "solids"), n_solids),
        *((f"validity.{name}", share(name, "models"), len(rows)) for name in _SHARES),
    ]
    faulty = float(n_solids - columns["solids_valid"].sum())
    return [
        *measured_all(columns, MODELS_ALONE, figures),
        Measure(name="validity.faulty_solids", value=faulty, n=n_solids),
    ]
