"""The digest of a run directory of which some tiles could not be published."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.io import is_url
from pipeline.runtime.cluster.serial_executor import run_alone
from pipeline.runtime.run_context import RunContext
from pipeline.runtime.stages.content_digest import STAGE
from pipeline.runtime.stages.publish import Published
from pipeline.runtime.stages.reconstruct import Models
from pipeline.runtime.stages.sites import Joined


def digest_of_rest(
    context: RunContext, joined: Joined, models: Models, published: Sequence[Published], run_dir: str
) -> str:
    """The digest of what is there."""
    content = (run_dir, _with_tables(run_dir, joined, models, published))
    return run_alone(context.executor, STAGE, _digest_of, content, context.progress.watch)


def _digest_of(content: tuple[str, list[str] | None]) -> str:
    """The digest of a run directory, given its tiles with tables."""
    from pipeline.runtime.digest import run_digest  # loads Arrow, which the driver does not need

    run_dir, tiles = content
    return run_digest(run_dir, tiles=tiles)


def _with_tables(run_dir: str, joined: Joined, models: Models, published: Sequence[Published]) -> list[str] | None:
    """The tiles that have tables in an object store, so that their digest needs no listing; None to list them.

    A store may list an object only some time after it was put. Which tables a failed tile has is unknown, so then the
    store must list them; where all tiles failed it has no folder to list.
    """
    tiles = sorted(outcome.tile.key for outcome in published)
    failed = {outcome.tile.key for outcome in published if outcome.error}
    owners = {tile.key for tile in models.places} | {listed.figures.owner.key for listed in joined.rejected} or set(
        tiles[:1]
    )
    if not is_url(run_dir) or (failed and not owners <= failed):
        return None
    return sorted(owners - failed)
