"""How the planes of a method become roof faces: the choice that the methods of the papers have in common.

None of the papers says how the borders of roof faces are drawn: they stop at planes, clusters or labelled points.
Borders traced between the labels keep to what the method said of every point; an arrangement of the lines in which
planes meet (`roof.arrangement`) fills the outline with the faces that explain the points best.
"""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofFaceSettings(Parameters):
    """Settings of a method whose roof faces can be drawn in either way; without them its planes are arranged."""

    faces: str = parameter(
        "arranged",
        "How the plan is cut into roof faces: along the lines in which the planes meet, or between the labels of the "
        "points.",
        choices=("arranged", "traced"),
    )
