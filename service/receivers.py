"""Which receivers of webhooks get a message now: slow ones, and those that do not answer, hold up no others.

No SQL, no HTTP; time is an argument. One driver's own experience, forgotten with its process.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence

from pipeline.backoff import Backoff

SENDERS = 256
"""Messages that one driver sends at once. Each has a thread, which mostly waits."""
MAX_SLOW = SENDERS // 4
"""Most of them to slow receivers, so that quick ones always find a free sender."""
MAX_SLOW_PER_KEY = SENDERS // 8
MAX_PER_KEY = SENDERS // 2
"""Most of them to receivers of one key, and to its slow ones."""
SLOW_S = 1.0
"""Seconds from which on an answer counts as slow."""
LONGEST_REST_S = 300.0
"""Longest rest of a receiver that cannot be reached, so that one that is back gets its news soon."""
_MAX_KNOWN = 2000
"""Most receivers that are remembered; beyond it those to which nothing is sent are forgotten."""


@dataclasses.dataclass(frozen=True)
class Due:
    """A delivery that is due."""

    delivery_id: str
    receiver: str
    """The endpoint, or the URL of a subscriber."""
    payer: str
    """The key that made the endpoint or the job; empty if keys are not used."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Avoided:
    """What gets no message now."""

    receivers: frozenset[str] = frozenset()
    """Endpoints, and URLs of subscribers."""
    payers: frozenset[str] = frozenset()
    """Keys that have their share of the senders already."""


@dataclasses.dataclass
class _Known:
    """What is known of a receiver."""

    payer: str
    began_s: float | None = None
    """When the message that is under way began."""
    is_slow: bool = False
    failures: int = 0
    """How often it could not be reached, in a row."""
    rests_until_s: float = 0.0

    def is_slow_at(self, now_s: float) -> bool:
        """Whether it was slow the last time, or is so now."""
        return self.is_slow or (self.began_s is not None and now_s - self.began_s > SLOW_S)


class Receivers:
    """What a driver knows of its receivers.

    Parameters
    ----------
    first_rest_s : float
        Seconds that a receiver rests after the first time that it could not be reached; each further rest is three
        times as long.
    """

    def __init__(self, first_rest_s: float) -> None:
        self._rests = Backoff(first_s=first_rest_s, longest_s=LONGEST_REST_S, factor=3.0)
        self._known: dict[str, _Known] = {}

    @property
    def under_way(self) -> int:
        """Number of messages that are being sent."""
        return sum(known.began_s is not None for known in self._known.values())

    def begin(self, receiver: str, payer: str, now_s: float) -> None:
        """A message to it is sent from now on."""
        known = self._known.setdefault(receiver, _Known(payer=payer))
        known.payer, known.began_s = payer, now_s

    def end(self, receiver: str, duration_s: float, *, was_reached: bool, now_s: float) -> None:
        """The message is sent, or was not taken."""
        known = self._known[receiver]
        known.began_s, known.is_slow, known.rests_until_s = None, duration_s > SLOW_S, 0.0
        known.failures = 0 if was_reached else known.failures + 1
        if not was_reached:
            known.rests_until_s = now_s + self._rests.bound_s(known.failures)
        elif not known.is_slow:
            # most are quick: nothing has to be remembered of them
            del self._known[receiver]
        if len(self._known) > _MAX_KNOWN:
            self._known = {name: one for name, one in self._known.items() if one.began_s is not None}

    def avoided(self, now_s: float) -> Avoided:
        """What gets no message now, whatever is due."""
        limits = _Limits(self._known, now_s)
        return Avoided(
            receivers=frozenset(
                name
                for name, known in self._known.items()
                if known.began_s is not None
                or known.rests_until_s > now_s
                or (known.is_slow and not limits.has_room_for_slow(known.payer))
            ),
            payers=frozenset(payer for payer in limits.busy if not limits.has_room(payer)),
        )

    def chosen(self, line: Sequence[Due], now_s: float) -> list[Due]:
        """Those of a line that are sent now: one per receiver, within the shares of keys and of slow receivers."""
        limits, avoided = _Limits(self._known, now_s), self.avoided(now_s).receivers
        found: dict[str, Due] = {}
        for due in line:
            known = self._known.get(due.receiver)
            is_slow = known is not None and known.is_slow
            if due.receiver in avoided or due.receiver in found or not limits.has_room(due.payer):
                continue
            if is_slow and not limits.has_room_for_slow(due.payer):
                continue
            limits.add(due.payer, is_slow=is_slow)
            found[due.receiver] = due
        return list(found.values())


class _Limits:
    """How many senders are taken, and by which keys."""

    def __init__(self, known: dict[str, _Known], now_s: float) -> None:
        at_work = [one for one in known.values() if one.began_s is not None]
        self.busy = Counter(one.payer for one in at_work)
        self._slow = Counter(one.payer for one in at_work if one.is_slow_at(now_s))

    def has_room(self, payer: str) -> bool:
        """Whether a key may begin one more message."""
        return self.busy.total() < SENDERS and self.busy[payer] < MAX_PER_KEY

    def has_room_for_slow(self, payer: str) -> bool:
        """Whether a key may begin one more message to a slow receiver."""
        return self._slow.total() < MAX_SLOW and self._slow[payer] < MAX_SLOW_PER_KEY

    def add(self, payer: str, *, is_slow: bool) -> None:
        """A message begins."""
        self.busy[payer] += 1
        self._slow[payer] += is_slow
