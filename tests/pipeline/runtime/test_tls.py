"""Certificates: unusable files are refused with name and fix, before any connection."""

import asyncio
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import trustme
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from pipeline.errors import ClusterError, SettingsError
from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.tls import VARIABLES, TlsFiles, check_address, explain_failure, given_tls
from pipeline.runtime.cluster.worker import WorkerOptions, _start


class Authority:
    """A CA of one test, and certificates that it signed."""

    def __init__(self, folder: Path, name: str) -> None:
        self._ca = trustme.CA(organization_name=name)
        self.folder = folder / name
        self.folder.mkdir()
        self.ca = str(self.folder / "ca.pem")
        self._ca.cert_pem.write_to_path(self.ca)

    def files(self, name: str = "one") -> TlsFiles:
        """A certificate and its key."""
        issued = self._ca.issue_cert(f"{name}.gablework")
        cert, key = self.folder / f"{name}.pem", self.folder / f"{name}.key"
        issued.cert_chain_pems[0].write_to_path(str(cert))
        issued.private_key_pem.write_to_path(str(key))
        return TlsFiles(ca=self.ca, cert=str(cert), key=str(key))


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    """The cluster's."""
    return Authority(tmp_path, "ours")


@pytest.fixture(autouse=True)
def nothing_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment of the tests names no certificates."""
    for name in VARIABLES.values():
        monkeypatch.delenv(name, raising=False)


# --- files -----------------------------------------------------------------------------------------------------------


def test_dask_gets_usable_files_for_every_role(authority: Authority) -> None:
    files = authority.files()
    security = files.security
    assert security["require_encryption"] is True
    assert {security[f"tls_{role}_cert"] for role in ("scheduler", "worker", "client")} == {files.cert}
    assert {security[f"tls_{role}_key"] for role in ("scheduler", "worker", "client")} == {files.key}


def test_a_key_may_lie_in_the_file_of_its_certificate(authority: Authority, tmp_path: Path) -> None:
    files = authority.files()
    both = tmp_path / "both.pem"
    both.write_text(Path(files.cert).read_text() + Path(files.key).read_text())
    assert TlsFiles(ca=files.ca, cert=str(both)).security["tls_worker_key"] == str(both)


def test_all_missing_files_are_reported_at_once(authority: Authority) -> None:
    with pytest.raises(SettingsError) as refused:
        TlsFiles(ca="/nowhere/ca.pem", cert="/nowhere/one.pem", key=authority.files().key)
    faults = [fault.split(":")[0] for fault in refused.value.faults]
    assert faults == ["TLS_CA is /nowhere/ca.pem", "TLS_CERT is /nowhere/one.pem"]
    assert all("No such file" in fault and "--tls-ca" in fault for fault in refused.value.faults)


def test_files_with_other_content_are_refused(authority: Authority, tmp_path: Path) -> None:
    files, other = authority.files(), authority.files("two")
    text = tmp_path / "notes.txt"
    text.write_text("no certificate")
    locked = tmp_path / "locked.pem"
    key = load_pem_private_key(Path(files.key).read_bytes(), None)
    locked.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret")))
    for given, words in (
        ({"ca": str(text), "cert": files.cert, "key": files.key}, "TLS_CA is .*not a PEM file"),
        ({"ca": files.key, "cert": files.cert, "key": files.key}, "TLS_CA is .*no certificate of a CA"),
        ({"ca": files.ca, "cert": files.cert, "key": other.key}, "TLS_CERT is .*is not that of the certificate"),
        ({"ca": files.ca, "cert": files.cert, "key": ""}, "TLS_KEY is .*one.pem: no private key"),
        ({"ca": files.ca, "cert": files.key, "key": files.key}, "TLS_CERT is .*one.key: no certificate"),
        ({"ca": files.ca, "cert": files.cert, "key": str(locked)}, "TLS_KEY has a pass phrase"),
        ({"ca": files.ca, "cert": files.cert, "key": str(tmp_path)}, "TLS_KEY is .*directory"),
    ):
        with pytest.raises(SettingsError, match=words):
            TlsFiles(**given)


def test_options_stand_before_the_environment_and_half_of_them_is_refused(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert given_tls() is None
    files, other = authority.files(), authority.files("two")
    with pytest.raises(SettingsError, match=r"TLS_CA missing beside TLS_CERT .*one\.pem"):
        given_tls(cert=files.cert, key=files.key)
    for name, path in (("ca", files.ca), ("cert", files.cert), ("key", files.key)):
        monkeypatch.setenv(VARIABLES[name], path)
    assert given_tls() == files
    assert given_tls(cert=other.cert, key=other.key) == other
    assert Cluster(scheduler="tls://host:8786").tls == files


# --- addresses -------------------------------------------------------------------------------------------------------


def test_an_address_that_does_not_go_with_the_certificates_is_refused_with_the_fix(authority: Authority) -> None:
    files = authority.files()
    check_address("tls://host:8786", files, configured=False)
    check_address("tls://host:8786", None, configured=True)
    check_address("tcp://host:8786", None, configured=True)
    with pytest.raises(ClusterError, match=r"wants TLS and there are no certificates: give --tls-ca"):
        check_address("tls://host:8786", None, configured=False)
    for address in ("tcp://host:8786", "host:8786"):
        with pytest.raises(ClusterError, match=r"write tls://host:8786, or leave the certificates out"):
            check_address(address, files, configured=False)


class Door:
    """Listens on the loopback: speaks TLS with some files, or something else."""

    def __init__(self, files: TlsFiles | None, *, asks: bool = True) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._context: ssl.SSLContext | None = None
        if files is not None:
            self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            self._context.load_cert_chain(files.cert, files.key)
            self._context.load_verify_locations(files.ca)
            self._context.verify_mode = ssl.CERT_REQUIRED if asks else ssl.CERT_NONE
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def _answer(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                try:
                    if self._context is None:
                        connection.sendall(b"hello, here is no TLS")
                        connection.recv(2**16)
                    else:
                        with self._context.wrap_socket(connection, server_side=True) as wrapped:
                            wrapped.sendall(b"hello")
                except OSError:
                    continue

    def close(self) -> None:
        """Accept no more connections."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()


