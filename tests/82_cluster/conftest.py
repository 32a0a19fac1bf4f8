"""Real schedulers, workers, drivers and APIs on the loopback."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

from processes import programs

__all__ = ["programs"]
