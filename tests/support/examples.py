"""How many examples tests of properties draw."""

import os

PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "repeatable")
"""`repeatable` draws the same examples in every run, `quick` (`make test`) a third of them, `search` new ones."""


def examples(most: int) -> int:
    """Examples of one test: `most`, as CI draws them, or a third of them."""
    return -(-most // 3) if PROFILE == "quick" else most
