"""Several methods on the same candidates: one run directory a variant below one folder."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pipeline.errors import RunError, SettingsError
from pipeline.methods import METHODS, PRESETS, method_named
from pipeline.parameters import build
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.manifest import NAME as MANIFEST
from pipeline.runtime.monitoring.events import Listener, ignore, never
from pipeline.runtime.run import RunRequest, RunSummary, RunVariant, run_variants
from pipeline.settings import RunSettings

RUNS = "runs"
"""Folder of the run directories below the comparison's."""

SUMMARY = "compare.json"
"""The file that tells what was compared, written last; the mark of a comparison's folder."""

BUILDINGS = "buildings.parquet"
"""One row a building and run."""

REPORT = "compare.md"
"""The figures as Markdown."""

PAGE = "index.html"
"""The figures, pictures side by side, and a table of the buildings."""

_WRITTEN = (SUMMARY, BUILDINGS, REPORT, PAGE)
_SCRATCH = "scratch"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variant:
    """A method with a preset of its settings."""

    method: str
    """Its name."""
    preset: str = PRESETS[0]
    """Where its settings start."""

    @property
    def label(self) -> str:
        """What tables, folders and pages call it: the preset is told where it is not the default."""
        return self.method if self.preset == PRESETS[0] else f"{self.method}-{self.preset}"

    @classmethod
    def parse(cls, text: str) -> Variant:
        """A variant from ``METHOD`` or ``METHOD:PRESET``.

        Raises
        ------
        SettingsError
            Naming all methods, or all presets.

        Examples
        --------
        >>> Variant.parse("fuzzy-sart:faithful").label, Variant.parse("fuzzy-sart").label
        ('fuzzy-sart-faithful', 'fuzzy-sart')
        """
        method, _, preset = text.strip().partition(":")
        variant = cls(method=method, preset=preset or PRESETS[0])
        method_named(variant.method).preset(variant.preset)
        return variant


def parse_variants(texts: Sequence[str]) -> tuple[Variant, ...]:
    """Variants from what a user gives, several by commas too.

    Raises
    ------
    SettingsError
        All faults at once; fewer than two variants; one given twice.

    Examples
    --------
    >>> [variant.label for variant in parse_variants(["fuzzy-sart,fuzzy-sart:faithful"])]
    ['fuzzy-sart', 'fuzzy-sart-faithful']
    """
    variants: list[Variant] = []
    faults: list[str] = []
    for text in (word for given in texts for word in given.split(",")):
        try:
            variant = Variant.parse(text)
        except SettingsError as error:
            faults.extend(error.faults)
            continue
        if variant in variants:
            faults.append(f"methods holds {variant.label} twice: give each once")
        variants.append(variant)
    if not faults and len(variants) < 2:
        faults.append(f"methods holds {len(variants)} variant: give two or more, such as METHOD,METHOD:PRESET")
    if faults:
        raise SettingsError(faults)
    return tuple(variants)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareRequest:
    """What is to be compared."""

    run: RunRequest
    """Inputs and how to run; its `out` is the comparison's folder. Of its settings all counts but what is the method's
    own."""
    variants: tuple[Variant, ...]
    """At least two, each once."""
    tables: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """What differs from a method's presets, by the method's name: counts for all its variants."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareSummary:
    """What a comparison found."""

    out: str
    """Its folder."""
    runs: dict[str, RunSummary]
    """By the variants' labels, in their order."""
    seconds: dict[str, dict[str, float]]
    """Wall-clock seconds of each building by label and building_id."""


def compare(
    request: CompareRequest,
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
) -> CompareSummary:
    """Model the candidates of the inputs by several methods.

    Parameters
    ----------
    request : CompareRequest
        What is to be compared.
    on_event, executor, cancelled
        As of `pipeline.runtime.run.run`.

    Returns
    -------
    CompareSummary
        A summary a variant.

    Raises
    ------
    RunError
        The folder cannot be used.
    InputError, SettingsError, RunCancelledError, ClusterError
        As `pipeline.runtime.run.run`.
    """
    out = _checked(request.run)
    variants = [
        RunVariant(
            settings=settings_of(request.run.settings, variant, request.tables),
            out=str(out / RUNS / variant.label),
            label=variant.label,
        )
        for variant in request.variants
    ]
    # a page of an earlier comparison would be taken for that of the new runs, should these never come to theirs
    stale = [out / name for name in _WRITTEN]
    outcomes = run_variants(request.run, variants, str(out), on_event, executor, cancelled, stale=stale)
    for run_dir in (out / RUNS).iterdir():
        # what an earlier comparison left of other methods would be taken for a part of this one
        if run_dir.name not in {variant.label for variant in variants} and (run_dir / MANIFEST).exists():
            shutil.rmtree(run_dir)
    labelled = dict(zip((variant.label for variant in variants), outcomes, strict=True))
    return CompareSummary(
        out=str(out),
        runs={label: outcome.summary for label, outcome in labelled.items()},
        seconds={label: outcome.seconds for label, outcome in labelled.items()},
    )


def settings_of(
    settings: RunSettings, variant: Variant, tables: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> RunSettings:
    """A run's settings with a variant's method in the place of theirs.

    Parameters
    ----------
    settings : RunSettings
        All but the method's own count.
    variant : Variant
        The method and its preset.
    tables : mapping
        What differs from the presets, by the method's name.

    Raises
    ------
    SettingsError
        Values out of range, all at once.
    """
    entry = method_named(variant.method)
    faults: list[str] = []
    values = tables.get(variant.method, {})
    own = build(entry.settings_type, variant.method, values, faults, entry.preset(variant.preset))
    if faults:
        raise SettingsError(faults)
    general = dataclasses.replace(settings.general, method=variant.method, preset=variant.preset)
    return RunSettings(
        general=general, scene=settings.scene, building=dataclasses.replace(settings.building, method=own)
    )


def own_tables(table: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The methods' own tables among those of a settings file.

    Raises
    ------
    SettingsError
        The file names a method or a preset too.

    Examples
    --------
    >>> own_tables({"classes": "trust", "roof": {"min_points": 9}, "kmeans": {"clusters": 3}})
    {'kmeans': {'clusters': 3}}
    """
    named = [name for name in ("method", "preset") if name in table]
    if named:
        told = "name what is compared in methods, as METHOD or METHOD:PRESET"
        raise SettingsError([f"settings.{name} is {table[name]!r}: {told}" for name in named])
    return {name: table[name] for name in METHODS if name in table}


def _checked(request: RunRequest) -> Path:
    """The comparison's folder, which may be written.

    Raises
    ------
    RunError
        It holds something that is no comparison, or one that is not to be replaced.
    """
    if "://" in request.out:
        raise RunError(f"{request.out} is no local path: this version writes local folders only")
    out = Path(request.out).resolve()
    try:
        left = sorted(entry.name for entry in out.iterdir()) if out.is_dir() else []
    except OSError as error:
        raise RunError(f"{out} cannot be read: {error.strerror or error}. Give another --out") from error
    if left and not request.overwrite:
        raise RunError(f"{out} is not empty ({left[0]} …): give another --out, or --overwrite")
    # one that was broken off has no summary, and nothing but what a comparison writes
    strange = [name for name in left if name not in (RUNS, _SCRATCH, *_WRITTEN) and not name.startswith(".")]
    if left and SUMMARY not in left and (strange or RUNS not in left):
        raise RunError(f"{out} holds {(strange or left)[0]} and is no comparison: give another --out")
    return out
