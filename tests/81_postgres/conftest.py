"""A PostgreSQL server for the tests of this folder."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

pytest.register_assert_rewrite("store_contract", "schedule_contract")

from processes import postgres_server, postgres_url  # noqa: E402

__all__ = ["postgres_server", "postgres_url"]
