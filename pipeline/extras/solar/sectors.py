"""The sectors of azimuth in which horizons are kept: sector i is centred at i times its width, clockwise from north."""

from __future__ import annotations

import math

SECTORS = 72
"""Number of sectors of a full turn, 5 degrees each."""
SECTOR_RAD = 2.0 * math.pi / SECTORS
"""Width of a sector."""
