"""The programs that tests start."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from processes import postgres_server, postgres_url, programs

__all__ = ["postgres_server", "postgres_url", "programs"]
