"""Whole runs of the command line with their processor seconds, and the candidates that such a run models."""

from __future__ import annotations

import dataclasses
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.candidates import found_scene
from benchmarks.entries import Entry
from pipeline.extras.compare.compare import Variant
from pipeline.model import Candidate
from pipeline.settings import RunSettings

ROOT = Path(__file__).resolve().parents[1]
"""This checkout."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Seconds:
    """What a whole run cost."""

    processor: float
    """User and system time of the run's process and all that it waited for."""
    clock: float
    """Wall-clock time."""


def run_survey(entry: Entry, variant: Variant, out: Path, checkout: Path = ROOT) -> Seconds:
    """Run the command line of a checkout on a survey in a process of its own, with `out` overwritten.

    RuntimeError if it fails. The processor seconds are those of all child processes that end meanwhile.
    """
    python = os.environ.get("GABLEWORK_PYTHON", sys.executable)
    command = [python, "-P", "-m", "service.cli", "reconstruct", *map(str, entry.tiles), "--out", str(out)]
    command += ["--method", variant.method, "--preset", variant.preset, "--classes", entry.classes]
    command += ["--workers", "0", "--meshes", "none", "--overwrite", "--quiet"]
    command += [] if entry.crs is None else ["--crs", entry.crs]
    command += [] if entry.footprints is None else ["--footprints", str(entry.footprints)]
    paths = [str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])]  # before any installed code
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    variables.pop("PYTHONDONTWRITEBYTECODE", None)  # a second run finds what the first compiled
    before, began = processor_s(), time.perf_counter()
    reported = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    seconds = Seconds(processor=processor_s() - before, clock=time.perf_counter() - began)
    if reported.returncode:
        raise RuntimeError(
            f"{variant.label} on {entry.name} ended with {reported.returncode}: {reported.stderr[-600:]}"
        )
    return seconds


def processor_s() -> float:
    """Processor seconds of all child processes that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def candidates_of(entry: Entry, settings: RunSettings) -> list[Candidate]:
    """The candidates of a survey as a run finds them, with the given footprints where there are any."""
    footprints = None if entry.footprints is None else str(entry.footprints)
    return list(found_scene([str(tile) for tile in entry.tiles], entry.crs, settings, footprints))
