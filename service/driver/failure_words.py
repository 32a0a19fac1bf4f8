"""Sentences for clients: the result of a run, and messages without paths of this machine or options of commands."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pipeline.model import Status
from service.wording import as_inputs

if TYPE_CHECKING:
    from pipeline.extras.classify.classify import ClassifySummary
    from pipeline.extras.compare.compare import CompareSummary
    from pipeline.runtime.run import RunSummary

# two components or more, not within a URL, a fraction or a relative path
_ABSOLUTE = re.compile(r"(?<![\w:/.\\])/(?:[^\s/:;,'\"()<>|]+/)+([^\s/:;,'\"()<>|]*)")
_ADDRESS = re.compile(r" ?\b(?:tcp|tls|ucx|inproc)://(?:\[[^\]\s]*\]|[^\s/:]*)(?::[0-9]+)?(?:/[^\s:]*)?")
_WARNINGS = 100
"""Maximum number of warnings in the summary of a job; `run.json` has all."""


class Scrubber:
    """Removes the paths of this machine and the addresses of the cluster from messages, and names inputs for options.

    Parameters
    ----------
    names : mapping of str to str, optional
        Names by the path that they replace; other absolute paths are cut to their last component.
    """

    def __init__(self, names: Mapping[str, str] | None = None) -> None:
        self._names = dict(names or {})

    def name(self, path: str, name: str) -> None:
        """Replace a path by a name."""
        self._names[path] = name

    def __call__(self, message: str) -> str:
        """The message as clients may see it.

        >>> scrub = Scrubber({"/state/uploads/0a/tile 1.laz": "tile 1.laz"})
        >>> scrub("/state/uploads/0a/tile 1.laz: 12 m/s at https://host/a/b, see /tmp/x/run.json")
        'tile 1.laz: 12 m/s at https://host/a/b, see run.json'
        >>> scrub("the scheduler tcp://10.0.0.7:8786 was lost: start it")
        'the scheduler was lost: start it'
        >>> scrub("/state/uploads/0a/b.laz: no CRS. Give --crs EPSG:n")
        'b.laz: no CRS. Give the input crs'
        """
        for path in sorted(self._names, key=len, reverse=True):
            message = message.replace(path, self._names[path])
        return as_inputs(_ABSOLUTE.sub(lambda found: found[1] or "…", _ADDRESS.sub("", message)))


def outcome(summary: RunSummary, unpublished: Collection[str] = ()) -> str:
    """The result of a run, in one sentence; with the formats that could not be published.

    Where it is empty, a sentence before that says why.
    """
    sentence = f"{_headline(summary)}{_buildings(summary)}: {_by_status(summary)}"
    rejected = sum(summary.rejected.values())
    if rejected:
        sentence += f"; {rejected} {'object' if rejected == 1 else 'objects'} rejected"
    if summary.failed_tiles:
        count = len(summary.failed_tiles)
        sentence += f"; {count} {'tile' if count == 1 else 'tiles'} could not be published: "
        sentence += "its buildings are missing" if count == 1 else "their buildings are missing"
    if summary.tiles_without_points:
        count = len(summary.tiles_without_points)
        sentence += f"; the points of {count} {'tile' if count == 1 else 'tiles'} could not be written"
    if summary.tiles_without_terrain:
        count = len(summary.tiles_without_terrain)
        sentence += f"; the terrain of {count} {'tile' if count == 1 else 'tiles'} could not be written"
    if unpublished:
        sentence += f"; {', '.join(unpublished)} could not be published"
    if summary.warnings:
        sentence += f"; {len(summary.warnings)} {'warning' if len(summary.warnings) == 1 else 'warnings'}"
    return sentence


def _headline(summary: RunSummary) -> str:
    """Why a result is empty, as a sentence before others; empty where it is not."""
    text = as_inputs(summary.headline)
    return f"{text[0].upper()}{text[1:]}. " if text else ""


def _buildings(summary: RunSummary) -> str:
    total = sum(summary.statuses.values())
    return f"{total} {'building' if total == 1 else 'buildings'}"


def _by_status(summary: RunSummary) -> str:
    return ", ".join(f"{summary.statuses.get(status, 0)} {status}" for status in Status)


def comparison_outcome(summary: CompareSummary) -> str:
    """The result of every method, in one sentence."""
    first = next(iter(summary.runs.values()))
    parts = [f"{label} {_by_status(run)}" for label, run in summary.runs.items()]
    sentence = f"{_headline(first)}{len(summary.runs)} methods on {_buildings(first)}: {'; '.join(parts)}"
    broken = [label for label, run in summary.runs.items() if run.failed_tiles]
    return f"{sentence}; tiles of {', '.join(broken)} are missing" if broken else sentence


CLASS_NAMES = MappingProxyType({1: "other", 2: "ground", 5: "vegetation", 6: "building", 7: "noise", 17: "bridge"})
"""Names of the classes that a classification writes; others are kept as in the file."""


def classification_outcome(summary: ClassifySummary) -> str:
    """The result of a classification, in one sentence."""
    total = sum(summary.classes.values())
    shares = ", ".join(
        f"{100.0 * count / total:.1f} % {CLASS_NAMES.get(code, f'class {code}')}"
        for code, count in summary.classes.items()
    )
    files = f"{len(summary.files)} {'file' if len(summary.files) == 1 else 'files'}"
    return f"{files} with {total} points: {shares}"


def classification_digest(summary: ClassifySummary, scrub: Scrubber, engine_version: str) -> dict[str, Any]:
    """The stored summary of a classification."""
    return {
        "engine_version": engine_version,
        "classes": {str(code): count for code, count in summary.classes.items()},
        **_measured(summary, scrub),
    }


def comparison_digest(summary: CompareSummary, scrub: Scrubber, engine_version: str) -> dict[str, Any]:
    """The stored summary of a comparison: the summary of each run by label."""
    runs = {label: digest_of(run, scrub, engine_version) for label, run in summary.runs.items()}
    return {"engine_version": engine_version, "runs": runs}


def digest_of(summary: RunSummary, scrub: Scrubber, engine_version: str) -> dict[str, Any]:
    """The stored summary of a run: plain JSON values."""
    return {
        "digest": summary.digest,
        "engine_version": engine_version,
        "statuses": dict(summary.statuses),
        "reasons": {str(reason): count for reason, count in summary.reasons.items()},
        "rejected": dict(summary.rejected),
        "roof_types": dict(summary.roof_types),
        "counts": dict(summary.counts),
        "failed_tiles": list(summary.failed_tiles),
        "tiles_without_points": list(summary.tiles_without_points),
        "tiles_without_terrain": list(summary.tiles_without_terrain),
        "headline": as_inputs(summary.headline),
        **_measured(summary, scrub),
    }


def _measured(summary: RunSummary | ClassifySummary, scrub: Scrubber) -> dict[str, Any]:
    """Times, memory and warnings of a run."""
    return {
        "timings_s": {name: round(seconds, 3) for name, seconds in summary.timings_s.items()},
        "peak_memory_bytes": max(summary.peak_memory_bytes.values(), default=0),
        "warnings": [scrub(warning) for warning in summary.warnings[:_WARNINGS]],
        "warnings_total": len(summary.warnings),
    }
