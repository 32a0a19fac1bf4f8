"""Faults of a storage or server that are worth another attempt, and the wait before it: tables and pure functions.

Waits double from attempt to attempt up to a bound. Each is drawn between half of it and all of it, so workers that
failed together do not return together. Only `persistently` looks at a clock and sleeps.
"""

from __future__ import annotations

import dataclasses
import errno
import random
import re
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

from pipeline.backoff import Backoff
from pipeline.errors import GableworkError, causes

Result = TypeVar("Result")

_LONGEST_DETAIL = 300


POLICY = Backoff(first_s=0.5, longest_s=20.0, jitter=(0.5, 1.0), attempts=6, limit_s=300.0)
"""The default policy. Its pauses add up to 15 s, longer than a storage server takes to fail over. The limit is for
attempts that time out: each takes a minute."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cause:
    """Why a request failed."""

    words: str
    """The cause in words."""
    again: bool
    """Whether another attempt may succeed."""
    fix: str
    """The user's way out."""


_LATER = "Try again later"
_RIGHTS = "Check the credentials, and what they are allowed to do"
_NAME = "Check the name"
_NETWORK = "Check the network and the name of the server"

GONE = Cause(words="there is no such thing", again=False, fix=_NAME)
"""Nothing is there; the caller may accept that."""
_BUSY = Cause(words="the server is busy", again=True, fix=_LATER)
_BROKEN = Cause(words="the server is in trouble", again=True, fix=_LATER)
_FORBIDDEN = Cause(words="access is denied", again=False, fix=_RIGHTS)
_LATE = Cause(words="no answer in time", again=True, fix=_NETWORK)
_CUT = Cause(words="the connection broke", again=True, fix=_NETWORK)
_CHANGED = Cause(words="it changed while it was read", again=False, fix="Try again when it is no longer being written")

CODES: Mapping[str, Cause] = MappingProxyType(
    {
        "NoSuchBucket": Cause(words="there is no such bucket", again=False, fix="Make the bucket, or check its name"),
        "NoSuchKey": GONE,
        "AccessDenied": _FORBIDDEN,
        "InvalidAccessKeyId": _FORBIDDEN,
        "SignatureDoesNotMatch": _FORBIDDEN,
        "ExpiredToken": Cause(words="the credentials have expired", again=False, fix="Get new credentials"),
        "RequestTimeTooSkewed": Cause(words="the clocks differ", again=False, fix="Set this machine's clock"),
        "PermanentRedirect": Cause(
            words="the bucket is in another region", again=False, fix="Set AWS_REGION to the bucket's region"
        ),
        "PreconditionFailed": _CHANGED,
        "RequestTimeout": _LATE,
        "SlowDown": _BUSY,
        "Throttling": _BUSY,
        "ThrottlingException": _BUSY,
        "TooManyRequests": _BUSY,
        "RequestLimitExceeded": _BUSY,
        "BandwidthLimitExceeded": _BUSY,
        "ServiceUnavailable": _BUSY,
        "InternalError": _BROKEN,
        "OperationAborted": Cause(words="another request got in the way", again=True, fix=_LATER),
        # what was sent is not what arrived
        "BadDigest": _CUT,
        "IncompleteBody": _CUT,
        "XAmzContentSHA256Mismatch": _CUT,
    }
)
"""By the code of the S3 protocol."""
STATUSES: Mapping[int, Cause] = MappingProxyType(
    {
        401: Cause(words="the server asks for credentials", again=False, fix=_RIGHTS),
        403: _FORBIDDEN,
        404: GONE,
        408: _LATE,
        410: GONE,
        412: _CHANGED,
        425: _BUSY,
        429: _BUSY,
        500: _BROKEN,
        502: _BROKEN,
        503: _BUSY,
        504: _LATE,
    }
)
"""By the status of an answer; others of 500 and above are worth another attempt, too, those below are not."""
_CREDENTIALS = Cause(
    words="there are no credentials",
    again=False,
    fix="Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE, or AWS_NO_SIGN_REQUEST=YES for open data",
)
_CERTIFICATE = Cause(
    words="the server's certificate is not trusted",
    again=False,
    fix="Name the authority's certificate in AWS_CA_BUNDLE (s3://) or SSL_CERT_FILE (https://)",
)
KINDS: Mapping[str, Cause] = MappingProxyType(
    {
        # certificates before connections, which their errors are, too
        "ClientConnectorCertificateError": _CERTIFICATE,
        "ClientSSLError": _CERTIFICATE,
        "SSLCertVerificationError": _CERTIFICATE,
        "SSLError": _CERTIFICATE,
        "NoCredentialsError": _CREDENTIALS,
        "PartialCredentialsError": _CREDENTIALS,
        "ProfileNotFound": Cause(words="there is no such profile", again=False, fix="Check AWS_PROFILE"),
        "InvalidURL": Cause(words="this is not a URL", again=False, fix="Check the URL"),
        "TooManyRedirects": Cause(words="the server redirects in circles", again=False, fix="Check the URL"),
        "TimeoutError": _LATE,
        "ConnectTimeoutError": _LATE,
        "ReadTimeoutError": _LATE,
        "ServerTimeoutError": _LATE,
        "ConnectionError": _CUT,
        "ClientConnectionError": _CUT,
        "ClientPayloadError": _CUT,
        "ConnectionClosedError": _CUT,
        "EndpointConnectionError": _CUT,
        "HTTPClientError": _CUT,
        "IncompleteReadError": _CUT,
        "ResponseStreamingError": _CUT,
        "ShortReadError": _CUT,
        "gaierror": _CUT,
        "PermissionError": _FORBIDDEN,
        "FileNotFoundError": GONE,
    }
)
"""By the name of an exception's class or of one that it derives from: the libraries that raise them load only where
they are used. In the order in which they are looked for."""
UNKNOWN = Cause(words="it failed", again=False, fix="See what the error says")
"""What is not in the tables: another attempt would hide a fault of the program."""
LOCAL_FAULTS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EMFILE, errno.ENFILE})
"""Errors of this machine's own disk, which have nothing to do with the storage that is talked to."""


