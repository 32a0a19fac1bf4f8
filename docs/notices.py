"""Writes THIRD_PARTY_NOTICES.md: what is installed with gablework, under which licences, and what these wheels carry.

`make docs` runs it. Names and versions come from requirements.lock and from the locked packages of the web page;
licences, sources and native libraries from the installed wheels. Only the licences of native libraries are written
here, since most wheels do not state them. tests/house/test_notices.py fails where a wheel carries an unknown one.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "THIRD_PARTY_NOTICES.md"

_SPELLED = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD 3-Clause License": "BSD-3-Clause",
    "BSD License": "BSD",
    "ISC License": "ISC",
    "MIT License": "MIT",
    "New BSD": "BSD-3-Clause",
    "Python Software Foundation License": "PSF",
}
"""Licences in the words of some wheels, and by their usual names."""
_NOT_HERE = {"colorama": ("BSD-3-Clause", "https://github.com/tartley/colorama")}
"""Licence and source of what is locked for other systems only."""
_SOURCES = {"lazrs": "https://github.com/laz-rs/laz-rs-python"}
"""Sources that a wheel does not state."""
_LONGEST = 60
"""Characters of a licence's name; some wheels have its whole text in the field."""
_LINKS = ("repository", "source", "sources", "source code", "code", "github", "homepage", "home")
_TEXT = re.compile(r"(^|/)[^/]*(licen[cs]e|copying|notice|copyright)[^/]*$", re.IGNORECASE)
_LIBRARY = re.compile(r"(?:^|/)(lib[^/]+?)(?:-[0-9a-f]{8})*\.so(?:\.[0-9.]+)?$")
_MODULE = re.compile(r"\.(cpython-|abi3)")
"""An extension of Python is the wheel's own code."""
_LINKED = re.compile(
    r"^(?:3rdparty dependency ([\w. +-]+?) is\s+(?:statically|redistributed)|Name: (.+)\nFiles: .*\.so\b)", re.MULTILINE
)
"""Libraries in the wheel's own ones that a licence text names: in the words of pyarrow, and of numpy and others."""
_PORT = re.compile(r"^([a-z][a-z0-9-]*) [0-9a-f]{64}$", re.MULTILINE)
_TOOLS = {"pkgconf", "usage", "vcpkg-cmake", "vcpkg-cmake-config", "vcpkg-cmake-wrapper", "vcpkg-pkgconfig-get-modules"}
"""Ports of vcpkg that build others and are in no library."""


@dataclasses.dataclass(frozen=True)
class Native:
    """A library that wheels carry."""

    licence: str
    """By its SPDX expression, where it has one."""
    source: str
    """Where its source is."""
    names: tuple[str, ...] = ()
    """Its names in wheels: of files, without hash and ending, of ports of vcpkg, and as other wheels write them."""


