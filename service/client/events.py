"""Follows the events of a job by server-sent events, over broken connections and restarts of the service."""

from __future__ import annotations

import codecs
import json
from collections.abc import AsyncGenerator, AsyncIterator, Iterator

from service.client.client_answers import OVER, Event
from service.client.client_errors import ForeignAnswerError
from service.client.session import Session, path_of
from service.client.transport import LostError


async def follow(session: Session, job_id: str, after: int) -> AsyncGenerator[Event, None]:
    """The events of a job with ids above `after` as they come, to the status with which it ends.

    Raises
    ------
    UnreachableError, ForeignAnswerError, RefusedError
        Those of every request; NotFoundError also if the job is removed meanwhile.
    """
    path, attempts = path_of("jobs", job_id, "events", f="sse"), session.attempts()
    while True:
        headers = {"Accept": "text/event-stream", "Last-Event-ID": str(after)}
        refused, lost = None, LostError("the stream of events has ended")
        try:
            async with session.open("GET", path, headers=headers) as answer:
                if answer.status == 204:
                    return
                if answer.status >= 300:
                    refused = await answer.whole()
                elif "text/event-stream" not in answer.headers.get("content-type", ""):
                    raise ForeignAnswerError(f"{session.url} answers with something else than events: check the URL")
                else:
                    # a service that answers is there, however quiet the job is
                    attempts.progressed()
                    async for text in _messages(answer.pieces):
                        event = _event(session, text)
                        after = event.id
                        yield event
                        if event.status in OVER:
                            return
        except LostError as error:
            lost = error
        if refused is None:
            # also after an end without the last status: the service stops, or the job is gone
            await session.after_loss(lost, attempts)
        else:
            await session.after_refusal(refused, attempts)


def _event(session: Session, text: str) -> Event:
    try:
        return Event.of(json.loads(text))
    except (KeyError, TypeError, ValueError) as error:
        raise ForeignAnswerError(f"{session.url} answers with something else than events: check the URL") from error


async def _messages(pieces: AsyncIterator[bytes]) -> AsyncIterator[str]:
    """The data of each message of a stream."""
    parser = EventParser()
    async for piece in pieces:
        for text in parser.feed(piece):
            yield text


class EventParser:
    r"""Splits a stream of server-sent events into the data of its messages.

    >>> parser = EventParser()
    >>> list(parser.feed(b": hello\n\nid: 1\ndata: {\r\nda")), list(parser.feed(b"ta: }\n\ndata: x"))
    ([], ['{\n}'])
    """

    def __init__(self) -> None:
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._left = ""
        self._data: list[str] = []

    def feed(self, piece: bytes) -> Iterator[str]:
        """The data of all messages that end in this piece."""
        *lines, self._left = (self._left + self._decoder.decode(piece)).split("\n")
        for line in (line.removesuffix("\r") for line in lines):
            if line.startswith("data:"):
                self._data.append(line[5:].removeprefix(" "))
            elif not line and self._data:
                yield "\n".join(self._data)
                self._data = []
