"""The exception tree. Errors know no HTTP and no console; the layers above map them.

```
GableworkError
├── InputError            a file or folder that cannot be used: names the file, the value and the fix
│   ├── UnreadableInputError     not the format that it claims, truncated, no permission, empty folder
│   ├── InconsistentInputError   header and data disagree, or coordinates are not finite
│   ├── EmptyInputError          no usable point left
│   └── CrsError                 geographic, contradictory or unknown coordinate reference system
├── SettingsError         one or more settings are out of range: lists all faults at once
├── RunError              a run directory, in a folder or an object store, that cannot be written, read or resumed
│   ├── RunCancelledError        the user cancelled the run
│   │   └── RunOverError             a task finds no mark of its run: it was cancelled, or its folder is gone
│   ├── NothingToShowError       a run without a building that an output could show
│   ├── FolderLostError          a folder of the run was removed while it was going, or another run took it
│   └── ClusterError             the scheduler does not answer, or was lost while the run was under way
│       └── VersionMismatchError     client, scheduler and workers do not run the same versions
├── RemoteError           a service elsewhere: no answer, a refusal, or a job of it that failed
└── BuildingError         one building could not be modelled; becomes its record's status and reason
```
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.model import Reason


_NAMED = 9
"""Inputs at fault that are named beside the first one; the others are counted."""


def causes(error: BaseException) -> Iterator[BaseException]:
    """An error, its cause, the cause of that one, and so on, each once.

    The cause is the stated one (`raise … from`), else the error that was being handled. Circles end the walk: any code,
    of libraries too, can make one by raising an error that it caught before. Read the links nowhere else.

    >>> try:
    ...     raise ValueError("outer") from KeyError("inner")
    ... except ValueError as error:
    ...     print([type(link).__name__ for link in causes(error)])
    ['ValueError', 'KeyError']
    """
    seen: set[int] = set()
    at: BaseException | None = error
    while at is not None and id(at) not in seen:
        seen.add(id(at))
        yield at
        at = at.__cause__ or at.__context__


class GableworkError(Exception):
    """Base of all errors that are raised on purpose."""


class InputError(GableworkError):
    """A file or folder that cannot be used.

    Parameters
    ----------
    path : str
        The file or folder at fault.
    problem : str
        What is wrong, with the offending value.
    fix : str
        What the user can do about it.
    """

    def __init__(self, path: str, problem: str, fix: str) -> None:
        self.path = str(path)
        self.problem = problem
        self.fix = fix
        super().__init__(f"{self.path}: {problem}. {fix}")

    def of(self, path: str, copy: str) -> InputError:
        """The same of a file by the name that the user knows, in place of that of a copy of it; always a new error.

        >>> fault = UnreadableInputError("a.laz", "no such file", "Check the path")
        >>> fault.of("a.laz", "a.laz") is fault
        False
        """
        return type(self)(path, self.problem.replace(copy, path), self.fix.replace(copy, path))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Survive pickling between Dask processes."""
        return type(self), (self.path, self.problem, self.fix)


def all_at_fault(faults: Sequence[InputError]) -> InputError:
    """One error for several inputs, of the first one's kind: who has many wants to hear of all that he has to mend.

    >>> one, other = (UnreadableInputError(path, "no such file", "Check the path") for path in ("a.laz", "b.laz"))
    >>> all_at_fault([one]) is one
    True
    >>> print(all_at_fault([one, other]))
    a.laz: no such file. Check the path. 1 more input cannot be used: b.laz: no such file
    """
    first, others = faults[0], faults[1:]
    if not others:
        return first
    named = [f"{fault.path}: {fault.problem}" for fault in others[:_NAMED]]
    if len(others) > _NAMED:
        named.append(f"and {len(others) - _NAMED} more")
    inputs = "input" if len(others) == 1 else "inputs"
    return type(first)(
        first.path,
        first.problem,
        f"{first.fix.rstrip('.')}. {len(others)} more {inputs} cannot be used: {'; '.join(named)}",
    )


class UnreadableInputError(InputError):
    """Not the format that it claims to be, truncated, or no permission to read it."""


class InconsistentInputError(InputError):
    """Header and data disagree, or coordinates are NaN or infinite."""


class EmptyInputError(InputError):
    """No usable point is left."""


class CrsError(InputError):
    """The coordinate reference system is geographic, contradictory or cannot be understood."""


class SettingsError(GableworkError):
    """One or more settings are out of range; the message lists every fault.

    Parameters
    ----------
    faults : sequence of str
        One sentence per fault, each naming the setting, its value and what is allowed.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = tuple(faults)
        super().__init__("; ".join(self.faults))

    def __reduce__(self) -> tuple[type[SettingsError], tuple[tuple[str, ...]]]:
        """Survive pickling between Dask processes."""
        return type(self), (self.faults,)


class RunError(GableworkError):
    """A run directory that cannot be written, read or resumed."""


class RunCancelledError(RunError):
    """The user cancelled the run; do not use the content of the run directory."""


class RunOverError(RunCancelledError):
    """The scratch of a task's run is gone, or belongs to another run. The driver knows whether this was its own doing.

    Tasks end without a word. A driver that cancelled nothing raises FolderLostError in its place.
    """


class NothingToShowError(RunError):
    """A run has no building that an output could show."""


class FolderLostError(RunError):
    """A folder that a run works in was removed while the run was going, or another run took it over."""


class ClusterError(RunError):
    """The scheduler does not answer, or was lost while the run was under way; the run may be tried again."""


class VersionMismatchError(ClusterError):
    """Client, scheduler and workers do not run the same versions of what matters."""


class RemoteError(GableworkError):
    """A service elsewhere does not answer or refuses a request, or a job of it has failed."""


class BuildingError(GableworkError):
    """One building could not be modelled.

    Parameters
    ----------
    reason : Reason
        The entry of the closed list that goes into the building's record.
    detail : str
        The measured figure and the threshold.
    """

    def __init__(self, reason: Reason, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason}: {detail}")

    def __reduce__(self) -> tuple[type[BuildingError], tuple[Reason, str]]:
        """Survive pickling between Dask processes."""
        return type(self), (self.reason, self.detail)
