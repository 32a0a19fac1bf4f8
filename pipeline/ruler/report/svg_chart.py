"""Small charts as inline SVG; their colours come from the style sheet of the page, light or dark.

Classes: `bar` and `bar-b` (filled), `line-b` (a second series as steps), `axis`, `grid`, `mark`, `tick`, `name`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from markupsafe import Markup, escape

from pipeline.model import FloatArray

WIDTH, HEIGHT = 380.0, 230.0
"""Size of the view box; the page scales it."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 20.0, 10.0, 40.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Axis:
    """Labels of an axis."""

    name: str
    """Name and unit."""
    text: Callable[[float], str]
    """Text of a tick."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ordinate:
    """The vertical axis: from values to pixels of the view box."""

    low: float
    """Lowest value shown; > 0 on a logarithmic axis."""
    high: float
    """Highest value shown."""
    log: bool
    """True for a logarithmic axis."""

    def place(self, value: float) -> float:
        """Pixels from the top."""
        value = min(max(value, self.low), self.high)
        if self.log:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return HEIGHT - _BOTTOM - share * (HEIGHT - _TOP - _BOTTOM)

    @property
    def ticks(self) -> list[float]:
        """Values with a line."""
        if not self.log:
            return ticks(self.low, self.high, 4)
        first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
        return [10.0**power for power in range(first, last + 1)]


def ticks(low: float, high: float, wanted: int) -> list[float]:
    """About `wanted` round values from low to high.

    >>> ticks(0.0, 1.0, 4), ticks(-0.4, 0.4, 4)
    ([0.0, 0.2, 0.4, 0.6, 0.8, 1.0], [-0.4, -0.2, 0.0, 0.2, 0.4])
    """
    span = max(high - low, 1e-12)
    scale = 10.0 ** math.floor(math.log10(span / wanted))
    step = next(scale * factor for factor in (1.0, 2.0, 5.0, 10.0, 20.0) if span / (scale * factor) <= wanted + 1.0)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(step * number, 12) + 0.0 for number in range(first, last + 1)]


def histogram_svg(
    edges: FloatArray,
    heights: FloatArray,
    *,
    x: Axis,
    y: Axis,
    ordinate: Ordinate,
    description: str,
    steps: FloatArray | None = None,
    marks: Sequence[float] = (),
) -> Markup:
    """A histogram of heights (bins,) over edges (bins + 1,).

    `steps` (bins,) is a second series, drawn as a line of steps. Dashed vertical lines stand at `marks`.
    """
    left, right = float(edges[0]), float(edges[-1])

    def across(value: float) -> float:
        return _LEFT + (value - left) / (right - left) * (WIDTH - _LEFT - _RIGHT)

    floor = HEIGHT - _BOTTOM
    parts = _frame(ordinate, y)
    for low, high, height in zip(edges[:-1], edges[1:], heights, strict=True):
        top = ordinate.place(float(height)) if height > 0.0 else floor
        if top < floor:
            wide = max(across(high) - across(low) - 0.8, 0.4)
            parts.append(_bar("bar", across(low) + 0.4, top, wide))
    if steps is not None:
        held = np.flatnonzero(steps > 0.0)
        last = int(held[-1]) + 1 if len(held) else 0
        places = [ordinate.place(float(step)) if step > 0.0 else floor for step in steps[:last]]
        corners = [
            f"{across(border):.1f},{place:.1f}"
            for low, high, place in zip(edges[:last], edges[1 : last + 1], places, strict=True)
            for border in (low, high)
        ]
        parts.append(f'<polyline class="line-b" points="{" ".join(corners)}"/>')
    for mark in marks:
        if left < mark < right:
            parts.append(
                f'<line class="mark" x1="{across(mark):.1f}" x2="{across(mark):.1f}" y1="{_TOP}" y2="{floor}"/>'
            )
    for tick in ticks(left, right, 5):
        parts.append(_text("tick", across(tick), floor + 14.0, x.text(tick)))
    return _svg(parts, x.name, description)


def category_svg(
    names: Sequence[str],
    shares: FloatArray,
    counts: Sequence[int],
    *,
    x_name: str,
    y_name: str,
    description: str,
    pale: Sequence[bool] = (),
) -> Markup:
    """Bars of shares from 0 to 1 by class, with the count of each class over its bar; nan has no bar.

    Classes that do not count are `pale`.
    """
    ordinate = Ordinate(low=0.0, high=1.12, log=False)
    parts = _frame(ordinate, Axis(name=y_name, text=lambda value: f"{100.0 * value:.0f} %"))
    step = (WIDTH - _LEFT - _RIGHT) / max(len(names), 1)
    floor = HEIGHT - _BOTTOM
    for place, (name, share, count) in enumerate(zip(names, shares, counts, strict=True)):
        middle = _LEFT + step * (place + 0.5)
        top = floor if math.isnan(share) else ordinate.place(float(share))
        kind = "bar pale" if pale and pale[place] else "bar"
        parts.append(_bar(kind, middle - 0.36 * step, top, 0.72 * step))
        parts.append(_text("tick", middle, top - 4.0, f"{count:,}"))
        parts.append(_text("tick", middle, floor + 14.0, name))
    return _svg(parts, x_name, description)


def _frame(ordinate: Ordinate, y: Axis) -> list[str]:
    """Grid, ticks and name of the vertical axis."""
    floor = HEIGHT - _BOTTOM
    parts = []
    for tick in ordinate.ticks:
        place = ordinate.place(tick)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{place:.1f}" y2="{place:.1f}"/>')
        parts.append(_text("tick", _LEFT - 4.0, place + 3.5, y.text(tick), anchor="end"))
    parts.append(f'<line class="axis" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{floor}" y2="{floor}"/>')
    middle = (_TOP + floor) / 2.0
    parts.append(_text("name", 11.0, middle, y.name, turned=True))
    return parts


def _bar(kind: str, left: float, top: float, width: float) -> str:
    """A bar that stands on the horizontal axis."""
    return (
        f'<rect class="{kind}" x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{HEIGHT - _BOTTOM - top:.1f}"/>'
    )


def _text(kind: str, x: float, y: float, text: str, *, anchor: str = "middle", turned: bool = False) -> str:
    """An escaped text."""
    turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{turn}>{escape(text)}</text>'


def _svg(parts: Sequence[str], x_name: str, description: str) -> Markup:
    """The element around everything, with the name of the horizontal axis."""
    middle = (_LEFT + WIDTH - _RIGHT) / 2.0
    name = _text("name", middle, HEIGHT - 6.0, x_name)
    head = f'<svg class="chart" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" role="img" aria-label="{escape(description)}">'
    return Markup(head + "".join(parts) + name + "</svg>")  # noqa: S704 -- every text in it is escaped above


def rebinned(edges_low: FloatArray, edges_high: FloatArray, counts: FloatArray, edges: FloatArray) -> FloatArray:
    """Counts of bins distributed to other bins, (m,), with the same sum; values beyond go to the outermost ones.

    Counts are even within each given bin. Their borders (n,) adjoin and ascend; the outermost may be infinite.
    """
    low = np.where(np.isfinite(edges_low), edges_low, np.minimum(edges[0], edges_high) - 1.0)
    high = np.where(np.isfinite(edges_high), edges_high, np.maximum(edges[-1], edges_low) + 1.0)
    borders = np.concatenate([low[:1], high])
    cumulated = np.concatenate([[0.0], np.cumsum(counts)])
    at = np.interp(edges, borders, cumulated)
    at[0], at[-1] = 0.0, cumulated[-1]
    return np.diff(at)
