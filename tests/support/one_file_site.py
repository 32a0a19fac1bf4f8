"""A web server for one file, of any temper."""

import contextlib
import http.server
import re
import threading
from collections.abc import Iterator

import numpy as np

CONTENT = np.random.default_rng(3).bytes(3_000_000)


class Site:
    """A web server for one file, and how it behaves."""

    def __init__(self) -> None:
        self.content = CONTENT
        self.ranges = True
        self.says_size = True
        self.faults: list[int] = []
        self.etag = '"1"'
        self.asked: list[tuple[str, str | None]] = []
        site = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_HEAD(self) -> None:
                self._answer(with_body=False)

            def do_GET(self) -> None:
                self._answer(with_body=True)

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
                pass

            def _answer(self, *, with_body: bool) -> None:
                wanted = self.headers.get("Range")
                site.asked.append((self.command, wanted))
                body, status = site.content, 200
                if site.faults:
                    body, status = b"", site.faults.pop(0)
                elif wanted and site.ranges:
                    found = re.fullmatch(r"bytes=(\d+)-(\d+)", wanted)
                    assert found is not None, wanted
                    first, last = (int(v) for v in found.groups())
                    body, status = body[first : last + 1], 206
                self.send_response(status)
                self.send_header("ETag", site.etag)
                if site.says_size:
                    self.send_header("Content-Length", str(len(body)))
                    self.send_header("Accept-Ranges", "bytes" if site.ranges else "none")
                else:
                    self.send_header("Connection", "close")
                    self.close_connection = True
                if status == 206:
                    self.send_header("Content-Range", f"bytes {first}-{last}/{len(site.content)}")
                self.end_headers()
                if with_body:
                    self.wfile.write(body)

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/tiles/a.laz"

    def spans(self) -> list[tuple[int, int]]:
        """First and last byte of each range that was asked for."""
        asked = [wanted.removeprefix("bytes=").split("-") for _, wanted in self.asked if wanted is not None]
        return [(int(first), int(last)) for first, last in asked]


@contextlib.contextmanager
def one_file_site() -> Iterator[Site]:
    """The server, while the block runs."""
    site = Site()
    thread = threading.Thread(target=site.server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield site
    finally:
        site.server.shutdown()
        site.server.server_close()
        thread.join()
