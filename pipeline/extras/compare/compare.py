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
from pipeline.runtime.monitoring.progress import Listener, ignore, never
from pipeline.runtime.request import RunRequest
from pipeline.runtime.run import RunSummary, begin, find_candidates, finish, publish_models, under_way
from pipeline.runtime.stages.reconstruct import reconstruct
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
    ways = {
        variant: (str(out / RUNS / variant.label), settings_of(request.run.settings, variant, request.tables))
        for variant in request.variants
    }
    # should the new runs fail, the page of an earlier comparison must not pass for theirs
    outdated = [out / name for name in _WRITTEN]
    run_request = dataclasses.replace(request.run, out=str(out))
    results = run_variants(run_request, ways, on_event, executor, cancelled, outdated)
    labels = {variant.label for variant in ways}
    for run_dir in (out / RUNS).iterdir():
        # runs of other methods, left by an earlier comparison, are not part of this one
        if run_dir.name not in labels and (run_dir / MANIFEST).exists():
            shutil.rmtree(run_dir)
    return CompareSummary(
        out=str(out),
        runs={variant.label: summary for variant, (summary, _) in results.items()},
        seconds={variant.label: seconds for variant, (_, seconds) in results.items()},
    )


def run_variants(
    request: RunRequest,
    ways: Mapping[Variant, tuple[str, RunSettings]],
    on_event: Listener = ignore,
    executor: Executor | None = None,
    cancelled: Callable[[], bool] = never,
    outdated: Sequence[Path] = (),
) -> dict[Variant, tuple[RunSummary, dict[str, float]]]:
    """Model the same candidates in several ways: all up to the join runs once, the rest once per variant, in order.

    Raises the errors of `pipeline.runtime.run.run`. Returns the summary of each variant, and the wall-clock seconds of
    each of its buildings by id.

    Parameters
    ----------
    request : RunRequest
        The inputs and how to run. Scratch goes to its `out`; its method has no effect.
    ways : mapping
        The run directory of each variant, and its settings.
    outdated : sequence of Path
        Files about an earlier comparison, removed together with its results.
    """
    outs = dict(ways.values())
    shared = dataclasses.replace(request, settings=next(iter(outs.values())))
    begun = begin(shared, outs, on_event, executor, cancelled)
    with under_way(begun, executor, cancelled) as context:
        for path in outdated:
            path.unlink(missing_ok=True)
        found = find_candidates(context, begun)
        parts = []
        for number, (variant, one) in enumerate(zip(ways, begun.directories, strict=True)):
            one.progress = context.progress.part(number, len(ways), variant.label)
            parts.append((one, dataclasses.replace(context, progress=one.progress)))
        models = [
            reconstruct(part, one.settings, found.joined, begun.guides, compared=len(ways) > 1) for one, part in parts
        ]
        results = [
            publish_models(part, begun, found, modelled, one)
            for (one, part), modelled in zip(parts, models, strict=True)
        ]
    summaries = [
        # of the time, each took that of the shared stages and its own
        finish(begun, found, result, one, sum(one.progress.timings.values()))
        for one, result in zip(begun.directories, results, strict=True)
    ]
    begun.tell_end(summaries[0])
    seconds = [result.models.counted.seconds for result in results]
    return dict(zip(ways, zip(summaries, seconds, strict=True), strict=True))


def settings_of(
    settings: RunSettings, variant: Variant, tables: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> RunSettings:
    """A run's settings with a variant's method in the place of theirs.

    `tables` are values that differ from the presets, by the method's name. Raises SettingsError for all values out of
    range at once.
    """
    entry = method_named(variant.method)
    faults: list[str] = []
    values = tables.get(variant.method, {})
    own = build(entry.settings_type, variant.method, values, faults, entry.preset(variant.preset))
    if faults:
        raise SettingsError(faults)
    return dataclasses.replace(
        settings,
        general=dataclasses.replace(settings.general, method=variant.method, preset=variant.preset),
        building=dataclasses.replace(settings.building, method=own),
    )


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