NATIVE = {
    "Apache Arrow, Parquet": Native("Apache-2.0", "https://github.com/apache/arrow", ("libarrow", "libparquet")),
    "Apache ORC": Native("Apache-2.0", "https://github.com/apache/orc"),
    "Apache Thrift": Native("Apache-2.0", "https://github.com/apache/thrift"),
    "Blosc": Native("BSD-3-Clause", "https://github.com/Blosc/c-blosc", ("libblosc",)),
    "Brotli": Native("MIT", "https://github.com/google/brotli", ("libbrotlicommon", "libbrotlidec")),
    "c-ares": Native("MIT", "https://github.com/c-ares/c-ares"),
    "curl": Native("curl", "https://github.com/curl/curl", ("libcurl",)),
    "Expat": Native("MIT", "https://github.com/libexpat/libexpat", ("expat",)),
    "FreeType": Native("FTL OR GPL-2.0-or-later", "https://gitlab.freedesktop.org/freetype/freetype", ("libfreetype",)),
    "GDAL": Native("MIT", "https://github.com/OSGeo/gdal", ("libgdal",)),
    "GEOS": Native(
        "LGPL-2.1-only",
        "https://github.com/libgeos/geos",
        ("geos", "libgeos", "libgeos_c", "Geometry Engine Open Source (GEOS)"),
    ),
    "gflags": Native("BSD-3-Clause", "https://github.com/gflags/gflags"),
    "GIFLIB": Native("MIT", "https://giflib.sourceforge.net", ("libgif",)),
    "glog": Native("BSD-3-Clause", "https://github.com/google/glog"),
    "gRPC": Native("Apache-2.0", "https://github.com/grpc/grpc"),
    "HarfBuzz": Native("MIT", "https://github.com/harfbuzz/harfbuzz", ("libharfbuzz",)),
    "HDF5": Native("BSD-3-Clause", "https://github.com/HDFGroup/hdf5", ("libhdf5", "libhdf5_hl")),
    "JSON for Modern C++": Native("MIT", "https://github.com/nlohmann/json", ("nlohmann-json",)),
    "json-c": Native("MIT", "https://github.com/json-c/json-c", ("libjson-c",)),
    "LERC": Native("Apache-2.0", "https://github.com/Esri/lerc", ("lerc", "libLerc")),
    "libaec": Native("BSD-2-Clause", "https://gitlab.dkrz.de/k202009/libaec", ("libaec", "libsz")),
    "libavif": Native("BSD-2-Clause", "https://github.com/AOMediaCodec/libavif", ("libavif",)),
    "libdeflate": Native("MIT", "https://github.com/ebiggers/libdeflate", ("libdeflate",)),
    "libgeotiff": Native("MIT", "https://github.com/OSGeo/libgeotiff", ("libgeotiff",)),
    "libgfortran": Native(
        "GPL-3.0-or-later WITH GCC-exception-3.1", "https://gcc.gnu.org", ("libgfortran", "GCC runtime library")
    ),
    "libiconv": Native("LGPL-2.1-or-later", "https://www.gnu.org/software/libiconv", ("libiconv",)),
    "libjpeg, libjpeg-turbo": Native(
        "IJG AND BSD-3-Clause", "https://github.com/libjpeg-turbo/libjpeg-turbo", ("libjpeg", "libjpeg-turbo")
    ),
    "libkml": Native("BSD-3-Clause", "https://github.com/libkml/libkml", ("libkml",)),
    "libpng": Native("libpng-2.0", "https://github.com/pnggroup/libpng", ("libpng", "libpng16")),
    "libquadmath": Native("LGPL-2.1-or-later", "https://gcc.gnu.org", ("libquadmath",)),
    "libraqm": Native("MIT", "https://github.com/HOST-Oman/libraqm"),
    "LibTIFF": Native("libtiff", "https://gitlab.com/libtiff/libtiff", ("tiff", "libtiff")),
    "libwebp": Native(
        "BSD-3-Clause",
        "https://github.com/webmproject/libwebp",
        ("libwebp", "libwebpdemux", "libwebpmux", "libsharpyuv"),
    ),
    "Little CMS": Native("MIT", "https://github.com/mm2/Little-CMS", ("liblcms2",)),
    "LLVM": Native("Apache-2.0 WITH LLVM-exception", "https://github.com/llvm/llvm-project", ("libllvmlite",)),
    "lz4": Native("BSD-2-Clause", "https://github.com/lz4/lz4"),
    "netCDF": Native("BSD-3-Clause", "https://github.com/Unidata/netcdf-c", ("libnetcdf",)),
    "nghttp2": Native("MIT", "https://github.com/nghttp2/nghttp2", ("libnghttp2",)),
    "OpenBLAS, LAPACK": Native(
        "BSD-3-Clause",
        "https://github.com/OpenMathLib/OpenBLAS",
        ("libscipy_openblas", "libscipy_openblas64_", "OpenBLAS", "LAPACK"),
    ),
    "OpenJPEG": Native("BSD-2-Clause", "https://github.com/uclouvain/openjpeg", ("libopenjp2",)),
    "OpenSSL": Native("Apache-2.0", "https://github.com/openssl/openssl", ("openssl", "libcrypto", "libssl")),
    "OpenTelemetry C++": Native(
        "Apache-2.0", "https://github.com/open-telemetry/opentelemetry-cpp", ("opentelemetry-cpp",)
    ),
    "PCRE2": Native("BSD-3-Clause", "https://github.com/PCRE2Project/pcre2", ("libpcre2-8",)),
    "PROJ": Native("MIT", "https://github.com/OSGeo/PROJ", ("proj", "libproj")),
    "Qhull": Native("Qhull", "https://github.com/qhull/qhull", ("qhull", "QHull")),
    "RapidJSON": Native("MIT", "https://github.com/Tencent/rapidjson", ("rapidjson",)),
    "re2": Native("BSD-3-Clause", "https://github.com/google/re2"),
    "SheenBidi": Native("Apache-2.0", "https://github.com/Tehreer/SheenBidi"),
    "Snappy": Native("BSD-3-Clause", "https://github.com/google/snappy", ("snappy",)),
    "SpatiaLite": Native(
        "MPL-1.1 OR GPL-2.0-or-later OR LGPL-2.1-or-later",
        "https://www.gaia-gis.it/fossil/libspatialite",
        ("libspatialite",),
    ),
    "SQLite": Native("public domain", "https://sqlite.org", ("sqlite3", "libsqlite3")),
    "UCX": Native("BSD-3-Clause", "https://github.com/openucx/ucx"),
    "XCB, Xau": Native("MIT", "https://gitlab.freedesktop.org/xorg/lib", ("libxcb", "libXau")),
    "XZ": Native("0BSD", "https://github.com/tukaani-project/xz", ("liblzma",)),
    "zlib": Native("Zlib", "https://github.com/madler/zlib"),
    "Zstandard": Native("BSD-3-Clause OR GPL-2.0-only", "https://github.com/facebook/zstd", ("zstd", "libzstd")),
}
"""Libraries in wheels, by their own names."""

