"""One service as a client sees it: its URL, the key, and requests that are sent again while that can help."""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import math
import os
import time
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode, urlsplit

from pipeline import __version__
from pipeline.backoff import wanted_pause_s
from pipeline.errors import SettingsError
from service.client.client_answers import Problem
from service.client.client_errors import (
    BusyError,
    ForbiddenError,
    ForeignAnswerError,
    NotFoundError,
    RefusedError,
    UnauthorizedError,
    UnreachableError,
)
from service.client.client_retries import FIRST_CONTACT_S, Attempts, is_passing
from service.client.transport import READ_S, Answer, FileBytes, LostError, OpenAnswer, Request, Transport

DEFAULT_URL = "http://127.0.0.1:8000"
"""Where `gablework serve` listens."""
URL, KEY, KEY_FILE = "GABLEWORK_URL", "GABLEWORK_KEY", "GABLEWORK_KEY_FILE"
"""Environment variables of the service's URL, of the key, and of a file that holds the key."""
LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})

_KEY_HINT = f"Give the key by {KEY}, or by {KEY_FILE} or --key-file with a file that holds it"

Notify = Callable[[str], None]
"""Takes a sentence about something that a person may want to know, such as a wait."""


def service_url(given: str | None) -> str:
    """The URL of a service, without a slash at its end: the given one, that of the environment, or the default.

    Raises
    ------
    SettingsError
        It is not a URL by http or https.

    >>> service_url("https://models.example.org/gable/")
    'https://models.example.org/gable'
    """
    url = (given or os.environ.get(URL) or DEFAULT_URL).strip()
    fault = None
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError as error:
        raise SettingsError([f"the service's URL is {url!r}: {error}"]) from None
    if parts.scheme not in {"http", "https"} or not parts.hostname:
        fault = f"write it in full, such as {DEFAULT_URL} or https://models.example.org"
    elif parts.username is not None or parts.password is not None:
        raise SettingsError([f"the service's URL holds a name or a password: leave them out. {_KEY_HINT}"])
    elif parts.query or parts.fragment:
        fault = "end it with the path of the service"
    if fault is not None:
        raise SettingsError([f"the service's URL is {url!r}: {fault}"])
    return url.rstrip("/")


def service_key(given: str | None, file: str | Path | None) -> str | None:
    """The key: the given one, that in the file, or that of the environment; None without any.

    Raises
    ------
    SettingsError
        It cannot be read, or is not a key. The message does not repeat it.
    """
    text, place = given, "the key"
    if text is None and file is None:
        text, place = os.environ.get(KEY), KEY
        file = os.environ.get(KEY_FILE) if text is None else None
    if text is None and file is not None:
        try:
            text, place = Path(file).read_text(encoding="utf-8"), f"the key file {file}"
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError([f"the key file {file} cannot be read: {error}"]) from None
    if text is None:
        return None
    key = text.strip()
    if not key or not key.isascii() or not key.isprintable() or " " in key:
        raise SettingsError([f"{place} holds no key: write one line, gw_… as `gablework keys create` shows it"])
    return key


def path_of(*parts: str, **query: object) -> str:
    """A path below the service's URL; parameters that are None or empty are left out.

    >>> path_of("jobs", "a/b", limit=5, status=None, processID=("reconstruct", "classify"))
    '/jobs/a%2Fb?limit=5&processID=reconstruct%2Cclassify'
    """
    given = {
        name: ",".join(map(str, value)) if isinstance(value, list | tuple) else value
        for name, value in query.items()
        if value is not None and value not in ((), [])
    }
    return "/" + "/".join(quote(part, safe="") for part in parts) + (f"?{urlencode(given)}" if given else "")


