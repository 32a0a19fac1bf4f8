"""The output of the process `echo`."""

from __future__ import annotations

import json
from pathlib import Path

from service.outputs.catalogue import Catalogue, stored_outputs
from service.outputs.kinds import ECHO_OUTPUTS


def write_echo(message: str, out_dir: Path) -> None:
    """Write the message and the catalogue into a folder; it is made if it is missing."""
    from pipeline.io.storage import LocalStorage

    content = json.dumps({"message": message}, ensure_ascii=False).encode()
    LocalStorage(root=out_dir).put(ECHO_OUTPUTS["echo"].filename, content)
    Catalogue(outputs=stored_outputs(out_dir, ECHO_OUTPUTS.values())).write(out_dir)
