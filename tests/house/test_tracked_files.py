"""What the repository holds: no hosts, no machine paths, no sprawling files, one version."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

import pipeline

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ("requirements.lock", "requirements-test.lock", "requirements-build.lock", "requirements-site.lock")
SHORT_LINES, SHORT_SHARE, MAX_LINES = 300, 0.8, 700
"""A file is one published term: at least this share is shorter than the first bound, none longer than the last."""


def tracked_files() -> list[Path]:
    """Files that git holds or would hold; all but the ignored ones where there is no git."""
    listing = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    return [path for name in listing.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def text_of(path: Path) -> str:
    """The text of a file, empty for binary ones."""
    content = path.read_bytes()
    return "" if b"\0" in content else content.decode("utf-8")


@pytest.mark.parametrize("name", LOCKS)
def test_a_lock_pins_every_package_by_hash_and_names_no_host(name: str) -> None:
    text = (ROOT / name).read_text()
    assert "://" not in text
    assert not re.search(r"^\s*-{1,2}(i|f|index|extra|find|trusted|no-index)", text, re.MULTILINE)
    entries = re.split(r"\n(?=[a-z0-9])", "\n" + text, flags=re.IGNORECASE)[1:]
    assert entries
    for entry in entries:
        assert re.match(r"[A-Za-z0-9._-]+(\[[a-z,]+\])?==[^\s;]+", entry), entry.splitlines()[0]
        assert "--hash=sha256:" in entry, entry.splitlines()[0]


def test_the_locks_agree_with_one_another() -> None:
    pins = [dict(re.findall(r"^([a-z0-9._-]+)==(\S+)", (ROOT / name).read_text(), re.MULTILINE)) for name in LOCKS]
    run, test, build, site = pins
    assert run.items() <= test.items()
    for lock in (build, site):
        assert {name: version for name, version in lock.items() if test.get(name, version) != version} == {}


def test_the_locks_hold_every_declared_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    groups = {
        "requirements.lock": project["project"]["dependencies"],
        "requirements-test.lock": project["project"]["dependencies"] + project["dependency-groups"]["test"],
        "requirements-build.lock": project["dependency-groups"]["build"],
        "requirements-site.lock": project["dependency-groups"]["site"],
    }
    for lock, requirements in groups.items():
        pinned = set(re.findall(r"^([a-z0-9._-]+)(?:\[[a-z,]+\])?==", (ROOT / lock).read_text(), re.MULTILINE))
        wanted = {re.split(r"[\[<>=!~ ]", requirement)[0].lower() for requirement in requirements}
        assert wanted <= pinned, f"{lock} lacks {sorted(wanted - pinned)}: run make lock"


def test_no_file_names_a_machine_or_a_registry() -> None:
    words = [
        "/wo" + "rk/",
        "/ho" + "me/",
        "/ro" + "ot/",
        "python" + "hosted",
        "py" + "pi.org",
        "npm" + "js",
        "debian." + "org",
    ]
    found = [f"{path.relative_to(ROOT)}: {word}" for path in tracked_files() for word in words if word in text_of(path)]
    assert found == []


def test_no_file_has_open_ends() -> None:
    marks = re.compile(r"\b(TO" + r"DO|FIX" + r"ME|XX" + r"X)\b")
    found = [
        str(path.relative_to(ROOT)) for path in tracked_files() if path.suffix == ".py" and marks.search(text_of(path))
    ]
    assert found == []


def test_most_files_are_short_and_none_sprawls() -> None:
    lengths = {
        str(path.relative_to(ROOT)): len(text_of(path).splitlines()) for path in tracked_files() if path.suffix == ".py"
    }
    assert {name: lines for name, lines in lengths.items() if lines > MAX_LINES} == {}
    short = sum(lines <= SHORT_LINES for lines in lengths.values())
    assert short >= SHORT_SHARE * len(lengths), sorted(lengths.items(), key=lambda item: -item[1])[:20]


def test_no_tracked_file_is_large() -> None:
    large = [str(path.relative_to(ROOT)) for path in tracked_files() if path.stat().st_size > 2_000_000]
    assert large == []


def test_the_version_is_one() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert pipeline.__version__ == project["version"]
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_supported_pythons_are_reported_alike() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    versions = [c.rsplit(" ", 1)[1] for c in project["classifiers"] if re.fullmatch(r".*Python :: 3\.\d+", c)]
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project["requires-python"]).groups()  # type: ignore[union-attr]
    assert versions == [f"3.{minor}" for minor in range(int(low), int(high))]
    assert f"Python 3.{low} to 3.{int(high) - 1}" in (ROOT / "README.md").read_text()


def test_the_files_of_tests_that_begin_first_are_there(pytestconfig: pytest.Config) -> None:
    conftest = pytestconfig.pluginmanager.get_plugin(str(ROOT / "tests" / "conftest.py"))
    assert conftest is not None
    assert [name for name in conftest.LONGEST_FIRST if not (ROOT / "tests" / name).exists()] == []
    assert [name for name in conftest.TOGETHER if not (ROOT / name).is_dir()] == []


def test_no_file_holds_both_sides_of_a_conflict() -> None:
    marks = re.compile(r"^(<{7}|>{7}) ", re.MULTILINE)
    assert [str(path.relative_to(ROOT)) for path in tracked_files() if marks.search(text_of(path))] == []
