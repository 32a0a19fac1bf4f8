"""The options that several commands share; those of runs are made from `pipeline.options`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal, TypeVar

import typer

from pipeline.options import AUTO, Option, all_options, served

Command = TypeVar("Command", bound=Callable[..., None])

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document; events as JSON lines on stderr.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress; warnings and errors only.")]
SettingsFile = Annotated[str | None, typer.Option(metavar="FILE", help="Settings as TOML; docs/reference/settings.md.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")]
_MAX_WORKERS = 1024


def count_or_auto(text: str, *, least: int) -> str:
    """The word of an option for workers: `auto`, or a number without leading zeros; raises BadParameter for others.

    Examples
    --------
    >>> count_or_auto("02", least=1), count_or_auto("auto", least=1)
    ('2', 'auto')
    """
    if text == AUTO:
        return AUTO
    if text.isdecimal() and least <= int(text) <= _MAX_WORKERS:
        return str(int(text))
    raise typer.BadParameter(f"{text!r}: use {AUTO}, or a whole number from {least} to {_MAX_WORKERS}")


def worker_count(text: str) -> int | None:
    """The number of workers in an option; 0 for none, None for `auto`. Raises BadParameter as `count_or_auto`."""
    word = count_or_auto(text, least=0)
    return None if word == AUTO else int(word)


def takes_options(command: str, **defaults: Any) -> Callable[[Command], Command]:
    """Give a function the options of a run that a command takes, after its own; their values come as `**given`.

    Parameters
    ----------
    command : str
        Its name; `submit` takes what the service offers.
    **defaults
        Defaults of this command that differ.
    """
    by_name = [one for one in all_options() if command in one.meta["takers"]]
    taken = served(files=True) if command == "submit" else by_name

    def decorated(function: Command) -> Command:
        own = [one for one in _parameters(function) if one.kind is not inspect.Parameter.VAR_KEYWORD]
        set_parameters(function, [*own, *(_parameter(one, defaults.get(one.name, one.default)) for one in taken)])
        return function

    return decorated


def set_parameters(function: Callable[..., None], parameters: Iterable[inspect.Parameter]) -> None:
    """Make typer read these as the parameters of a function, which takes them as keywords."""
    keywords = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
    function.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    function.__annotations__ = {one.name: one.annotation for one in keywords}


def _parameters(function: Callable[..., None]) -> list[inspect.Parameter]:
    return list(inspect.signature(function, eval_str=True).parameters.values())


def _parameter(option: Option, default: Any) -> inspect.Parameter:
    """An option as typer reads it."""
    meta, flag = option.meta, option.flag
    kind, text = option.type, meta["doc"]
    further: dict[str, Any] = {}
    if meta["choices"] and not meta["metavar"]:
        kind = Literal[meta["choices"]]
    elif meta["choices"] and option.name == "method":
        text = f"{text.removesuffix('.')}: {', '.join(meta['choices'])}."
    if option.is_setting:
        text = f"{text.removesuffix('.')}; default from the settings."
    if option.name == "workers":
        further = {"parser": worker_count, "show_default": AUTO}
    if kind is bool:
        flag = flag if option.default is False else f"{flag}/{flag.replace('--', '--no-', 1)}"
    described = typer.Option(flag, metavar=meta["metavar"] or None, help=text, **further)
    annotation: Any = Annotated[kind if default is not None else kind | None, described]
    return inspect.Parameter(option.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
