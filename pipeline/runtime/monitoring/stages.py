"""The stages of runs and jobs, each described once: name, words, unit, and share of the time."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage."""

    name: str
    """As in events, logs and metrics."""
    does: str
    """What it does, as a command: the page shows it."""
    message: str
    """What happens while it runs, as a sentence without its point."""
    unit: str
    """What its progress counts."""
    of: str
    """The jobs that have it: all, models, points, terrain, formats, compare, classify, compile or overrides."""
    weight: int = 0
    """Share of the time of a reconstruction, in percent; measured on city blocks. Short stages have none."""
    classify_weight: int = 0
    """The same of a classification."""


STAGES = (
    Stage("compile", "Compile, once on this machine", "kernels are translated for this machine", "kernels", "compile"),
    Stage("inputs", "Prepare the inputs", "inputs are prepared", "files", "all", 4, 4),
    Stage("plan", "Plan the tiles", "the run is planned", "files", "all", 1, 1),
    Stage("ingest", "Read the points", "points are read", "files", "all", 10, 10),
    Stage("cells", "Mark duplicates and outliers", "duplicates and outliers are marked", "tiles", "all", 2, 3),
    Stage("ground", "Find the ground", "the ground is found", "blocks", "all", 3, 4),
    Stage("split", "Find walls and roofs", "surfaces are found in the tiles", "tiles", "all", 18, 21),
    Stage("redraw", "Draw the outlines of overrides", "outlines of overrides are drawn", "tiles", "overrides"),
    Stage(
        "join", "Join surfaces over borders", "surfaces are joined across the borders of tiles", "blocks", "all", 1, 1
    ),
    Stage(
        "outline",
        "Separate and outline the buildings",
        "touching buildings are separated and outlined",
        "tasks",
        "all",
        6,
        4,
    ),
    Stage("reconstruct", "Model the buildings", "buildings are modelled", "buildings", "models", 35),
    Stage("publish", "Write the results", "tiles are written", "tiles", "models", 4),
    Stage("octree", "Write the points", "points are arranged for viewing", "tiles", "points", 5),
    Stage("terrain", "Write the terrain", "the terrain is written", "tiles", "terrain", 1),
    Stage("formats", "Write other formats", "further formats are written", "formats", "formats", 3),
    Stage("records", "Compare the runs", "the runs are compared", "tasks", "compare"),
    Stage("points", "Read points for the pictures", "points are read for the pictures", "tasks", "compare"),
    Stage("pictures", "Draw the pictures", "pictures are drawn", "tasks", "compare"),
    Stage("page", "Write the page", "the page is written", "tasks", "compare"),
    Stage("classify", "Classify the points", "points are classified", "tiles", "classify", 0, 22),
    Stage("write", "Write the files", "files are written", "files", "classify", 0, 12),
    Stage("rasters", "Draw the rasters", "rasters are drawn", "tiles", "classify", 0, 10),
    Stage("mosaics", "Join the rasters", "rasters are joined", "rasters", "classify", 0, 2),
    Stage("outputs", "Assemble the downloads", "outputs are assembled", "files", "all", 7, 6),
)
"""All stages in the order in which a job goes through them."""
