"""The output of the process `echo`."""

from __future__ import annotations

import json
from pathlib import Path

from service.outputs.catalogue import NAME as CATALOGUE_NAME
from service.outputs.catalogue import Catalogue, ResultsCrs, StoredOutput
from service.outputs.kinds import ECHO_OUTPUTS


def write_echo(message: str, out_dir: Path) -> None:
    """Write the message and the catalogue into a folder; it is made if it is missing."""
    from pipeline.io.storage import LocalStorage, sha256_of

    storage, name = LocalStorage(root=out_dir), ECHO_OUTPUTS["echo"].filename
    storage.put(name, json.dumps({"message": message}, ensure_ascii=False).encode())
    path = out_dir / name
    stored = {"echo": StoredOutput(size_bytes=path.stat().st_size, sha256=sha256_of(path))}
    catalogue = Catalogue(outputs=stored, crs=ResultsCrs.unknown(), n_buildings=0)
    storage.put(CATALOGUE_NAME, catalogue.to_json().encode())
