"""Entry of the image: `ROLE [OPTIONS]` starts a role, anything else is a command of gablework.

| role | what it is |
| --- | --- |
| api | the REST service and the page; refuses to start without keys |
| driver | claims jobs and runs them on the scheduler's workers |
| scheduler | Dask's scheduler; anyone who reaches it can run code, so it is never published |
| worker | a Dask worker; ends its tasks before it stops |
| healthy | the health check of the role that runs in this container |

Options are handed on: `worker --scheduler tcp://scheduler:8786`. Needs the standard library only.
"""
# ruff: noqa: INP001 - a script, not a package

from __future__ import annotations

import dataclasses
import os
import socket
import sys
import tempfile
import urllib.request
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn
from urllib.parse import quote, urlsplit, urlunsplit


@dataclasses.dataclass(frozen=True)
class Role:
    """The role of a container."""

    command: tuple[str, ...]
    """Program and its first arguments."""
    path: str = ""
    """HTTP path that answers 200 while the role is alive, on the port `GABLEWORK_PORT`."""
    port_option: str = ""
    """Option that names the port on which the role listens; without one it is healthy while its process runs."""


ROLES: Mapping[str, Role] = {
    "api": Role(("gablework", "serve", "--no-driver"), path="/healthz"),
    "driver": Role(("gablework", "driver")),
    "scheduler": Role(("dask", "scheduler", "--dashboard-address", "127.0.0.1:8787"), port_option="--port"),
    "worker": Role(("gablework", "worker")),
}


def command_of(arguments: Sequence[str]) -> tuple[str, ...]:
    """The command to run.

    >>> command_of(["worker", "--scheduler", "tcp://scheduler:8786"])
    ('gablework', 'worker', '--scheduler', 'tcp://scheduler:8786')
    >>> command_of(["keys", "create", "--help"])
    ('gablework', 'keys', 'create', '--help')
    """
    if arguments and arguments[0] in ROLES:
        return (*ROLES[arguments[0]].command, *arguments[1:])
    return ("gablework", *arguments)


def with_password(url: str, password: str) -> str:
    """A database's URL with the password that lies in a file, not in the environment.

    >>> with_password("postgresql+pg8000://gablework@postgres/gablework", "p@ss/word")
    'postgresql+pg8000://gablework:p%40ss%2Fword@postgres/gablework'
    """
    parts = urlsplit(url)
    user, at, host = parts.netloc.rpartition("@")
    if not at or ":" in user:
        sys.exit("GABLEWORK_DATABASE_PASSWORD_FILE needs a GABLEWORK_DATABASE_URL with a user and no password")
    return urlunsplit(parts._replace(netloc=f"{user}:{quote(password, safe='')}@{host}"))


DASK_TLS: Mapping[str, tuple[str, ...]] = {
    "GABLEWORK_TLS_CA": ("CA_FILE",),
    "GABLEWORK_TLS_CERT": ("SCHEDULER__CERT", "WORKER__CERT", "CLIENT__CERT"),
    "GABLEWORK_TLS_KEY": ("SCHEDULER__KEY", "WORKER__KEY", "CLIENT__KEY"),
}
"""The names of the cluster's certificates in Dask's own scheduler."""


def dask_tls_of(given: Mapping[str, str]) -> dict[str, str]:
    """Translate our names of the certificates into Dask's, which then uses TLS only; all roles use the same variables.

    >>> dask_tls_of({"GABLEWORK_TLS_CA": "/run/secrets/ca"})
    {'DASK_DISTRIBUTED__COMM__TLS__CA_FILE': '/run/secrets/ca', 'DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION': 'True'}
    >>> dask_tls_of({})
    {}
    """
    named = {
        f"DASK_DISTRIBUTED__COMM__TLS__{theirs}": given[ours]
        for ours, names in DASK_TLS.items()
        for theirs in names
        if given.get(ours)
    }
    return {**named, "DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "True"} if named else {}


def environment_of(given: Mapping[str, str]) -> dict[str, str]:
    """The environment of the role: the password is read from its file, certificates are passed to Dask."""
    wanted = {**dask_tls_of(given), **given}
    secret = wanted.pop("GABLEWORK_DATABASE_PASSWORD_FILE", "")
    if secret:
        try:
            password = Path(secret).read_text(encoding="utf-8").strip()
        except OSError as error:
            sys.exit(f"GABLEWORK_DATABASE_PASSWORD_FILE={secret}: {error.strerror}; user {os.getuid()} must read it")
        wanted["GABLEWORK_DATABASE_URL"] = with_password(wanted.get("GABLEWORK_DATABASE_URL", ""), password)
    return wanted


def role_file() -> Path:
    """Where a container notes its role for its health check."""
    return Path(tempfile.gettempdir(), "gablework-role")


def fault_of(arguments: Sequence[str], given: Mapping[str, str]) -> str:
    """Why the role that was started with these arguments is not healthy; empty if it is."""
    role = ROLES[arguments[0]]
    try:
        if role.path:
            with urllib.request.urlopen(f"http://127.0.0.1:{given['GABLEWORK_PORT']}{role.path}", timeout=4):
                return ""
        if role.port_option in arguments:
            port = int(arguments[arguments.index(role.port_option) + 1])
            with socket.create_connection(("127.0.0.1", port), timeout=4):
                return ""
    except OSError as error:
        return f"{arguments[0]}: {error}"
    return ""


def main(arguments: Sequence[str]) -> NoReturn:
    """Become the role, or end with the result of the health check."""
    if list(arguments) == ["healthy"]:
        sys.exit(fault_of(role_file().read_text(encoding="utf-8").split("\n"), os.environ) or None)
    role = ROLES.get(arguments[0]) if arguments else None
    if role is not None:
        role_file().write_text("\n".join(arguments), encoding="utf-8")
    command = command_of(arguments)
    # no child: signals reach the role itself
    os.execvpe(command[0], command, environment_of(os.environ))  # noqa: S606


if __name__ == "__main__":
    main(sys.argv[1:])
