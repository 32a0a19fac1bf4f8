"""Put measured tables into docs/results/methods.md: `python benchmarks/results_page.py --out DIR [--page FILE]`.

The page holds pairs of marks, `<!-- begin NAME -->` and `<!-- end NAME -->`. The text between them is replaced by
DIR/NAME as `ruler.py`, `hofmann_tables.py`, `sweep_limits.py` and `method_times.py` wrote it; a part without a file
stays as it is. The plot goes beside the page. Prose is left alone: read it again when the figures change.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parents[1] / "docs" / "results" / "methods.md"
PLOT = "sweep_limits.png"
LEFT_OUT = ("| sweep-", "| samp", "| autzen")
"""Lines of the overview that a page has no room for: the sweep has its own part, the others no building reference."""
_PART = re.compile(r"(<!-- begin (\S+) -->\n).*?(<!-- end \2 -->)", re.DOTALL)


def filled(page: str, out: Path, left_out: tuple[str, ...] = ()) -> tuple[str, list[str]]:
    """The page with the parts that are there, and the names of those that are not. Lines with a prefix are dropped."""
    missing = []

    def part(found: re.Match[str]) -> str:
        path = out / found[2]
        if not path.exists():
            missing.append(found[2])
            return found[0]
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith(left_out)]
        text = "\n".join(lines).strip()
        return f"{found[1]}\n{text}\n\n{found[3]}"

    return _PART.sub(part, page), missing


def main() -> int:
    """Fill in."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--page", type=Path, default=PAGE)
    arguments = parser.parse_args()
    page, missing = filled(arguments.page.read_text(encoding="utf-8"), arguments.out, LEFT_OUT)
    arguments.page.write_text(page, encoding="utf-8")
    if (arguments.out / PLOT).exists():
        pictures = arguments.page.parent / "pictures"
        pictures.mkdir(exist_ok=True)
        shutil.copyfile(arguments.out / PLOT, pictures / PLOT)
    for name in missing:
        print(f"{arguments.out / name} is not there: its part stays as it is", file=sys.stderr)
    return int(bool(missing))


if __name__ == "__main__":
    sys.exit(main())
