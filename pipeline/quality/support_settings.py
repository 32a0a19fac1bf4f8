"""Settings of the judgement whether a model's own points support it."""

from __future__ import annotations

from pipeline.parameters import Parameters, parameter


class SupportSettings(Parameters):
    """Thresholds from which on a valid model is `doubtful` in place of `ok`; they change no geometry of models."""

    min_share_on_roof: float = parameter(
        0.7,
        "Share of the roof returns within 0.2 m of the model; below it the reason is `poor_fit`.",
        minimum=0.0,
        maximum=1.0,
    )
    max_scatter_m: float = parameter(
        0.15,
        "Robust standard deviation of the roof returns about the model; above it the reason is `scattered`.",
        unit="m",
        minimum=0.0,
        maximum=10.0,
    )
    max_scatter_noises: float = parameter(
        1.5,
        "A scatter up to this many times the noise of the ground nearby is allowed, too. Where that is more than "
        "`max_scatter_m`, `min_share_on_roof` falls as the share of normal residuals with that scatter does.",
        unit="times the noise",
        minimum=0.0,
        maximum=10.0,
    )
    max_unseen_share: float = parameter(
        0.6,
        "Share of the roof's plan area without a point on the roof nearby; above it the reason is `not_seen`.",
        minimum=0.0,
        maximum=1.0,
    )
    max_beside_share: float = parameter(
        0.2,
        "Area without any point beside an outline that was drawn by the points, or left out of a given footprint, over "
        "the same and the roof's plan area; above it the reason is `not_seen`.",
        minimum=0.0,
        maximum=1.0,
    )
    min_returns_per_face: float = parameter(
        2.0, "Roof returns per roof face; below it the reason is `too_many_faces`.", minimum=0.0, maximum=1000.0
    )
    min_confidence: float = parameter(
        0.5,
        "Confidence that an object found in the points alone is a building; below it the reason is `uncertain`.",
        minimum=0.0,
        maximum=1.0,
    )
    max_level_side_share: float = parameter(
        0.1,
        "Share of the outline of an object found in the points alone where a level roof ends at ground as high; above "
        "it the reason is `uncertain`: a deck or a terrace.",
        minimum=0.0,
        maximum=1.0,
    )
    block_loss: float = parameter(
        0.05,
        "A block replaces a doubtful model if it explains at most this share of the roof returns less.",
        minimum=0.0,
        maximum=1.0,
    )