_HEAD = """\
<!-- Written by `make docs`; do not edit. -->
# Notices

gablework is licensed under Apache-2.0. It installs the Python packages below, and they carry native libraries. The
wheel of gablework itself carries only the packages of the web page; the container image carries everything.

- Licence texts are in each wheel's `*.dist-info` folder, in the image below
  `/opt/gablework/lib/python3.11/site-packages`. The texts of the web page's packages are in
  `service/viewer/dist/third_party_licenses.md` of gablework's wheel. The image also has those of Python
  (`/usr/local/lib/python3.11/LICENSE.txt`) and of Debian's packages (`/usr/share/doc/*/copyright`).
- GEOS, libiconv, libquadmath and SpatiaLite may be used, changed and replaced under the LGPL. shapely and rasterio load
  GEOS as a library of its own (`shapely.libs`, `rasterio.libs`), which you may replace by another build. pyogrio has
  GEOS, libiconv and SpatiaLite inside `libgdal`, which you may replace as a whole. The text of the LGPL 2.1 is in
  shapely's `LICENSE_GEOS`; the source of each library is at the address below.
- The wheels of pyogrio and rasterio do not carry the text of each library inside them; GDAL's `LICENSE.TXT` has those
  of the code that is part of GDAL. The others are at the addresses below.
"""


@functools.cache
def locked() -> dict[str, tuple[str, ...]]:
    """The versions of each package in requirements.lock, which differ by version of Python."""
    found: dict[str, list[str]] = {}
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    for name, version in re.findall(r"^([a-z0-9][a-z0-9._-]*)==([^\s;\\]+)", text, re.MULTILINE):
        found.setdefault(name, []).append(version)
    return {name: tuple(versions) for name, versions in sorted(found.items())}


@functools.cache
def installed() -> dict[str, importlib.metadata.Distribution]:
    """The locked packages that are installed here; some are for other systems."""
    found = {}
    for name in locked():
        try:
            found[name] = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def licence_of(name: str) -> str:
    """The licence of a locked package, by its wheel; raises KeyError if it is neither installed nor known."""
    if name not in installed():
        return _NOT_HERE[name][0]
    facts = installed()[name].metadata
    stated = facts.get("License-Expression") or facts.get("License") or ""
    if not stated or len(stated) > _LONGEST or "\n" in stated or stated == "Dual License":
        classes = (line.split(" :: ")[-1] for line in facts.get_all("Classifier") or () if line.startswith("License"))
        return " OR ".join(sorted({_SPELLED.get(one, one) for one in classes}))
    return _SPELLED.get(stated, stated)


