"""Small charts as inline SVG; their colours come from the style sheet of the page, light or dark.

Classes: `bar` and `bar-b` (filled), `line-b` (a second series as steps), `axis`, `grid`, `mark`, `tick`, `name`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence

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
    text: Callable[[float], str]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ordinate:
    """The vertical axis: from values to pixels of the view box."""

    low: float
    high: float
    log: bool

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
        borders = zip(edges[:last], edges[1 : last + 1], places, strict=True)
        parts.append(polyline("line-b", [(across(border), y) for *both, y in borders for border in both]))
    for mark in marks:
        if left < mark < right:
            parts.append(line("mark", across(mark), across(mark), _TOP, floor))
    for tick in ticks(left, right, 5):
        parts.append(text("tick", across(tick), floor + 14.0, x.text(tick)))
    return _chart(parts, x.name, description)


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
        parts.append(text("tick", middle, top - 4.0, f"{count:,}"))
        parts.append(text("tick", middle, floor + 14.0, name))
    return _chart(parts, x_name, description)


def _frame(ordinate: Ordinate, y: Axis) -> list[str]:
    """Grid, ticks and name of the vertical axis."""
    floor = HEIGHT - _BOTTOM
    parts = []
    for tick in ordinate.ticks:
        place = ordinate.place(tick)
        parts.append(line("grid", _LEFT, WIDTH - _RIGHT, place, place))
        parts.append(text("tick", _LEFT - 4.0, place + 3.5, y.text(tick), anchor="end"))
    parts.append(line("axis", _LEFT, WIDTH - _RIGHT, floor, floor))
    middle = (_TOP + floor) / 2.0
    parts.append(text("name", 11.0, middle, y.name, turned=True))
    return parts


def _bar(kind: str, left: float, top: float, width: float) -> str:
    """A bar that stands on the horizontal axis."""
    return (
        f'<rect class="{kind}" x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{HEIGHT - _BOTTOM - top:.1f}"/>'
    )


def line(kind: str, x1: float, x2: float, y1: float, y2: float) -> str:
    """A straight line."""
    return f'<line class="{kind}" x1="{x1:.1f}" x2="{x2:.1f}" y1="{y1:.1f}" y2="{y2:.1f}"/>'


def polyline(kind: str, corners: Iterable[tuple[float, float]]) -> str:
    """A line over many places."""
    return f'<polyline class="{kind}" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in corners)}"/>'


def text(kind: str, x: float, y: float, words: str, *, anchor: str = "middle", turned: bool = False) -> str:
    """An escaped text."""
    turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{turn}>{escape(words)}</text>'


def _chart(parts: Sequence[str], x_name: str, description: str) -> Markup:
    """A chart of parts, with the name of the horizontal axis."""
    name = text("name", (_LEFT + WIDTH - _RIGHT) / 2.0, HEIGHT - 6.0, x_name)
    return svg("chart", WIDTH, HEIGHT, description, [*parts, name])


def svg(kind: str, width: float, height: float, description: str, parts: Iterable[str]) -> Markup:
    """The element around all parts, whose texts are escaped."""
    head = f'<svg class="{kind}" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(description)}">'
    return Markup(head + "".join(parts) + "</svg>")  # noqa: S704 -- every text in it is escaped


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
