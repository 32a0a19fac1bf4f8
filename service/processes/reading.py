"""How what a client sends for a process becomes a request: all faults are told at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.io.crs import UNITS_M
from service import catalogue
from service.drafts import Draft, Inputs, shortened
from service.errors import RequestError
from service.outputs import COMPARISON_OUTPUTS, OUTPUTS, OutputKind
from service.processes.descriptions import (
    MAX_METHODS,
    MESHES,
    PRIORITY,
    compare_inputs,
    reconstruct_inputs,
)
from service.settings import ServiceSettings


def draft_reconstruct(given: Mapping[str, Any], outputs: Sequence[str] | None, settings: ServiceSettings) -> Draft:
    """A draft of a reconstruction.

    Raises
    ------
    RequestError
        Naming every fault.
    """
    known = catalogue.load()
    inputs = Inputs(given)
    inputs.unknown(tuple(reconstruct_inputs(settings)))
    chosen = inputs.settings("settings")
    words = {"method": known.methods, "preset": known.presets, "classes": known.classes, "lods": known.lods}
    _choose(inputs, chosen, words)
    inputs.faults.extend(known.preset_faults(chosen))
    return _draft(inputs, outputs, settings, OUTPUTS, {"settings": chosen})


def draft_compare(given: Mapping[str, Any], outputs: Sequence[str] | None, settings: ServiceSettings) -> Draft:
    """A draft of a comparison.

    Raises
    ------
    RequestError
        Naming every fault.
    """
    known = catalogue.load()
    inputs = Inputs(given)
    inputs.unknown(tuple(compare_inputs(settings)))
    chosen = inputs.settings("settings")
    _choose(inputs, chosen, {"classes": known.classes})
    methods = _methods(inputs, known)
    for name in ("method", "preset"):
        if name in chosen:
            inputs.faults.append(f"settings.{name} is {shortened(chosen[name])}: name what is compared in methods")
    for name in known.methods:
        if name in chosen and methods and not any(word.partition(":")[0] == name for word in methods):
            inputs.faults.append(
                f"settings has the table {name}, which is not compared: leave it out, or compare {name}"
            )
    values = {"settings": chosen, "methods": methods, "process_id": "compare"}
    return _draft(inputs, outputs, settings, COMPARISON_OUTPUTS, values)


def _choose(inputs: Inputs, chosen: dict[str, Any], words: Mapping[str, Sequence[str]]) -> None:
    """Put general settings that are inputs of their own to the others."""
    for name, known in words.items():
        word = inputs.word(name, known)
        if word is not None and chosen.get(name, word) != word:
            inputs.faults.append(f"{name} is {word} and settings.{name} is {shortened(chosen[name])}: give one of them")
        elif word is not None:
            chosen[name] = word


def _methods(inputs: Inputs, known: catalogue.Catalogue) -> tuple[str, ...]:
    """What is to be compared, without the preset where it is the default."""
    value = inputs.given.get("methods")
    if isinstance(value, Mapping) and "value" in value:
        value = value["value"]
    if value in (None, []):
        inputs.faults.append(f"methods is missing: give 2 to {MAX_METHODS} of {', '.join(known.variants())}")
        return ()
    words: list[Any] = value if isinstance(value, list) else [value]
    unknown = [word for word in words if word not in known.variants()]
    if unknown:
        told = f"use METHOD or METHOD:PRESET of {', '.join(known.variants())}"
        inputs.faults.append(f"methods holds {', '.join(map(shortened, unknown))}: {told}")
        return ()
    found = tuple(word.removesuffix(f":{known.default('preset')}") for word in words)
    twice = sorted({word for word in found if found.count(word) > 1})
    if twice:
        inputs.faults.append(f"methods holds {', '.join(twice)} twice: give each once")
    elif not 2 <= len(found) <= MAX_METHODS:
        inputs.faults.append(f"methods holds {len(found)}: give 2 to {MAX_METHODS}")
    return found


def _draft(
    inputs: Inputs,
    outputs: Sequence[str] | None,
    settings: ServiceSettings,
    kinds: Mapping[str, OutputKind],
    values: Mapping[str, Any],
) -> Draft:
    """The draft of what all processes have in common and of what was read already.

    Raises
    ------
    RequestError
        Naming every fault.
    """
    tiles = inputs.files("tiles", settings.max_inputs, inputs.tile)
    if inputs.given.get("tiles") in (None, []):
        inputs.faults.append("tiles is missing: give one point cloud or more")
    outlines = inputs.files("footprints", 1, inputs.outlines)
    crs = inputs.crs("crs")
    wanted = None
    if outputs is not None:
        unknown = [name for name in outputs if name not in kinds]
        inputs.faults.extend(f"{shortened(name)} is no output: use {', '.join(kinds)}" for name in unknown)
        wanted = tuple(name for name in kinds if name in outputs)
    common = {
        "crs": crs,
        "vertical_unit": inputs.word("verticalUnit", tuple(UNITS_M)),
        "bbox": inputs.bbox("bbox", crs),
        "meshes": inputs.word("meshes", MESHES) or MESHES[0],
        "licence": inputs.text("licence"),
        "outputs": wanted,
        "title": inputs.text("title"),
    }
    priority = inputs.integer("priority", -PRIORITY, PRIORITY)
    if inputs.faults:
        raise RequestError(inputs.faults)
    footprints = outlines[0] if outlines else None
    return Draft(tiles=tiles, footprints=footprints, priority=priority, values={**common, **values})