def source_of(name: str) -> str:
    """Where the source of a locked package is, by its wheel."""
    if name not in installed():
        return _NOT_HERE[name][1]
    facts = installed()[name].metadata
    links = [line.split(", ", 1) for line in facts.get_all("Project-URL") or ()]
    by_label = {label.lower(): link for label, link in links} | {"home-page": facts.get("Home-page") or ""}
    stated = (by_label[label] for label in (*_LINKS, "home-page") if by_label.get(label))
    return next(stated, _SOURCES.get(name, "not stated"))


@functools.cache
def native_of(name: str) -> tuple[str, ...]:
    """The native libraries of others in an installed wheel, as files or inside others, by the names that it uses."""
    wheel = installed()[name]
    files = [str(file) for file in wheel.files or ()]
    found = {match[1] for file in files if (match := _LIBRARY.search(file)) and not _MODULE.search(file)}
    found = {"libarrow" if one.startswith("libarrow") else one for one in found}
    for file in files:
        if file.endswith("vcpkg_abi_info.txt"):  # of a library that vcpkg built: what it was linked with
            ports = _PORT.findall(wheel.locate_file(file).read_text(encoding="utf-8"))
            found.update(port for port in ports if port not in _TOOLS)
        elif _TEXT.search(file) and "dist-info" in file:
            text = wheel.locate_file(file).read_text(encoding="utf-8")
            found.update(one or other for one, other in _LINKED.findall(text))
    return tuple(sorted(found))


def project_of(name: str) -> str:
    """The entry of `NATIVE` that a library's name in a wheel belongs to; raises KeyError if there is none."""
    for project, native in NATIVE.items():
        if name == project or name in native.names:
            return project
    raise KeyError(f"{name} is in a wheel and not in NATIVE of docs/notices.py: add its licence and source")


def texts_of(name: str) -> tuple[str, ...]:
    """The files of an installed wheel with licence texts."""
    files = [str(file) for file in installed()[name].files or ()]
    return tuple(sorted(file for file in files if _TEXT.search(file) and not file.endswith((".py", ".pyc"))))


def bill_of(name: str) -> tuple[str, ...]:
    """The files of an installed wheel that list what it was made from (CycloneDX)."""
    return tuple(sorted(str(file) for file in installed()[name].files or () if "/sboms/" in str(file)))


def of_page() -> dict[str, tuple[str, str]]:
    """Version and licence of the packages that the web page may bundle, by its lock."""
    lock = json.loads((ROOT / "service" / "viewer" / "package-lock.json").read_text(encoding="utf-8"))
    return {
        path.removeprefix("node_modules/"): (entry["version"], entry.get("license", "not stated"))
        for path, entry in lock["packages"].items()
        if path and not entry.get("dev")
    }


def render() -> str:
    """The file."""
    wheels = {name: natives for name in installed() if (natives := native_of(name))}
    lines = [_HEAD, "## Python packages", "", "| package | locked | licence | source |", "| --- | --- | --- | --- |"]
    lines += [f"| {n} | {', '.join(v)} | {licence_of(n)} | {source_of(n)} |" for n, v in locked().items()]
    lines += ["", "## Native libraries in wheels", "", "In those for Linux on x86-64 and Python 3.11.", ""]
    lines += ["| library | licence | source | in the wheels of |", "| --- | --- | --- | --- |"]
    for project, native in NATIVE.items():
        carriers = [name for name, natives in wheels.items() if project in map(project_of, natives)]
        if carriers:
            lines.append(f"| {project} | {native.licence} | {native.source} | {', '.join(carriers)} |")
    lines += ["", "Wheels of Rust and C code that list their parts and licences themselves:", ""]
    lines += [f"- {name}: {', '.join(f'`{file}`' for file in bill_of(name))}" for name in installed() if bill_of(name)]
    lines += ["", "## Packages of the web page", ""]
    lines += ["The bundle has those that its `third_party_licenses.md` lists; others of them work only in Node.", ""]
    lines += ["| package | locked | licence |", "| --- | --- | --- |"]
    lines += [f"| {name} | {version} | {licence} |" for name, (version, licence) in of_page().items()]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the file."""
    FILE.write_text(render(), encoding="utf-8")


if __name__ == "__main__":
    main()
