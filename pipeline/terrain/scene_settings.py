"""All settings between a tile's points and its candidates, and the halo that they need."""

from __future__ import annotations

import dataclasses

from pipeline.terrain.settings import (
    CandidateSettings,
    GroundSettings,
    OutlierSettings,
    StripSettings,
    SurfaceSettings,
    UnitSettings,
    VegetationSettings,
)

APRON_M = 6
"""Width in metres of the terrain that a tile stores beyond its core."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassesInUse:
    """Which of the file's classes are believed, decided once for a run."""

    ground: bool = False
    """Class 2 is the ground; no filter runs."""
    building: bool = False
    """Class 6 is building, classes that exclude buildings are believed, the rest is judged by its own evidence."""
    vegetation: bool = False
    """Classes 3 to 5 are vegetation; neither it nor other things, such as water, are ever part of a building."""
    roofs: bool = False
    """Class 6 is never ground, although the ground is found in the points."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """The settings of the stages between a tile's points and its candidates."""

    outliers: OutlierSettings = dataclasses.field(default_factory=OutlierSettings)
    ground: GroundSettings = dataclasses.field(default_factory=GroundSettings)
    vegetation: VegetationSettings = dataclasses.field(default_factory=VegetationSettings)
    surfaces: SurfaceSettings = dataclasses.field(default_factory=SurfaceSettings)
    candidates: CandidateSettings = dataclasses.field(default_factory=CandidateSettings)
    units: UnitSettings = dataclasses.field(default_factory=UnitSettings)
    strips: StripSettings = dataclasses.field(default_factory=StripSettings)

    @property
    def support_m(self) -> float:
        """Farthest in metres that points beyond its core matter to a tile: where it looks, and whether those count."""
        return self.split_support_m(footprints=False) + self.outliers.support_m

    def split_support_m(self, *, footprints: bool) -> float:
        """How far in metres the split of a tile looks at points beyond its core.

        A fragment depends on the facets around it, and these on the planarity of their vertices. Points in given
        footprints are taken one by one, without a TIN.
        """
        return 0.0 if footprints else self.surfaces.support_m + self.vegetation.support_m

    def terrain_m(self, *, footprints: bool) -> float:
        """How far beyond the core the split needs terrain, in metres: at all points that it looks at."""
        return max(float(APRON_M), self.split_support_m(footprints=footprints))

    def ground_support_m(self, classes: ClassesInUse) -> float:
        """How far in metres a terrain elevation looks at the lowest points of cells.

        It looks as far as the ground filter. With class 2 as ground no filter runs, only planes are drawn.
        """
        return self.ground.trusted_support_m if classes.ground else self.ground.support_m