class ShortReadError(OSError):
    """Fewer bytes came than were promised."""


class GaveUpError(Exception):
    """No attempt succeeded; the caller adds the context.

    Parameters
    ----------
    cause : Cause
        Of the last attempt.
    detail : str
        What it said, without secrets.
    attempts : int
        How often it was tried.
    """

    def __init__(self, cause: Cause, detail: str, attempts: int) -> None:
        self.cause = cause
        self.detail = detail
        self.attempts = attempts
        super().__init__(self.problem)

    @property
    def problem(self) -> str:
        """The cause, the detail, and the number of attempts, in one line."""
        tries = f" at all of {self.attempts} attempts" if self.attempts > 1 else ""
        return f"{self.cause.words}{tries} ({self.detail})"


def _answer(error: BaseException) -> tuple[str, int]:
    """Code and status of the answer in an error; empty and 0 without one."""
    response: Any = getattr(error, "response", None)
    if isinstance(response, Mapping):
        code = str(response.get("Error", {}).get("Code", ""))
        return code, int(response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
    status = getattr(error, "status", 0)
    return "", status if isinstance(status, int) else 0


def cause_of(error: BaseException) -> Cause:
    """Why a request failed, by the tables: the server's answer counts before the library's error.

    >>> cause_of(TimeoutError()).again, cause_of(PermissionError()).again, cause_of(ValueError("x")).words
    (True, False, 'it failed')
    """
    chain = list(causes(error))
    answers = [_answer(link) for link in chain]
    for code, _ in answers:
        if code in CODES:
            return CODES[code]
    for _, status in answers:
        if status in STATUSES:
            return STATUSES[status]
        if status >= 400:
            return dataclasses.replace(UNKNOWN, words=f"the server answers {status}", again=status >= 500)
    names = {kind.__name__ for link in chain for kind in type(link).__mro__}
    return next((cause for name, cause in KINDS.items() if name in names), UNKNOWN)


def is_local(error: BaseException) -> bool:
    """Whether an error is one of this machine's own disk."""
    return isinstance(error, OSError) and error.errno in LOCAL_FAULTS


def without_secrets(text: str) -> str:
    """A text with user, password and query removed from its URLs, as they may hold signatures and tokens.

    >>> without_secrets("GET https://me:pw@host/a.laz?X-Amz-Signature=1f, then 403")
    'GET https://host/a.laz?…, then 403'
    """
    return re.sub(
        r"(\w+://)(?:[^\s/@'\"]*@)?([^\s?'\"<>]*)(\?[^\s'\"<>,]*)?",
        lambda found: found[1] + found[2] + ("?…" if found[3] else ""),
        text,
    )


def detail_of(error: BaseException) -> str:
    """An error's text in one line, without secrets, with the status of the answer if it has one."""
    deepest = next((link for link in causes(error) if _answer(link) != ("", 0)), error)
    status = _answer(deepest)[1]
    text = " ".join(without_secrets(str(deepest)).split()) or type(deepest).__name__
    detail = text if not status or str(status) in text else f"status {status}: {text}"
    return detail if len(detail) <= _LONGEST_DETAIL else f"{detail[:_LONGEST_DETAIL]}…"


def persistently(
    work: Callable[[], Result],
    policy: Backoff = POLICY,
    *,
    check: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    draw: Callable[[], float] = random.random,
) -> Result:
    """The result of repeatable work, tried again if that may help.

    Parameters
    ----------
    work : callable
        Idempotent: an attempt that timed out may have arrived.
    check : callable
        Called before each attempt; what it raises ends the work.
    clock, sleep, draw : callable
        Seconds, a pause of seconds, a random number from 0 to 1; replaced in tests.

    Raises
    ------
    GaveUpError
        No attempt succeeded, or another would not help.
    OSError
        This machine's own disk is at fault.
    """
    began_s = clock()
    failures = 0
    while True:
        check()
        try:
            return work()
        except GableworkError:
            raise  # already reported, after its own attempts
        except Exception as error:
            if is_local(error):
                raise
            failures += 1
            cause = cause_of(error)
            wait_s = policy.pause_s(failures, elapsed_s=clock() - began_s, draw=draw()) if cause.again else None
            if wait_s is None:
                # the libraries' error may hold secrets and would be shown with it
                raise GaveUpError(cause, detail_of(error), failures) from None
        sleep(wait_s)
