"""No input can stop a run: damaged copies of every kind end as a named refusal, or as a run whose solids are valid."""

import re
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.damage import BY_SUFFIX, damaged
from benchmarks.damaged_runs import Case, command
from benchmarks.undamaged_inputs import KINDS, kind_named, write_inputs

PER_KIND = 20
DEADLINE_S = 600.0


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    write_inputs(folder)
    return folder


def test_there_are_eleven_kinds_and_each_has_its_files(originals: Path) -> None:
    assert len(KINDS) == 11
    assert {name for kind in KINDS for name in kind.files} <= {path.name for path in originals.iterdir()}
    with pytest.raises(ValueError, match="kind 'e57' is not known: use las, laz"):
        kind_named("e57")


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_the_same_seed_damages_the_same_bytes_and_another_one_others(kind, originals, tmp_path):
    def written(seed: int, folder: Path) -> tuple[str, bytes]:
        case = Case(kind=kind, number=4, seed=seed)
        name = case.write(originals, folder)
        return name, (folder / case.file).read_bytes()

    one, again, other = (written(seed, tmp_path / str(k)) for k, seed in enumerate((5, 5, 6)))
    assert one == again != other
    assert one[1] != (originals / Case(kind=kind, number=4, seed=5).file).read_bytes()
    assert "{" not in " ".join(command(Case(kind=kind, number=4, seed=5), tmp_path))


@pytest.mark.parametrize("name", ["tile.las", "tile.copc.laz", "text.ply", "footprints.geojson", "batch.toml"])
def test_every_kind_of_damage_is_done_to_a_format(name: str, originals: Path) -> None:
    data = (originals / name).read_bytes()
    found = Counter(damaged(name, data, str(seed))[0].partition(" and ")[0] for seed in range(400))
    assert set(found) == {damage.__name__ for damage in BY_SUFFIX[Path(name).suffix]}


@pytest.mark.slow
def test_damaged_inputs_end_in_time_as_named_refusals_or_as_valid_runs() -> None:
    words = [sys.executable, "-m", "benchmarks.damaged_inputs", "--per-kind", str(PER_KIND)]
    words += ["--processes", "1", "--verbose"]
    folder = Path(__file__).resolve().parents[2]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            printed, _ = process.communicate(timeout=DEADLINE_S)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # it writes where it stands
            printed, _ = process.communicate(timeout=60.0)
    assert process.returncode == 0, printed
    rows = re.findall(r"^\| (\w+) \| (\d+) \| (\d+) \| (\d+) \| 0 \| 0 \| 0 \| 0 \|", printed, flags=re.MULTILINE)
    assert [row[0] for row in rows] == [*(kind.name for kind in KINDS), "all"]
    assert all(int(files) == int(refused) + int(runs) for _, files, refused, runs in rows)
    # a fuzz suite whose files are all refused at their first byte would find nothing
    assert int(rows[-1][3]) > PER_KIND