@pytest.fixture
def doors() -> Iterator[list[Door]]:
    """Closed at the end."""
    opened: list[Door] = []
    yield opened
    for door in opened:
        door.close()


def test_a_probe_of_the_port_explains_a_failed_connection(
    authority: Authority, tmp_path: Path, doors: list[Door]
) -> None:
    ours, theirs = authority.files(), Authority(tmp_path, "theirs").files()
    doors += [Door(ours), Door(None)]
    secure, plain = (f"127.0.0.1:{door.port}" for door in doors)
    assert f"it speaks TLS: write tls://{secure} and give --tls-ca" in explain_failure(f"tcp://{secure}", None)
    assert f"does not speak TLS: write tcp://{plain}" in explain_failure(f"tls://{plain}", ours)
    assert "its certificate is not accepted" in explain_failure(f"tls://{secure}", theirs)
    mixed = TlsFiles(ca=ours.ca, cert=theirs.cert, key=theirs.key)
    assert "it does not accept our certificate" in explain_failure(f"tls://{secure}", mixed)
    assert "it wants a certificate of ours" in explain_failure(f"tls://{secure}", None)
    # no reason: everything is fine, or no one listens
    assert explain_failure(f"tls://{secure}", ours) == explain_failure(f"tcp://{plain}", None) == ""
    assert explain_failure("tls://127.0.0.1:9", ours) == explain_failure("inproc://somewhere", None) == ""


class Unwilling:
    """A nanny that does not start, in Dask's own words for a scheduler that speaks before TLS does."""

    def __await__(self) -> Iterator[None]:
        raise ValueError("IOStream is not idle; cannot convert to SSL")
        yield


def test_a_worker_goes_on_looking_where_the_port_explains_why_it_did_not_start(
    authority: Authority, doors: list[Door]
) -> None:
    doors.append(Door(None))
    files = authority.files()
    plain = WorkerOptions(scheduler=f"tls://127.0.0.1:{doors[0].port}", tls=files)
    with pytest.raises(ConnectionError, match="does not speak TLS: write tcp://"):
        asyncio.run(_start(Unwilling(), plain))
    unreachable = WorkerOptions(scheduler="tls://127.0.0.1:9", tls=files)
    with pytest.raises(ClusterError, match="does not start: IOStream is not idle"):
        asyncio.run(_start(Unwilling(), unreachable))
