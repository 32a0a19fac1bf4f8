"""Every library that is installed with gablework, or that a wheel carries, is in THIRD_PARTY_NOTICES.md."""

import importlib.util
import json
import platform
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "THIRD_PARTY_NOTICES.md").read_text()
ROWS = {cells[0]: cells for cells in re.findall(r"^\| ([^|]+) \| ([^|]+) \| ([^|]+) \|", TEXT, re.MULTILINE)}
LGPL = {"GEOS", "libiconv", "libquadmath", "SpatiaLite"}


@pytest.fixture(scope="module")
def notices() -> ModuleType:
    """docs/notices.py as a module."""
    spec = importlib.util.spec_from_file_location("notices", ROOT / "docs" / "notices.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_the_file_is_what_the_wheels_say(notices: ModuleType) -> None:
    if (sys.version_info[:2], platform.machine(), sys.platform) == ((3, 11), "x86_64", "linux"):
        assert notices.render() == TEXT, "run make docs"


def test_every_locked_package_is_there_with_its_licence(notices: ModuleType) -> None:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    locked = {line.split("==")[0] for line in lines if "==" in line and not line.startswith((" ", "#"))}
    assert len(locked) > 80
    assert locked == set(notices.locked())
    for name in locked:
        assert re.search(r"[A-Z]", ROWS[name][2]), name
        assert len(notices.licence_of(name)) <= 60


def test_every_native_library_in_a_wheel_is_there(notices: ModuleType) -> None:
    carried = {name: notices.native_of(name) for name in notices.installed()}
    for name, least in (("shapely", "GEOS"), ("pyogrio", "GDAL"), ("pyproj", "PROJ"), ("llvmlite", "LLVM")):
        assert least in map(notices.project_of, carried[name])
    assert {"GEOS", "libiconv", "SpatiaLite", "curl"} <= set(map(notices.project_of, carried["pyogrio"]))
    assert {"OpenBLAS, LAPACK", "libgfortran"} <= set(map(notices.project_of, carried["numpy"]))
    assert "gRPC" in carried["pyarrow"]
    for project in {notices.project_of(library) for libraries in carried.values() for library in libraries}:
        assert project in ROWS


def test_a_library_that_no_one_has_looked_at_is_refused_with_the_fix(notices: ModuleType) -> None:
    with pytest.raises(KeyError, match="libnew is in a wheel and not in NATIVE"):
        notices.project_of("libnew")


def test_nothing_is_under_the_gpl_alone(notices: ModuleType) -> None:
    allowed = ("GPL-3.0-or-later WITH GCC-exception-3.1", "LGPL-2.1")
    licences = [native.licence for native in notices.NATIVE.values()] + [row[2] for row in ROWS.values()]
    for licence in licences:
        ways = licence.split(" OR ")
        assert any("GPL" not in way or way.startswith(allowed) for way in ways), licence
    lesser = {name for name, native in notices.NATIVE.items() if "LGPL" in native.licence}
    assert lesser == LGPL
    head = TEXT.split("## Python packages")[0]
    assert all(name in head for name in LGPL)


def test_parts_of_rust_wheels_are_free_to_use(notices: ModuleType) -> None:
    for name in ("cql2", "lazrs", "pydantic-core"):
        (bill,) = notices.bill_of(name)
        assert f"`{bill}`" in TEXT
        parts = json.loads(notices.installed()[name].locate_file(bill).read_text())["components"]
        ways = [entry.get("expression", "") for part in parts for entry in part.get("licenses", ())]
        assert ways
        assert [way for way in ways if "GPL" in way and " OR " not in way] == []


def test_the_wheels_texts_stay_in_the_image(notices: ModuleType) -> None:
    docker = (ROOT / "docker" / "Dockerfile").read_text()
    removed = re.findall(r"find \S+/lib -type d -name (\S+) -prune -exec rm -rf", docker)
    assert removed == ["tests"]
    for name in notices.installed():
        texts = notices.texts_of(name)
        assert texts, name
        kept = [text for text in texts if "tests" not in Path(text).parts]
        assert kept, name
    assert any(text.endswith("LICENSE_GEOS") for text in notices.texts_of("shapely"))
    assert "pyogrio/gdal_data/LICENSE.TXT" in notices.texts_of("pyogrio")


def test_the_wheel_and_the_image_have_the_file() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "THIRD_PARTY_NOTICES.md" in project["license-files"]
    assert re.search(r"^COPY .*\bTHIRD_PARTY_NOTICES\.md\b", (ROOT / "docker" / "Dockerfile").read_text(), re.MULTILINE)


def test_the_packages_of_the_page_are_there_and_their_texts_are_written(notices: ModuleType) -> None:
    wanted = json.loads((ROOT / "service" / "viewer" / "package.json").read_text())["dependencies"]
    assert set(wanted) <= set(notices.of_page()) <= set(ROWS)
    config = (ROOT / "service" / "viewer" / "vite.config.ts").read_text()
    assert 'license: { fileName: "third_party_licenses.md" }' in config
    built = ROOT / "service" / "viewer" / "dist" / "third_party_licenses.md"
    if built.is_file():
        bundled = re.findall(r"^## (\S+) - \S+ \((.+)\)$", built.read_text(), re.MULTILINE)
        assert {"three", "fzstd", "hyparquet", "tus-js-client"} <= {name for name, _ in bundled}
        assert {name: licence for name, licence in bundled if notices.of_page()[name][1] != licence} == {}
