"""TLS for a cluster's own traffic: the files, whether they can be used, and why a connection failed.

Everyone with a certificate of the CA can run code on the workers, and no one else can connect: Dask requires one from
both sides of every connection and ignores host names. So use one CA for one cluster and nothing else.

| where | names |
| --- | --- |
| options | `--tls-ca`, `--tls-cert`, `--tls-key` |
| environment | `GABLEWORK_TLS_CA`, `GABLEWORK_TLS_CERT`, `GABLEWORK_TLS_KEY` |
| Dask's own, if none of these is given | `distributed.comm.tls`, `DASK_DISTRIBUTED__COMM__TLS__…` |
"""

from __future__ import annotations

import dataclasses
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

from pipeline.errors import ClusterError, SettingsError

VARIABLES: Mapping[str, str] = {
    "ca": "GABLEWORK_TLS_CA",
    "cert": "GABLEWORK_TLS_CERT",
    "key": "GABLEWORK_TLS_KEY",
}
"""Environment variables by the field of `TlsFiles`."""
DASK_VARIABLES: Mapping[str, tuple[str, ...]] = {
    "ca": ("DASK_DISTRIBUTED__COMM__TLS__CA_FILE",),
    "cert": tuple(f"DASK_DISTRIBUTED__COMM__TLS__{role}__CERT" for role in ("SCHEDULER", "WORKER", "CLIENT")),
    "key": tuple(f"DASK_DISTRIBUTED__COMM__TLS__{role}__KEY" for role in ("SCHEDULER", "WORKER", "CLIENT")),
}
"""The same by Dask's own names, for its scheduler and its workers."""

