"""A collector of traces on a free port, which speaks OTLP over HTTP; and the tree of what it got."""

from __future__ import annotations

import contextlib
import gzip
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import (
    ExportTraceServiceRequest,
    ExportTraceServiceResponse,
)


@dataclass(frozen=True)
class Span:
    """A span as it came."""

    name: str
    trace: str
    id: str
    parent: str
    """Id of the span above; empty for the first of a trace."""
    began_ns: int
    ended_ns: int
    failed: bool
    facts: dict[str, Any]
    """Attributes, of the process that made it, too."""


@dataclass
class Collector:
    """The spans that came."""

    url: str = ""
    spans: list[Span] = field(default_factory=list)

    def named(self, name: str, **facts: Any) -> list[Span]:
        """Spans by name and attributes; a name without dots is one of ours."""
        wanted = {f"gablework.{key}": value for key, value in facts.items()}
        return [one for one in self.spans if one.name == name and wanted.items() <= one.facts.items()]

    def above(self, span: Span) -> list[str]:
        """The names of the spans above one, the nearest first."""
        by_id = {(one.trace, one.id): one for one in self.spans}
        names = []
        while (parent := by_id.get((span.trace, span.parent))) is not None:
            names.append(parent.name)
            span = parent
        return names


def _value(value: Any) -> Any:
    return getattr(value, value.WhichOneof("value"))


@contextlib.contextmanager
def collecting() -> Iterator[Collector]:
    """A collector that listens."""
    collector = Collector()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            if self.headers.get("content-encoding") == "gzip":
                body = gzip.decompress(body)
            for group in ExportTraceServiceRequest.FromString(body).resource_spans:
                process = {one.key: _value(one.value) for one in group.resource.attributes}
                for scope in group.scope_spans:
                    for span in scope.spans:
                        own = {one.key: _value(one.value) for one in span.attributes}
                        times = (span.start_time_unix_nano, span.end_time_unix_nano)
                        ids = (span.trace_id.hex(), span.span_id.hex(), span.parent_span_id.hex())
                        found = Span(span.name, *ids, *times, span.status.code == 2, process | own)
                        collector.spans.append(found)
            answer = ExportTraceServiceResponse().SerializeToString()
            self.send_response(200)
            self.send_header("content-type", "application/x-protobuf")
            self.send_header("content-length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        def log_message(self, *_arguments: object) -> None:
            """Print nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        collector.url = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield collector
        finally:
            server.shutdown()
            thread.join()
