"""Limits the requests of each client; each process of the API counts in its own memory."""

from __future__ import annotations

import ipaddress
import threading
import time

from limits import RateLimitItem, parse_many
from limits.storage import MemoryStorage
from limits.strategies import SlidingWindowCounterRateLimiter

from service.errors import StartUpError, TooManyRequestsError
from service.settings import ServiceSettings


class RateLimiter:
    """Counts requests of each client over a sliding window. Any number of threads may call.

    Parameters
    ----------
    settings : ServiceSettings
        `rate_limit`, one or more limits in the notation of the library limits: `100/second; 6000/minute`.

    Raises
    ------
    StartUpError
        The notation is not understood.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        try:
            self._limits: tuple[RateLimitItem, ...] = tuple(parse_many(settings.rate_limit))
        except ValueError as fault:
            raise StartUpError(
                f"rate_limit is {settings.rate_limit!r}: write a number and a time, such as 6000/minute"
            ) from fault
        if any(limit.amount < 1 for limit in self._limits):
            raise StartUpError(f"rate_limit is {settings.rate_limit!r}: allow at least 1 request")
        self._strategy = SlidingWindowCounterRateLimiter(MemoryStorage())
        # two threads at once may start the same timer of the storage, which then raises
        self._counting = threading.Lock()

    def check(self, client: str) -> None:
        """Count one request of a key (by its id), or of an address if there is no key.

        Raises
        ------
        TooManyRequestsError
            The client has used up its requests; the error says when the next one is accepted.
        """
        client = counted_as(client)
        for limit in self._limits:
            with self._counting:
                is_within = self._strategy.hit(limit, client)
            if not is_within:
                reset_at = self._strategy.get_window_stats(limit, client).reset_time
                raise TooManyRequestsError(
                    f"more than {limit.amount} requests in {limit.get_expiry()} s: wait, or poll less often",
                    retry_after_s=min(max(reset_at - time.time(), 1.0), float(limit.get_expiry())),
                )


def counted_as(client: str) -> str:
    """The client as it is counted: an IPv6 address by its network, since one client has 2^64 addresses.

    >>> counted_as("2001:db8::1234"), counted_as("192.0.2.1"), counted_as("::ffff:192.0.2.1")
    ('2001:db8::/64', '192.0.2.1', '192.0.2.1')
    """
    try:
        address = ipaddress.ip_address(client.partition("%")[0])
    except ValueError:
        return client
    if isinstance(address, ipaddress.IPv4Address):
        return client
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, 64), strict=False))