_PROBE_S = 5.0
_HOW = (
    "give --tls-ca, --tls-cert and --tls-key (or GABLEWORK_TLS_CA, GABLEWORK_TLS_CERT and GABLEWORK_TLS_KEY); "
    "docs/how_to/clusters.md explains how to make them"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TlsFiles:
    """The TLS files of one process; all processes of a cluster may share them.

    Raises
    ------
    SettingsError
        A file is missing, cannot be read, or is not what it should be; all faults at once.
    """

    ca: str
    """Certificate of the CA that signed those of all processes, PEM."""
    cert: str
    """This process's certificate, PEM."""
    key: str = ""
    """Its private key, PEM, without a pass phrase; empty if the certificate's file contains it."""

    def __post_init__(self) -> None:
        """Check that the files can be used."""
        faults = [
            f"{VARIABLES[name].removeprefix('GABLEWORK_')} is {path}: {fault}"
            for name, path in dataclasses.asdict(self).items()
            if path and (fault := _unreadable(path))
        ]
        faults = faults or _unusable(self)
        if faults:
            raise SettingsError([f"{fault}; {_HOW}" for fault in faults])

    @property
    def security(self) -> dict[str, object]:
        """Keyword arguments of `distributed.Security`: only TLS, in every role."""
        roles = ("scheduler", "worker", "client")
        certs = {f"tls_{role}_cert": self.cert for role in roles}
        keys = {f"tls_{role}_key": self.key or self.cert for role in roles}
        return {"tls_ca_file": self.ca, "require_encryption": True, **certs, **keys}


def _unreadable(path: str) -> str:
    """Why a file cannot be read; empty if it can."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        return f"{error.strerror or error} (user {os.getuid()})"
    return "" if b"-----BEGIN " in content else "it is not a PEM file (no line -----BEGIN …)"


def _unusable(files: TlsFiles) -> list[str]:
    """Faults of readable files."""
    import ssl  # most runs use no TLS

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    key = files.key or files.cert
    faults = []
    if b"-----BEGIN CERTIFICATE-----" not in Path(files.cert).read_bytes():
        faults.append(f"TLS_CERT is {files.cert}: no certificate is in it")
    if b"PRIVATE KEY-----" not in Path(key).read_bytes():
        faults.append(f"TLS_KEY is {key}: no private key is in it")
    try:
        context.load_verify_locations(files.ca)
    except ssl.SSLError as error:
        faults.append(f"TLS_CA is {files.ca}: it holds no certificate of a CA ({error.reason or error})")
    if faults:
        return faults
    try:
        # OpenSSL would ask for a pass phrase on the terminal
        context.load_cert_chain(files.cert, key, password=_no_pass_phrase)
    except ssl.SSLError as error:
        reason = str(error.reason or error)
        mismatch = f"the key {key} is not that of the certificate"
        fault = mismatch if reason == "KEY_VALUES_MISMATCH" else f"it and the key {key} cannot be used: {reason}"
        faults.append(f"TLS_CERT is {files.cert}: {fault}")
    except SettingsError as error:
        faults.extend(error.faults)
    return faults


def _no_pass_phrase() -> str:
    raise SettingsError(["TLS_KEY has a pass phrase, which cannot be typed in a cluster: use a key without one"])


def given_tls(ca: str | None = None, cert: str | None = None, key: str | None = None) -> TlsFiles | None:
    """The files named by options or the environment, where a missing option is looked up; None if there are none.

    Raises SettingsError if a file is missing or cannot be used.
    """
    named = {
        name: given or os.environ.get(VARIABLES[name], "") for name, given in (("ca", ca), ("cert", cert), ("key", key))
    }
    if not any(named.values()):
        return None
    missing = [VARIABLES[name].removeprefix("GABLEWORK_") for name in ("ca", "cert") if not named[name]]
    if missing:
        have = ", ".join(f"{VARIABLES[name].removeprefix('GABLEWORK_')} {path}" for name, path in named.items() if path)
        raise SettingsError([f"{' and '.join(missing)} missing beside {have}: {_HOW}"])
    return TlsFiles(**named)


def check_address(address: str, tls: TlsFiles | None, *, configured: bool) -> None:
    """Refuse an address that does not match the files, before any connection.

    Raises ClusterError for `tls://` without files, or files for another protocol.
    """
    protocol = address.split("://", maxsplit=1)[0] if "://" in address else "tcp"
    if protocol == "tls" and tls is None and not configured:
        raise ClusterError(f"the scheduler {address} wants TLS and there are no certificates: {_HOW}")
    if protocol != "tls" and tls is not None:
        rest = address.rsplit("://", maxsplit=1)[-1]
        raise ClusterError(
            f"there are certificates ({tls.cert}) and the scheduler's address {address} is without TLS: "
            f"write tls://{rest}, or leave the certificates out"
        )


def explain_failure(address: str, tls: TlsFiles | None) -> str:
    """Probe the scheduler's port after a failed connection; returns the reason, or an empty text if unknown."""
    import ssl  # as above

    parts = urlsplit(address if "://" in address else f"tcp://{address}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        return ""
    if host is None or port is None:
        return ""
    wants_tls = parts.scheme == "tls"
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if tls is not None:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(tls.ca)
        context.load_cert_chain(tls.cert, tls.key or tls.cert)
    try:
        with socket.create_connection((host, port), timeout=_PROBE_S) as plain:
            try:
                with context.wrap_socket(plain, server_hostname=host) as wrapped:
                    if not wants_tls:
                        return f"it speaks TLS: write tls://{host}:{port} and {_HOW}"
                    # with TLS 1.3 the other side judges our certificate after the handshake
                    wrapped.recv(1)
            except ssl.SSLCertVerificationError as error:
                return f"its certificate is not accepted ({error.verify_message}): TLS_CA must be the CA that signed it"
            except ssl.SSLError as error:
                return _explain(str(error.reason or error), wants_tls=wants_tls, host=host, port=port)
    except OSError:
        return ""
    return ""


def _explain(reason: str, *, wants_tls: bool, host: str, port: int) -> str:
    """An OpenSSL reason in words."""
    if reason in {"WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "UNEXPECTED_EOF_WHILE_READING"}:
        without = (
            f"it does not speak TLS: write tcp://{host}:{port} without certificates, or start it with --tls-ca-file"
        )
        return without if wants_tls else ""
    if "CERTIFICATE_REQUIRED" in reason:
        return f"it wants a certificate of ours: {_HOW}"
    if "UNKNOWN_CA" in reason or "BAD_CERTIFICATE" in reason or "DECRYPT_ERROR" in reason:
        return f"it does not accept our certificate ({reason}): TLS_CERT must be signed by the CA of its --tls-ca-file"
    if "EXPIRED" in reason:
        return "it says that our certificate has expired: make a new one"
    return f"TLS failed ({reason})"
