"""Points read back from the GLB files of a run."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.export.glb_arrays import TYPES
from pipeline.export.glb_container import read_document
from pipeline.extras.octree.point_glb import ModelledPoints

_MM = 1000


def read_points_glb(content: bytes) -> tuple[ModelledPoints, Mapping[str, Any]]:
    """The points of a file made by `points_glb`, and the extras of its mesh.

    Coordinates have the precision of the file: half a step, or that of a float. Raises ValueError if it is another
    kind of file.
    """
    document, start = read_document(content)
    mesh, node = document["meshes"][0], document["nodes"][0]

    def column(name: str, width: int) -> npt.NDArray[Any]:
        accessor = document["accessors"][mesh["primitives"][0]["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = np.dtype(TYPES[accessor["componentType"]])
        values = np.frombuffer(content, kind, view["byteLength"] // kind.itemsize, start + view["byteOffset"])
        return values.reshape(accessor["count"], -1)[:, :width]

    stored = column("POSITION", 3)
    corner = np.rint(np.array(node["translation"]) * _MM).astype(np.int64)
    gltf = np.rint(stored * (node["scale"][0] * _MM)).astype(np.int64) + corner
    extras = mesh["extras"]
    points = ModelledPoints(
        xyz_mm=np.column_stack((gltf[:, 0], -gltf[:, 2], gltf[:, 1])),
        point_class=column("_CLASS", 1)[:, 0],
        building=column("_BUILDING", 1)[:, 0],
        plane=column("_PLANE", 1)[:, 0],
        residual_mm=column("_RESIDUAL", 1)[:, 0],
        buildings=tuple(extras["buildings"]),
    )
    return points, extras
