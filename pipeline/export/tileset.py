"""3D Tiles 1.1: a node and a tileset as JSON (OGC 22-025r4)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.model import FloatArray


def node_entry(
    volume: Mapping[str, Any],
    error_m: float,
    *,
    transform: FloatArray | None = None,
    uri: str | None = None,
    extras: Mapping[str, Any] | None = None,
    children: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """A node as JSON; `transform` is the matrix (4, 4) to the coordinates of its parent."""
    found: dict[str, Any] = {"boundingVolume": volume, "geometricError": error_m}
    if transform is not None and not np.array_equal(transform, np.eye(4)):
        found["transform"] = transform.T.reshape(-1).tolist()
    if uri is not None:
        found["content"] = {"uri": uri}
    if extras is not None:
        found["extras"] = extras
    if children:
        found["children"] = children
    return found


def tileset_bytes(asset: Mapping[str, Any], error_m: float, refine: str, root: Mapping[str, Any], **more: Any) -> bytes:
    """A tileset file; `refine` says whether children are shown beside their parents (ADD) or in their place."""
    document = {"asset": asset, "geometricError": error_m, "root": {"refine": refine, **root}, **more}
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def moved_tileset(content: bytes, folder: str) -> bytes:
    """A tileset for another place, from which `folder` leads to its files."""
    document = json.loads(content)
    waiting = [document["root"]]
    for node in waiting:
        if "content" in node:
            node["content"]["uri"] = f"{folder}/{node['content']['uri']}"
        waiting.extend(node.get("children", ()))
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
