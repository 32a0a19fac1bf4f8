"""What a run directory has that not all runs write, and how files get there."""

import os
import secrets
from collections.abc import Callable
from pathlib import Path

from pipeline.errors import RunError

POINTS_FOLDER = "points"
"""The points as 3D Tiles."""
TERRAIN_FOLDER = "terrain"
"""The terrain of all tiles."""


Put = Callable[[str, bytes], None]
"""Stores bytes under a path relative to the run directory, atomically: readers see the old file or the new one."""


def put_local(run_dir: str | Path) -> Put:
    """An atomic put into a local run directory: a temporary name that readers skip, then a rename."""
    root = Path(run_dir)

    def put(path: str, data: bytes) -> None:
        target = root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
        try:
            temporary.write_bytes(data)
            temporary.replace(target)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise RunError(f"{target} cannot be written: {error}. Free space, or give another --out") from error

    return put