class Session:
    """Requests to one service.

    Parameters
    ----------
    transport : Transport
        Sends them.
    url : str
        The service's URL, without a slash at its end.
    key : str or None
        Sent with every request.
    patience_s : float
        Seconds that a call goes on while the service does not answer, or is busy.
    notify : callable
        Takes sentences about waits.
    """

    def __init__(self, transport: Transport, *, url: str, key: str | None, patience_s: float, notify: Notify) -> None:
        self.transport = transport
        self.url = url
        self.key = key
        self.patience_s = patience_s
        self.notify = notify
        self._has_answered = False
        parts = urlsplit(url)
        if key is not None and parts.scheme == "http" and parts.hostname not in LOOPBACK:
            notify(f"the key travels to {parts.netloc} without encryption: use https if the service has it")

    def attempts(self) -> Attempts:
        """The attempts of one call."""
        return Attempts(self.patience_s)

    # --- requests

    async def ask(
        self,
        method: str,
        path: str,
        *,
        document: Any = None,
        headers: Mapping[str, str] | None = None,
        is_repeatable: bool = True,
    ) -> Answer:
        """Send a request, again while that can help; the answer, which is a success.

        Parameters
        ----------
        method, path : str
            The path is below the service's URL.
        document : JSON value, optional
            The body.
        headers : mapping, optional
            More headers.
        is_repeatable : bool
            Whether the request may be sent again although its first answer was lost.

        Raises
        ------
        UnreachableError, ForeignAnswerError, RefusedError
            By the cause.
        """
        attempts = self.attempts()
        # equal documents are equal bytes, whatever the order of their members: an Idempotency-Key needs that
        body = b"" if document is None else json.dumps(document, sort_keys=True, allow_nan=False).encode()
        more = dict(headers or {}) | ({} if document is None else {"Content-Type": "application/json"})
        while True:
            try:
                async with self.open(method, path, headers=more, body=body) as opened:
                    answer = await opened.whole()
            except LostError as lost:
                await self.after_loss(lost, attempts, is_repeatable=is_repeatable)
                continue
            if answer.status < 300:
                return answer
            if is_repeatable or answer.status == 429:
                await self.after_refusal(answer, attempts)
            else:
                raise self.refusal(answer)

    async def json(self, method: str, path: str, **options: Any) -> Any:
        """Send a request; the document that is answered. Options and errors as those of `ask`."""
        return self.document(await self.ask(method, path, **options))

    def document(self, answer: Answer) -> Any:
        """The document of an answer; raises ForeignAnswerError if it has none."""
        if "json" not in answer.headers.get("content-type", ""):
            raise self._foreign(answer)
        try:
            return json.loads(answer.body)
        except ValueError as error:
            raise self._foreign(answer) from error

    @contextlib.asynccontextmanager
    async def open(
        self,
        method: str,
        path: str,
        *,
        headers: Mapping[str, str] | None = None,
        body: bytes | FileBytes = b"",
        read_s: float = READ_S,
    ) -> AsyncIterator[OpenAnswer]:
        """Send a request once; raises LostError."""
        sent = {"User-Agent": f"gablework/{__version__}", "Accept": "*/*", "Accept-Encoding": "identity"}
        sent |= {} if self.key is None else {"Authorization": f"Bearer {self.key}"}
        request = Request(
            method=method, url=f"{self.url}{path}", headers={**sent, **(headers or {})}, body=body, read_s=read_s
        )
        async with self.transport.open(request) as answer:
            self._has_answered = True
            yield answer

    # --- after a failure

    async def after_loss(self, lost: LostError, attempts: Attempts, *, is_repeatable: bool = True) -> None:
        """Wait for another attempt after an answer was lost.

        Raises
        ------
        UnreachableError
            There is none.
        """
        if lost.is_final or not is_repeatable:
            raise UnreachableError(f"{self.url} cannot be used: {lost}") from lost
        limit_s = math.inf if self._has_answered else FIRST_CONTACT_S
        pause_s = attempts.pause_s(time.monotonic(), limit_s=limit_s)
        if pause_s is None:
            fix = "Try again later" if self._has_answered else "Check the URL and the network"
            raise UnreachableError(f"{self.url} does not answer: {lost}. {fix}") from lost
        self.notify(f"{self.url} does not answer ({lost}); trying again in {pause_s:.1f} s")
        await self.transport.sleep(pause_s)

    async def after_refusal(self, answer: Answer, attempts: Attempts, *, can_pass: bool = False) -> None:
        """Wait for another attempt after the service has refused one. With `can_pass` it may help in any case.

        Raises
        ------
        RefusedError, ForeignAnswerError
            Another one cannot help, or `patience_s` has passed.
        """
        retry_after = answer.headers.get("retry-after")
        if not can_pass and not is_passing(answer.status, retry_after):
            raise self.refusal(answer)
        wanted_s = wanted_pause_s(retry_after, dt.datetime.now(dt.UTC))
        pause_s = attempts.pause_s(time.monotonic(), wanted_s=wanted_s)
        if pause_s is None:
            after = f"It asks to wait {wanted_s:.0f} s" if wanted_s else f"It stayed so for {attempts.limit_s:.0f} s"
            raise self.refusal(answer, f"{after}; the patience is {attempts.limit_s:.0f} s")
        refused = self.refusal(answer)
        self.notify(f"{refused} (status {answer.status}); trying again in {pause_s:.1f} s")
        await self.transport.sleep(pause_s)

    def refusal(self, answer: Answer, hint: str = "") -> Exception:
        """The error for an answer that is not a success. One to HEAD has no document."""
        status, location = answer.status, answer.headers.get("location")
        if 300 <= status < 400 and location is not None:
            return ForeignAnswerError(f"{self.url} redirects to {location}: use the URL of the service itself")
        if "problem+json" in answer.headers.get("content-type", ""):
            try:
                found = json.loads(answer.body or b"{}")
            except ValueError:
                return self._foreign(answer)
            problem = Problem.of(found if isinstance(found, Mapping) else {}, status)
        elif status in {401, 403, 407, 429, 503}:
            problem = Problem(status=status, detail=f"{self.url} answers {status}")
        else:
            return self._foreign(answer)
        if not problem.detail and not problem.title:
            problem = Problem(status=status, detail=f"{self.url} answers {status}")
        if is_passing(status, answer.headers.get("retry-after")):
            return BusyError(problem, hint)
        if status == 401:
            return UnauthorizedError(problem, _KEY_HINT)
        kinds: Mapping[int, type[RefusedError]] = {403: ForbiddenError, 404: NotFoundError}
        return kinds.get(status, RefusedError)(problem, hint)

    def _foreign(self, answer: Answer) -> ForeignAnswerError:
        kind = answer.headers.get("content-type", "").partition(";")[0] or "without a media type"
        return ForeignAnswerError(
            f"{self.url} answers {answer.status} ({kind}), which is not an answer of gablework: check the URL, and the "
            "proxy before the service if there is one"
        )
