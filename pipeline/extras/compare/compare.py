"""Comparison: several methods on the same candidates, one run directory per variant below one folder."""

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
from pipeline.runtime.request import RunRequest
from pipeline.runtime.run import RunSummary, RunVariant, run_variants
from pipeline.settings import RunSettings

RUNS = "runs"
"""Folder of the run directories below the comparison's."""

SUMMARY = "compare.json"
"""The file with what was compared, written last: the mark of a comparison's folder."""

BUILDINGS = "buildings.parquet"
"""One row per building and run."""

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
        """Its name in tables, folders and pages; it includes a preset that is not the default."""
        return self.method if self.preset == PRESETS[0] else f"{self.method}-{self.preset}"

    @classmethod
    def parse(cls, text: str) -> Variant:
        """A variant from ``METHOD`` or ``METHOD:PRESET``; raises SettingsError naming all methods, or all presets.

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
    """Variants from the words of a user, each with one or more variants separated by commas.

    Raises SettingsError with all faults at once; for fewer than two variants; for one given twice.

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
    """What to compare, and how."""

    run: RunRequest
    """Inputs and how to run; its `out` is the comparison's folder. The settings of its method have no effect."""
    variants: tuple[Variant, ...]
    """At least two, each once."""
    tables: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """Values that differ from a method's presets, by the method's name, for all its variants."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareSummary:
    """The outcome of a comparison."""

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
    """Model the candidates of the inputs by several methods; arguments and errors as in `pipeline.runtime.run.run`."""
    out = _checked(request.run)
    variants = [
        run_variant(request.run.settings, variant, str(out / RUNS / variant.label), request.tables)
        for variant in request.variants
    ]
    # should the new runs fail, the page of an earlier comparison must not pass for theirs
    outdated = [out / name for name in _WRITTEN]
    run_request = dataclasses.replace(request.run, out=str(out))
    outcomes = run_variants(run_request, variants, on_event, executor, cancelled, outdated)
    for run_dir in (out / RUNS).iterdir():
        # runs of other methods, left by an earlier comparison, are not part of this one
        if run_dir.name not in {variant.label for variant in variants} and (run_dir / MANIFEST).exists():
            shutil.rmtree(run_dir)
    labelled = dict(zip((variant.label for variant in variants), outcomes, strict=True))
    return CompareSummary(
        out=str(out),
        runs={label: outcome.summary for label, outcome in labelled.items()},
        seconds={label: outcome.seconds for label, outcome in labelled.items()},
    )


def run_variant(
    settings: RunSettings, variant: Variant, out: str, tables: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> RunVariant:
    """A variant of a run with some settings.

    `tables` are values that differ from the presets, by the method's name. Raises SettingsError for all values out of
    range at once.
    """
    entry = method_named(variant.method)
    faults: list[str] = []
    values = tables.get(variant.method, {})
    own = build(entry.settings_type, variant.method, values, faults, entry.preset(variant.preset))
    if faults:
        raise SettingsError(faults)
    building = dataclasses.replace(settings.building, method=own)
    return RunVariant(method=variant.method, preset=variant.preset, building=building, out=out, label=variant.label)


def settings_of(
    settings: RunSettings, variant: Variant, tables: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> RunSettings:
    """A run's settings with a variant's method in the place of theirs; as in `run_variant`."""
    return run_variant(settings, variant, "", tables).settings_in(settings)


def own_tables(table: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The methods' own tables among those of a settings file.

    Raises SettingsError if the file names a method or a preset too.

    Examples
    --------
    >>> own_tables({"classes": "trust", "roof": {"min_points": 9}, "kmeans": {"clusters": 3}})
    {'kmeans': {'clusters': 3}}
    """
    named = [name for name in ("method", "preset") if name in table]
    if named:
        fix = "name what is compared in methods, as METHOD or METHOD:PRESET"
        raise SettingsError([f"settings.{name} is {table[name]!r}: {fix}" for name in named])
    return {name: table[name] for name in METHODS if name in table}


def _checked(request: RunRequest) -> Path:
    """The comparison's folder, which may be written."""
    if "://" in request.out:
        raise RunError(f"{request.out} is no local path: this version writes local folders only")
    out = Path(request.out).resolve()
    try:
        left = sorted(entry.name for entry in out.iterdir()) if out.is_dir() else []
    except OSError as error:
        raise RunError(f"{out} cannot be read: {error.strerror or error}. Give another --out") from error
    if left and not request.overwrite:
        raise RunError(f"{out} is not empty ({left[0]} …): give another --out, or --overwrite")
    # an interrupted comparison has no summary, and only files that a comparison writes
    strange = [name for name in left if name not in (RUNS, _SCRATCH, *_WRITTEN) and not name.startswith(".")]
    if left and SUMMARY not in left and (strange or not {RUNS, _SCRATCH}.intersection(left)):
        raise RunError(f"{out} holds {(strange or left)[0]} and is no comparison: give another --out")
    return out
