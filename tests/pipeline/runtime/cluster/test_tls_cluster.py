"""A scheduler and workers with TLS: the same content as without, and no one else can connect."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import chores
import pytest
from checkout import ROOT
from distributed import Client
from processes import Programs, free_port, missing

from pipeline.errors import ClusterError
from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.cluster.tls import VARIABLES, TlsFiles
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.monitoring.progress import Watch

pytestmark = pytest.mark.slow

PAGE = ROOT / "docs" / "how_to" / "clusters.md"
SETTINGS = {"tile_size_m": 40.0}


def run_documented(folder: Path) -> None:
    """Run the commands of the page that make certificates."""
    lines = re.findall(r"^\$ ((?:openssl|printf) .*)$", PAGE.read_text(), re.MULTILINE)
    assert len(lines) == 4
    subprocess.run(["sh", "-e", "-c", "\n".join(lines)], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> TlsFiles:
    """What the documented commands make."""
    if shutil.which("openssl") is None:
        missing("the program openssl is not installed")
    folder = tmp_path_factory.mktemp("certificates")
    run_documented(folder)
    verify = ["openssl", "verify", "-x509_strict", "-CAfile", "ca.pem", "cluster.pem"]
    checked = subprocess.run(verify, cwd=folder, check=False)
    assert checked.returncode == 0, "newer Pythons check certificates strictly"
    names = {name: str(folder / f"{file}") for name, file in (("ca", "ca.pem"), ("cert", "cluster.pem"))}
    return TlsFiles(**names, key=str(folder / "cluster.key"))


def options(files: TlsFiles) -> list[str]:
    """Options of our commands."""
    return ["--tls-ca", files.ca, "--tls-cert", files.cert, "--tls-key", files.key]


def start_scheduler(programs: Programs, files: TlsFiles | None, port: int) -> str:
    """`dask scheduler`, with certificates or without; its address."""
    tls = [] if files is None else ["--tls-ca-file", files.ca, "--tls-cert", files.cert, "--tls-key", files.key]
    programs.start_scheduler(port, *tls)
    return f"{'tcp' if files is None else 'tls'}://127.0.0.1:{port}"


def variables(files: TlsFiles) -> dict[str, str]:
    """Ours, by which all commands know the certificates."""
    return {VARIABLES["ca"]: files.ca, VARIABLES["cert"]: files.cert, VARIABLES["key"]: files.key}


def reconstruct(tile: Path, out: Path, *more: str, env: Mapping[str, str] | None = None) -> tuple[int, str]:
    """`gablework reconstruct`: its exit code and what it said."""
    settings = out.parent / "settings.toml"
    settings.write_text("[settings]\n" + "".join(f"{name} = {value}\n" for name, value in SETTINGS.items()))
    command = [sys.executable, "-m", "service.cli", "reconstruct", str(tile), "--out", str(out), *more]
    command += ["--settings", str(settings), "--json"]
    environment = {**os.environ, **(env or {})}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_a_run_over_tls_gives_the_same_content_and_only_those_with_a_certificate_get_in(
    programs: Programs, files: TlsFiles, tile: Path, digest: str, tmp_path: Path
) -> None:
    port = free_port()
    address = start_scheduler(programs, files, port)
    given = {"by-option": (options(files), {}), "by-environment": ([], variables(files))}
    for name, (words, env) in given.items():
        command = [sys.executable, "-m", "service.cli", "worker", "--scheduler", address, "--name", name, *words]
        programs.start(name, command, env=env).wait_for_text(f"is at the scheduler {address}")

    code, output = reconstruct(tile, tmp_path / "run", "--scheduler", address, *options(files))
    assert code == 0, output
    manifest = read_manifest(tmp_path / "run")
    assert manifest.content_sha256 == digest

    # Dask's own way to say it
    own = {"CA_FILE": files.ca, "CLIENT__CERT": files.cert, "CLIENT__KEY": files.key}
    own = {f"DASK_DISTRIBUTED__COMM__TLS__{name}": path for name, path in own.items()}
    code, output = reconstruct(tile, tmp_path / "dask", "--scheduler", address, env=own)
    assert code == 0, output
    assert read_manifest(tmp_path / "dask").content_sha256 == digest

    # every connection is encrypted, those between workers too
    with Client(address, security=Cluster(scheduler=address, tls=files).security) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"]
        assert len(workers) == 2
        assert all(one.startswith("tls://") and worker["nanny"].startswith("tls://") for one, worker in workers.items())

    for words, fault in (
        (["--scheduler", address], "wants TLS and there are no certificates: give --tls-ca"),
        (["--scheduler", f"tcp://127.0.0.1:{port}"], f"it speaks TLS: write tls://127.0.0.1:{port}"),
        (["--scheduler", f"tcp://127.0.0.1:{port}", *options(files)], f"write tls://127.0.0.1:{port}"),
    ):
        code, output = reconstruct(tile, tmp_path / "refused", *words)
        assert (code, fault in output) == (4, True), output
    # a client that comes with the certificate of another CA, and one with none
    other = tmp_path / "other"
    other.mkdir()
    for name in ("ca.pem", "ca.key"):
        shutil.copy(Path(files.ca).with_name(name), other)
    run_documented(other)
    stranger = TlsFiles(ca=files.ca, cert=str(other / "cluster.pem"), key=str(other / "cluster.key"))
    with (
        pytest.raises(ClusterError, match="does not accept our certificate"),
        Cluster(scheduler=address, tls=stranger).executor(),
    ):
        pytest.fail("it connected")


def test_a_tls_worker_says_what_is_wrong_with_a_scheduler_without_tls(programs: Programs, files: TlsFiles) -> None:
    port = free_port()
    start_scheduler(programs, None, port)
    command = [sys.executable, "-m", "service.cli", "worker", "--scheduler", f"tls://127.0.0.1:{port}"]
    worker = programs.start("worker", [*command, *options(files), "--give-up-after", "0"])
    assert worker.ended() == 4
    assert f"it does not speak TLS: write tcp://127.0.0.1:{port}" in worker.text


def test_an_embedded_cluster_speaks_tls_where_certificates_are_given(
    files: TlsFiles, tile: Path, digest: str, tmp_path: Path
) -> None:
    with Cluster(workers=2, tls=files) as cluster:
        assert cluster.address.startswith("tls://")
        with cluster.executor() as executor:
            executor.prepare("double", Watch())
            assert [m.result for m in executor.map("double", chores.double, [4], Watch())] == [8]
            workers = executor._client.scheduler_info(n_workers=-1)["workers"]
            assert all(address.startswith("tls://") for address in workers)
        with (
            pytest.raises(ClusterError, match="it speaks TLS"),
            Cluster(scheduler=cluster.address.replace("tls://", "tcp://")).executor(),
        ):
            pytest.fail("it connected")
    code, output = reconstruct(tile, tmp_path / "run", "--workers", "2", env=variables(files))
    assert code == 0, output
    assert read_manifest(tmp_path / "run").content_sha256 == digest
