"""What a run runs with: workers, a scheduler, certificates, isolation, scratch. Nothing here changes the models."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pipeline.errors import SettingsError
from pipeline.options import ResourceOptions, values_of
from pipeline.runtime.isolation.process_limits import IsolationLimits

if TYPE_CHECKING:
    from pipeline.runtime.cluster.priorities import Traffic
    from pipeline.runtime.cluster.tls import TlsFiles

READING_MEMORY_BYTES = 4 * 2**30
"""Memory of a process that reads an input. Not a setting: readers hold pieces, and the largest take a tenth of this."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Resources:
    """What a run runs with."""

    workers: int | None = None
    """Processes of the embedded cluster; 0 runs serially in this process, None leaves it to the estimate."""
    scheduler: str | None = None
    """Address of a Dask scheduler to use in place of the embedded cluster."""
    tls: TlsFiles | None = None
    """Certificates for the cluster's traffic; by default those of the environment."""
    traffic: Traffic = "interactive"
    """Tasks of a `batch` run wait behind those of `interactive` runs where workers are scarce."""
    isolate: bool | None = None
    """Model buildings in supervised child processes; None does so with workers and not serially."""
    building_timeout_s: float = IsolationLimits.timeout_s
    """Wall-clock seconds that one isolated building may take."""
    building_memory_bytes: int = IsolationLimits.memory_bytes
    """Memory that the process of one isolated building may take."""
    input_timeout_s: float = ResourceOptions.input_timeout_s
    """Wall-clock seconds within which some more of an input must be read."""
    scratch: str | None = None
    """A folder for intermediate results that all workers see; by default the run directory, or a temporary folder of
    this machine where that is a URL."""
    work: str | None = None
    """A folder that stores the outcomes of tasks. A run with the same folder resumes where an interrupted one stopped,
    and repeats only what changed since a finished one; None stores nothing beyond the run."""
    resume: bool = False
    """Whether scratch stays in the run directory, so that a run into the same place resumes there. The caller removes
    it once it is not needed."""
    performance_report: str | None = None
    """File for a page about the workers' time; None writes none."""

    def __post_init__(self) -> None:
        """Refuse a time limit that no input can keep."""
        if not 0.0 < self.input_timeout_s < math.inf:
            raise SettingsError([f"the time-out of an input is {self.input_timeout_s:g} s: use more than 0"])

    @property
    def is_serial(self) -> bool:
        """Whether this process runs all tasks itself."""
        return self.workers == 0 and self.scheduler is None

    @property
    def isolation(self) -> IsolationLimits | None:
        """Limits of the supervised child processes; None models buildings in the workers themselves."""
        if self.isolate is False or (self.isolate is None and self.is_serial):
            return None
        return IsolationLimits(timeout_s=self.building_timeout_s, memory_bytes=self.building_memory_bytes)

    @property
    def reading(self) -> IsolationLimits | None:
        """Limits of the child processes that read inputs; None reads them in the workers themselves."""
        if self.isolation is None:
            return None
        return IsolationLimits(timeout_s=self.input_timeout_s, memory_bytes=READING_MEMORY_BYTES)


def resources_of(given: Mapping[str, Any], **further: Any) -> Resources:
    """The resources of some options, of `ResourceOptions`; `further` fields are no options.

    Raises SettingsError if a limit is too small, or a certificate cannot be used.
    """
    values = values_of(ResourceOptions, given)
    tls = [values.pop(f"tls_{name}", None) for name in ("ca", "cert", "key")]
    if any(tls) or ("tls_ca" in given and any(name.startswith("GABLEWORK_TLS_") for name in os.environ)):
        from pipeline.runtime.cluster.tls import given_tls

        further["tls"] = given_tls(*tls)
    if "building_memory_gib" in values:
        values["building_memory_bytes"] = round(values.pop("building_memory_gib") * 2**30)
    return Resources(**values, **further)


SERIAL = Resources(workers=0)
"""This process alone."""
