"""Reads a Dockerfile and a compose file far enough to hold them against the sources and to run what they start."""

import dataclasses
import fnmatch
import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

Compose = Mapping[str, Any]

NO_RIGHTS = {
    "allowPrivilegeEscalation": False,
    "readOnlyRootFilesystem": True,
    "capabilities": {"drop": ["ALL"]},
}
"""The security context of each container in Kubernetes."""


@dataclasses.dataclass(frozen=True)
class Instruction:
    """One instruction of a Dockerfile."""

    name: str
    """COPY, RUN and the like."""
    text: str
    """What follows, lines joined."""

    @property
    def words(self) -> list[str]:
        """The words of the exec form or of a plain list, without options."""
        if self.text.startswith("["):
            return [str(word) for word in json.loads(self.text)]
        return [word for word in shlex.split(self.text) if not word.startswith("--")]

    @property
    def options(self) -> dict[str, str]:
        """`--name=value`."""
        return dict(re.findall(r"--([a-z-]+)=(\S+)", self.text))


@dataclasses.dataclass(frozen=True)
class Stage:
    """From one FROM to the next."""

    base: str
    """The image that it starts from, arguments filled in."""
    name: str
    """After AS; empty for the last."""
    instructions: tuple[Instruction, ...]

    def all(self, name: str) -> list[Instruction]:
        """All instructions of one name."""
        return [one for one in self.instructions if one.name == name]

    def only(self, name: str) -> Instruction:
        """The one instruction of a name."""
        (one,) = self.all(name)
        return one

    @property
    def environment(self) -> dict[str, str]:
        """All of ENV."""
        return dict(word.split("=", 1) for one in self.all("ENV") for word in one.words)


@dataclasses.dataclass(frozen=True)
class Image:
    """A Dockerfile."""

    stages: tuple[Stage, ...]

    @property
    def last(self) -> Stage:
        """What runs."""
        return self.stages[-1]

    def stage(self, name: str) -> Stage:
        """A stage by its name."""
        return next(stage for stage in self.stages if stage.name == name)

    def start(self, command: list[str] | None = None) -> list[str]:
        """What the container runs: the entry point and the given or the default command."""
        return [*self.last.only("ENTRYPOINT").words, *(command or self.last.only("CMD").words)]


def read_image(path: Path) -> Image:
    """Read a Dockerfile without heredocs."""
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    arguments: dict[str, str] = {}
    stages: list[tuple[str, str, list[Instruction]]] = []
    for line in filter(None, map(str.strip, joined.splitlines())):
        name, text = line.split(None, 1)
        if name == "FROM":
            base, *rest = re.sub(r"\$\{(\w+)\}", lambda match: arguments[match[1]], text).split()
            stages.append((base, rest[1] if rest else "", []))
        elif stages:
            stages[-1][2].append(Instruction(name, text))
        else:
            arguments.update([text.split("=", 1)])
    return Image(tuple(Stage(base, name, tuple(found)) for base, name, found in stages))


def read_compose(path: Path) -> Compose:
    """Read a compose file; merge keys are resolved."""
    loaded: Compose = yaml.safe_load(path.read_text())
    return loaded


def laid_over(base: Compose, other: Compose) -> dict[str, Any]:
    """One compose file on top of another: mappings unite, lists grow, but a command takes the place of the other."""
    united = dict(base)
    for name, value in other.items():
        below = united.get(name)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            united[name] = laid_over(below, value)
        elif isinstance(value, list) and isinstance(below, list) and name != "command":
            united[name] = [*below, *(entry for entry in value if entry not in below)]
        else:
            united[name] = value
    return united


def sent_to_the_builder(path: str, rules: str) -> bool:
    """Whether a file of the context passes .dockerignore: the last rule that matches it or a folder above decides."""
    sent = True
    for rule in filter(None, (line.strip() for line in rules.splitlines())):
        if rule.startswith("#"):
            continue
        pattern = rule.removeprefix("!")
        parts = path.split("/")
        above = ["/".join(parts[:length]) for length in range(1, len(parts) + 1)]
        if any(fnmatch.fnmatchcase(folder, pattern) for folder in above) or (
            pattern.startswith("**/") and any(fnmatch.fnmatchcase(part, pattern[3:]) for part in parts)
        ):
            sent = rule.startswith("!")
    return sent
