"""All settings between a tile's points and its candidates, and the halo that they need."""

from __future__ import annotations

import dataclasses

from pipeline.terrain.settings import (
    CandidateSettings,
    GroundSettings,
    OutlierSettings,
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
    """Classes 3 to 5 are vegetation, which is never part of a building."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """The settings of the stages between a tile's points and its candidates."""

    outliers: OutlierSettings = dataclasses.field(default_factory=OutlierSettings)
    ground: GroundSettings = dataclasses.field(default_factory=GroundSettings)
    vegetation: VegetationSettings = dataclasses.field(default_factory=VegetationSettings)
    surfaces: SurfaceSettings = dataclasses.field(default_factory=SurfaceSettings)
    candidates: CandidateSettings = dataclasses.field(default_factory=CandidateSettings)
    units: UnitSettings = dataclasses.field(default_factory=UnitSettings)

    @property
    def support_m(self) -> float:
        """Farthest that a tile looks beyond its core: to find fragments among points without usable classes."""
        return self.support_with(ClassesInUse(), footprints=False)

    def support_with(self, classes: ClassesInUse, *, footprints: bool) -> float:
        """How far in metres a tile looks beyond its core, given classes in use and `footprints`; at most `support_m`.

        Three lengths add up: how far from the core terrain is needed, how far a terrain elevation looks from there, and
        how far the search for outliers looks.

        - Terrain is stored for the core and its apron (`APRON_M`). Fragments need it at all points of the core and at
          the facets and vertices around it. With given footprints only points of the core count, without a TIN: each
          must lie in a footprint and above the ground.
        - A terrain elevation looks as far as the ground filter. With class 2 as ground no filter runs, which leaves
          `GroundSettings.trusted_support_m`.
        - Class 6 does not shorten the distance: its points are judged one by one.
        """
        ground_m = self.ground.trusted_support_m if classes.ground else self.ground.support_m
        return self.outliers.support_m + ground_m + self.terrain_m(footprints=footprints)

    def terrain_m(self, *, footprints: bool) -> float:
        """How far beyond the core terrain is needed, in metres: for points in given footprints, or for all points."""
        if footprints:
            return float(APRON_M)
        around_m = max(self.surfaces.support_m, self.vegetation.support_m) + self.vegetation.support_m
        return max(float(APRON_M), around_m)
