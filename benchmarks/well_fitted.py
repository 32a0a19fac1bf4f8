"""How many models that lie on their points are not `ok`, in finished runs.

    .venv/bin/gablework reconstruct TILE.laz --out DIR [--classes ignore]
    .venv/bin/python -m benchmarks.well_fitted DIR [DIR ...]

A model lies on its points if at least 90 % of its roof returns (what the sensor sees of it from above) are within 0.2 m
of it: `share_within_0_2m`. Prints, per run, the models, those that lie on their points, and which of these are not
`ok`, by reason. The last column is the share of models without a confidence.
"""

from __future__ import annotations

import argparse
import collections
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.entries import markdown_table
from pipeline.export.geoparquet import read_table
from pipeline.model import Status

LEAST_SHARE = 0.9
COLUMNS = ("status", "reason", "share_within_0_2m", "detection_confidence")


def row_of(name: str, records: Sequence[Mapping[str, Any]]) -> list[str]:
    """The row of a run with these records."""
    models = [record for record in records if record["status"] != Status.FAILED]
    fitted = [model for model in models if (model["share_within_0_2m"] or 0.0) >= LEAST_SHARE]
    others = collections.Counter(model["reason"] for model in fitted if model["status"] != Status.OK)
    unknown = sum(model["detection_confidence"] is None for model in models)
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(others.items()))
    share = f"{others.total() / len(fitted):.1%}" if fitted else ""
    null = f"{unknown / len(models):.1%}" if models else ""
    return [name, str(len(models)), str(len(fitted)), str(others.total()), share, reasons, null]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    rows = [
        row_of(run.name, read_table(str(run), "buildings").select(list(COLUMNS)).to_pylist())
        for run in parser.parse_args().runs
    ]
    heads = ["run", "models", "on their points", "of these not ok", "share", "reasons", "without a confidence"]
    print(markdown_table(heads, rows))


if __name__ == "__main__":
    main()
