"""Traces by OpenTelemetry: off, and nothing of it imported, unless the environment names a collector.

`OTEL_EXPORTER_OTLP_ENDPOINT` or `OTEL_EXPORTER_OTLP_TRACES_ENDPOINT` turns traces on; all other variables `OTEL_…` mean
what the standard says. One process makes all spans of a run: the driver. Tasks come back from workers with their times,
so workers need no library, no collector, and no way out.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import functools
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from pipeline.runtime.monitoring.measurement import ENDPOINTS, TRACING_LOG, traces_are_wanted

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import SpanProcessor, TracerProvider
    from opentelemetry.trace import Span

END_S = 5.0
"""Maximum seconds for sending the last spans when a process ends."""
_TRACEPARENT = re.compile(r"00-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})")
_NAME = "gablework"


class _Wanted(threading.local):
    """The ids of the next span of this thread."""

    ids: Parent | None = None


_WANTED = _Wanted()


@dataclasses.dataclass(frozen=True)
class Parent:
    """The span under which others are made, in this process or another."""

    trace_id: int
    span_id: int
    is_sampled: bool

    @classmethod
    def of(cls, traceparent: str | None) -> Parent | None:
        """From the header of that name; None without one that can be read.

        >>> Parent.of("00-0000000000000000000000000000000a-000000000000000b-01")
        Parent(trace_id=10, span_id=11, is_sampled=True)
        """
        found = None if traceparent is None else _TRACEPARENT.fullmatch(traceparent)
        if found is None or not (int(found[1], 16) and int(found[2], 16)):
            return None
        return cls(int(found[1], 16), int(found[2], 16), bool(int(found[3], 16) & 1))

    @property
    def traceparent(self) -> str:
        """As a header."""
        return f"00-{self.trace_id:032x}-{self.span_id:016x}-{int(self.is_sampled):02x}"


@functools.cache
def is_on() -> bool:
    """Whether spans are made; read from the environment once."""
    if not traces_are_wanted():
        return False
    if os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true" or os.environ.get("OTEL_TRACES_EXPORTER") == "none":
        return False
    try:
        import opentelemetry.exporter.otlp.proto.http.trace_exporter
        import opentelemetry.sdk.trace  # noqa: F401 - both are there, or none is used
    except ImportError:
        TRACING_LOG.warning(
            "%s asks for traces, which need OpenTelemetry: install gablework[otel]", " or ".join(ENDPOINTS)
        )
        return False
    return True


def span(
    name: str, *, kind: str = "internal", parent: Parent | None = None, **facts: Any
) -> contextlib.AbstractContextManager[Any]:
    """A span around a block, below `parent` or the current one; the context is the span, or None while traces are off.

    An exception marks it as failed, by the name of its class: messages may hold what a collector must not know.
    """
    return _around(name, kind, parent, facts) if is_on() else _NOTHING


_NOTHING = contextlib.nullcontext()


@contextlib.contextmanager
def _around(name: str, kind: str, parent: Parent | None, facts: Mapping[str, Any]) -> Iterator[Any]:
    from opentelemetry.trace import SpanKind, use_span

    made = (
        provider()
        .get_tracer(_NAME)
        .start_span(name, context=_context(parent), kind=SpanKind[kind.upper()], attributes=_attributes(facts))
    )
    with use_span(made, end_on_exit=True, record_exception=False, set_status_on_exception=False):
        try:
            yield made
        except BaseException as error:
            failed(made, type(error).__name__)
            raise


def begin(name: str, **facts: Any) -> Any:
    """A span below the current one that `end` ends; None while traces are off."""
    if not is_on():
        return None
    return provider().get_tracer(_NAME).start_span(name, attributes=_attributes(facts))


def finished(
    name: str, began_s: float, ended_s: float, *, below: Any = None, error: str | None = None, **facts: Any
) -> Any:
    """A span of something that is over, with its times in seconds since 1970, below `below` or the current one."""
    if not is_on():
        return None
    from opentelemetry.trace import set_span_in_context

    context = None if below is None else set_span_in_context(below)
    made = (
        provider()
        .get_tracer(_NAME)
        .start_span(name, context=context, start_time=_ns(began_s), attributes=_attributes(facts))
    )
    if error is not None:
        failed(made, error)
    made.end(_ns(ended_s))
    return made


def own_span(name: str, own: Parent, parent: Parent | None, began_s: float, *, error: str | None, **facts: Any) -> None:
    """A span that ends now and has the given ids: others were made below it before."""
    if not is_on():
        return
    _WANTED.ids = own
    try:
        made = (
            provider()
            .get_tracer(_NAME)
            .start_span(
                name, context=_context(parent, alone=True), start_time=_ns(began_s), attributes=_attributes(facts)
            )
        )
    finally:
        _WANTED.ids = None
    if error is not None:
        failed(made, error)
    made.end(_ns(time.time()))


def is_sampled(trace_id: int) -> bool:
    """Whether the sampler of the environment takes a new trace."""
    if not is_on():
        return False
    from opentelemetry.sdk.trace.sampling import Decision

    return provider().sampler.should_sample(None, trace_id, "").decision is Decision.RECORD_AND_SAMPLE


def current() -> Parent | None:
    """The current span; None without one."""
    if not is_on():
        return None
    from opentelemetry.trace import get_current_span

    found = get_current_span().get_span_context()
    return Parent(found.trace_id, found.span_id, found.trace_flags.sampled) if found.is_valid else None


def note(made: Span | None, **facts: Any) -> None:
    """Add facts to a span."""
    if made is not None:
        made.set_attributes(_attributes(facts) or {})


def failed(made: Span | None, reason: str) -> None:
    """Mark a span as failed."""
    if made is not None:
        from opentelemetry.trace import Status, StatusCode

        made.set_status(Status(StatusCode.ERROR, reason))


def end(made: Span | None) -> None:
    """End a span."""
    if made is not None:
        made.end()


@functools.cache
def provider() -> TracerProvider:
    """What makes spans, and sends them in a thread of its own; the environment chooses sampling and batches."""
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    made = provider_with(BatchSpanProcessor(OTLPSpanExporter()))
    _end_in_time(made)
    return made


def _end_in_time(made: TracerProvider) -> None:
    """Send what waits when the process ends; the library itself would wait for a dead collector, batch after batch."""
    ending = threading.Event()

    def end_it() -> None:
        ending.wait()
        made.shutdown()

    # started now: a process that ends can start none
    thread = threading.Thread(target=end_it, name="traces-end", daemon=True)
    thread.start()

    def at_end() -> None:
        ending.set()
        thread.join(END_S)

    atexit.register(at_end)


def provider_with(processor: SpanProcessor) -> TracerProvider:
    """A provider whose spans go to a processor."""
    from opentelemetry.sdk.resources import SERVICE_NAME, SERVICE_VERSION, Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.id_generator import RandomIdGenerator

    from pipeline import __version__

    class Ids(RandomIdGenerator):
        """Random ids, except those that `own_span` wants."""

        def generate_span_id(self) -> int:
            """The given id, or a random one."""
            return super().generate_span_id() if _WANTED.ids is None else _WANTED.ids.span_id

        def generate_trace_id(self) -> int:
            """The given id, or a random one."""
            return super().generate_trace_id() if _WANTED.ids is None else _WANTED.ids.trace_id

    own = {SERVICE_VERSION: __version__}
    if not os.environ.get("OTEL_SERVICE_NAME") and SERVICE_NAME not in os.environ.get("OTEL_RESOURCE_ATTRIBUTES", ""):
        own[SERVICE_NAME] = _NAME
    provider = TracerProvider(resource=Resource.create(dict(own)), id_generator=Ids(), shutdown_on_exit=False)
    provider.add_span_processor(processor)
    return provider


def _context(parent: Parent | None, *, alone: bool = False) -> Any:
    """The context below a parent; None is the current one, or with `alone` an empty one."""
    from opentelemetry.context import Context
    from opentelemetry.trace import NonRecordingSpan, SpanContext, TraceFlags, set_span_in_context

    if parent is None:
        return Context() if alone else None
    flags = TraceFlags(TraceFlags.SAMPLED if parent.is_sampled else TraceFlags.DEFAULT)
    given = SpanContext(parent.trace_id, parent.span_id, is_remote=True, trace_flags=flags)
    return set_span_in_context(NonRecordingSpan(given), Context())


def _attributes(facts: Mapping[str, Any]) -> dict[str, Any] | None:
    """Facts as attributes, with the program's name before them; those of HTTP keep the names of the standard."""
    named = {name.replace("__", ".") if "__" in name else f"{_NAME}.{name}": value for name, value in facts.items()}
    return {name: value for name, value in named.items() if value is not None}


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
