"""An object store as a file system of Arrow, for reading, with our own retries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.fs as pafs

from pipeline.errors import InputError
from pipeline.extras.remote.remote_file import RemoteFile
from pipeline.extras.remote.retries import GONE, GaveUpError, persistently
from pipeline.extras.remote.urls import filesystem_of

Result = TypeVar("Result")


class ObjectHandler(pafs.FSSpecHandler):  # type: ignore[misc]  # pyarrow has no types
    """Answers Arrow's questions about objects.

    Parameters
    ----------
    url : str
        Any URL of the store; gives the scheme.
    """

    def __init__(self, url: str) -> None:
        self._scheme = url.partition("://")[0]
        super().__init__(filesystem_of(url))

    def get_file_info(self, paths: Sequence[str]) -> list[pafs.FileInfo]:
        """What is at some paths."""
        asked: Callable[[Sequence[str]], list[pafs.FileInfo]] = super().get_file_info
        return _tried(lambda: asked(paths))

    def get_file_info_selector(self, selector: pafs.FileSelector) -> list[pafs.FileInfo]:
        """What is below a path."""
        asked: Callable[[pafs.FileSelector], list[pafs.FileInfo]] = super().get_file_info_selector
        return _tried(lambda: asked(selector))

    def open_input_stream(self, path: str) -> Any:
        """An object, to be read from its start."""
        return self._opened(path)

    def open_input_file(self, path: str) -> Any:
        """An object, to be read anywhere."""
        return self._opened(path)

    def _opened(self, path: str) -> Any:
        file = RemoteFile(f"{self._scheme}://{path}")
        try:
            return pa.PythonFile(file.open("rb"), mode="r")
        except InputError as error:
            kind = FileNotFoundError if GONE.words in error.problem else OSError
            raise kind(f"{file}: {error.problem}. {error.fix}") from None


def _tried(work: Callable[[], Result]) -> Result:
    """What a request gives, tried again where that may help."""
    try:
        return persistently(work)
    except GaveUpError as error:
        raise OSError(f"{error.problem}. {error.cause.fix}") from None
