"""Messages of the engine in the words of other ways to run it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from pipeline.options import Option


class Renaming:
    """Rewrites messages of the engine, which name options of the command line, for users of something else.

    Parameters
    ----------
    names : mapping
        The words in place of a flag, by the option.
    further : mapping
        Words in place of others, such as an option with a value.

    Examples
    --------
    >>> from pipeline.options import option_named
    >>> as_inputs = Renaming([(option_named("crs"), "the input crs")], {"--crs EPSG:n": "the input CRS"})
    >>> as_inputs("give --crs EPSG:n, or another --crs, or --crs-file")
    'give the input CRS, or another the input crs, or --crs-file'
    """

    def __init__(self, names: Iterable[tuple[Option, str]], further: Mapping[str, str]) -> None:
        self.names = {one.flag: name for one, name in names} | dict(further)
        longest_first = sorted(self.names, key=len, reverse=True)
        self._pattern = re.compile("|".join(rf"{re.escape(words)}(?![\w-])" for words in longest_first))

    def __call__(self, text: str) -> str:
        """The message in other words."""
        return self._pattern.sub(lambda found: self.names[found.group()], text)
