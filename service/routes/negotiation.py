"""Content negotiation: the media type that a client prefers."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.exceptions import HTTPException

_SAME = {
    "application/geo+json": ("application/json",),
    "application/city+json": ("application/json",),
    "application/json": (),
}
"""Other names under which a client may request a type; the answer carries the type itself."""
_BYTES = ("application/octet-stream",)
MAX_ENTRIES = 100
"""Media types of a header that are looked at; browsers send a dozen."""


def _weights(accept: str) -> dict[str, float]:
    """Weight by media range; entries that cannot be parsed are left out."""
    found: dict[str, float] = {}
    for entry in accept.split(",", MAX_ENTRIES)[:MAX_ENTRIES]:
        name, *parameters = (part.strip().lower() for part in entry.split(";"))
        weight = 1.0
        for parameter in parameters:
            key, _, text = parameter.partition("=")
            if key.strip() == "q":
                try:
                    weight = float(text)
                except ValueError:
                    weight = 0.0
        if "/" in name:
            found[name] = weight if 0.0 <= weight <= 1.0 else 0.0
    return found


def _weight(media_type: str, weights: dict[str, float]) -> float:
    """Weight of one type: the most specific range counts."""
    for name in (media_type, *_SAME.get(media_type, _BYTES), f"{media_type.partition('/')[0]}/*", "*/*"):
        if name in weights:
            return weights[name]
    return 0.0


def preferred(accept: str | None, offers: Sequence[str]) -> str:
    """The type that a client prefers.

    Parameters
    ----------
    accept : str or None
        The header; None or an empty one accepts anything.
    offers : sequence of str
        Media types; the first wins among equals.

    Raises
    ------
    HTTPException
        406: the client accepts none of them.

    Examples
    --------
    >>> preferred("model/obj;q=0.5, application/*", ["application/geo+json", "model/obj"])
    'application/geo+json'
    >>> preferred("model/obj", ["application/geo+json", "model/obj"])
    'model/obj'
    """
    if accept is None or not accept.strip():
        return offers[0]
    weights = _weights(accept)
    best = max(offers, key=lambda offer: _weight(offer, weights))
    if _weight(best, weights) <= 0.0:
        raise HTTPException(
            406, f"the answer is available as {', '.join(offers)}: name one of them in the header Accept"
        )
    return best
