"""Distances that the steps of the ground filter and of planarity look; settings add them up.

They are not settings: each belongs to the definition of its step, such as a few cells of a lattice or some rounds.
"""

from __future__ import annotations

PIT_CELLS = 2
"""The pit test looks at the 24 cells around a cell."""

ROOFS_ALONE_CELLS = 129
"""The verdict whether anything was seen around a given footprint: `roofs_alone` says what adds up to it."""

GAP_CELLS = 4
"""Gaps between points are closed this far from their rims; the fill is smoothed in as many rounds."""

CLUMP_CELLS = 6
"""Half side of the square in which a clump of low outliers must be rare."""

ALONG_CELLS = 6
"""The edges of a deck are compared with those of the cells this far along them, to both sides."""

COARSE = 2
"""Side of a coarse cell in cells of the terrain lattice, which are metres."""

FILL = 2
"""Coarse cells by which the gaps between sparse points are closed."""

NARROW = 2
"""Half the width, in coarse cells, of the courtyards, trenches and clumps of low outliers that are filled first."""

RIM_CELLS = 3
"""Corners this near to a wide object belong to it."""

BLOCK_CELLS = 48
"""Side of the blocks in which surfaces are judged as embankments: three times the width of most dams."""

LINK_CELLS = 6
"""Farthest apart that two neighbouring cells of such a surface may be."""

NEAR_CELLS = 16
"""Half side of the widest square in which ground that rejoined by planes carries the terrain.

Wider squares lie under wide objects, where the ground around them decides. The other ground looks less far."""

GLASS_SQUARE_MM, GLASS_NEAR, GLASS_SQUARES = 2000, 2, 2
"""The search for glass: side of its squares, how many around one are judged together, and how many hold neighbours."""

GLASS_M = GLASS_SQUARE_MM / 1000.0 * (GLASS_NEAR + 1 + 2 * GLASS_SQUARES)
"""How far it looks at points: its own square and those around it, and neighbours of neighbours."""

GLASS_PLANARITY_M = GLASS_SQUARE_MM / 1000.0 * (GLASS_NEAR + 1)
"""How far it looks at the planarity of vertices: its own square, and those around it."""

PLANARITY_SCALES = 3
"""Planarity is judged in windows of one, two and four radii."""


def wide_support_m(radius: int) -> float:
    """How far `wide_objects` looks: alignment of the coarse cells, gaps, closing, opening, neighbours, corners."""
    return float(COARSE * (FILL + 2 * NARROW + 2 * -(-radius // COARSE) + 1) + COARSE - 1 + RIM_CELLS)


def embankments_support_m() -> float:
    """How far `embankments` looks: a block from corner to corner, and a link beyond it."""
    return float(BLOCK_CELLS - 1 + LINK_CELLS)


def between_walls_support_m(widest: int) -> float:
    """How far `between_walls` looks: the width of a deck, and the cells along its edges."""
    return float(widest + ALONG_CELLS)
