"""What a test puts into the environment of a process that is to meet faults."""

import json
import os
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
"""To be put on PYTHONPATH."""


def environment(**faults: Any) -> dict[str, str]:
    """The environment variables for faults; `sitecustomize.py` lists them."""
    paths = [str(FOLDER), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {"PYTHONPATH": os.pathsep.join(paths), "GABLEWORK_FAULTS": json.dumps(faults)}
