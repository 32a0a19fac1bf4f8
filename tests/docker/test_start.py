"""What the image starts, taken from its own files, run as plain processes on the loopback, without any rights.

Only names that a container alone has are replaced: folders, host names and ports. The processes run as the image's
user; where that one cannot enter the folders of this environment they run as this user, without capabilities.
"""

import dataclasses
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import httpx
import pytest
import trustme
from container_files import Compose, Image, laid_over, read_compose
from processes import LONG_S, PostgresServer, Program, Programs, as_user, free_port, missing, program, wait_for

from pipeline.compiler.store import folder_of_kernels
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.cluster.tls import explain_failure

pytestmark = pytest.mark.slow

ROLES = ("scheduler", "worker", "driver", "api")


@dataclasses.dataclass(frozen=True)
class Host:
    """Stands in for the container engine: a user, and what the container's names are on this machine."""

    user: int | None
    """Whom processes run as; None for this user."""
    before: tuple[str, ...]
    """What takes rights away from a command that follows it."""
    folder: Path
    """Below it is all that is written."""
    names: Mapping[str, str]
    """Names in the container, and what they are here."""

    def here(self, text: str) -> str:
        """A word of the container's, on this machine."""
        for name, ours in self.names.items():
            text = text.replace(name, ours)
        return text

    def environment(self, *given: Mapping[str, str], home: Path) -> dict[str, str]:
        """What a container's process sees, and no variable of this test."""
        variables = {name: self.here(value) for some in given for name, value in some.items()}
        variables["PATH"] = variables["PATH"].replace("$PATH", os.environ["PATH"])
        return {**variables, "HOME": str(home), "TMPDIR": str(home)}

    def own_folder(self, name: str) -> Path:
        """A folder that the container's user owns."""
        path = self.folder / name
        path.mkdir(exist_ok=True)
        if self.user is not None:
            os.chown(path, self.user, self.user)
        return path

    def run(self, command: Sequence[str], env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
        """Run a command to its end."""
        place = {"env": env, "cwd": self.folder, "timeout": 1800, **as_user(self.user)}
        return subprocess.run([*self.before, *command], capture_output=True, text=True, check=False, **place)


def able(host: Host) -> bool:
    """Whether gablework can be run."""
    try:
        return host.run([sys.executable, "-c", "import pipeline"], {}).returncode == 0
    except PermissionError:
        return False


@pytest.fixture(scope="module")
def host(image: Image, open_folder: Path, root: Path, postgres_server: PostgresServer) -> Host:
    """The image's user, its folders below a temporary one, free ports, PostgreSQL."""
    user = int(image.last.only("USER").text.split(":")[0]) if os.geteuid() == 0 else None
    database = postgres_server.create_database().rpartition("/")[2]
    names = {
        "/opt/gablework/entrypoint.py": str(root / "docker" / "entrypoint.py"),
        "/opt/gablework/bin": str(Path(sys.executable).parent),
        "/opt/gablework/kernels": str(open_folder / "kernels"),
        "/run/secrets": str(open_folder),
        "/tmp/kernels": "kernels",
        "/state": str(open_folder / "state"),
        "@postgres/gablework": f"@127.0.0.1:{postgres_server.port}/{database}",
        "//scheduler:": "//127.0.0.1:",
        "0.0.0.0": "127.0.0.1",
        "8786": str(free_port()),
        "8000": str(free_port()),
    }
    some = Host(user, (), open_folder, names)
    if user is not None and not able(some):
        no_rights = ("setpriv", "--bounding-set=-all", "--inh-caps=-all", "--no-new-privs", "--")
        some = Host(None, (str(program("setpriv")), *no_rights[1:]), open_folder, names)
        if not able(some):
            missing("this environment cannot be used without the rights of root")
    (open_folder / "postgres_password").write_text(f"{postgres_server.password}\n")
    (open_folder / "postgres_password").chmod(0o444)
    some.own_folder("state")
    return some


@pytest.fixture(scope="module")
def kernels(host: Host, image: Image) -> Path:
    """The kernels as the image's build leaves them, then made read-only."""
    stage = image.stage("environment")
    (line,) = [one.text for one in stage.all("RUN") if "warm-up" in one.text]
    command = shlex.split(host.here(line.split(" && ")[-1]))
    env = {"PATH": os.environ["PATH"], **stage.environment}
    folder = host.own_folder("kernels")
    # those of this checkout are copied: to compile all takes minutes
    build = host.environment(env, home=host.own_folder("build"))
    made = host.run(command, {**build, "NUMBA_CACHE_DIR": str(folder_of_kernels())})
    assert made.returncode == 0, made.stderr
    assert len(list(folder.rglob("*.kernel"))) > 100
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    return folder


def start_words(host: Host, image: Image, command: list[str]) -> list[str]:
    """What the container runs. tini only hands signals on and reaps; it is left out where it is not installed."""
    words = [host.here(word) for word in image.start(command)]
    return words if shutil.which(words[0]) else words[words.index("--") + 1 :]


@dataclasses.dataclass
class Composed:
    """The services of the compose file, as processes."""

    host: Host
    image: Image
    compose: Compose
    programs: Programs

    def environment(self, service: str, home: Path) -> dict[str, str]:
        """The image's variables under those of the service; numba's folder is the container's own."""
        given = self.compose["services"][service].get("environment", {})
        env = self.host.environment(self.image.last.environment, given, home=home)
        return {**env, "NUMBA_CACHE_DIR": str(home / env["NUMBA_CACHE_DIR"])}

    def start(self, service: str, name: str, **more: str) -> Program:
        """Start a service."""
        home = self.host.own_folder(name)
        command = start_words(self.host, self.image, self.compose["services"][service]["command"])
        env = {**self.environment(service, home), **more}
        command = [*self.host.before, *command]
        return self.programs.start(name, command, env=env, cwd=self.host.folder, user=self.host.user, inherit=False)

    def run(self, service: str, arguments: list[str]) -> subprocess.CompletedProcess[str]:
        """`docker compose run --rm SERVICE ARGUMENTS`."""
        home = self.host.own_folder("once")
        return self.host.run(start_words(self.host, self.image, arguments), self.environment(service, home))

    def healthy(self, service: str, name: str) -> bool:
        """What the image's health check says of a running container."""
        words = self.image.last.only("HEALTHCHECK").text.split("CMD ", 1)[1]
        command = [self.host.here(word.strip('" ')) for word in words.strip("[]").split(",")]
        return self.host.run(command, self.environment(service, self.host.folder / name)).returncode == 0


@pytest.fixture
def composed(host: Host, image: Image, compose: Compose, programs: Programs, kernels: Path) -> Iterator[Composed]:
    """Starts services of the compose file."""
    assert kernels.is_dir()
    return Composed(host, image, compose, programs)


@pytest.fixture
def composed_tls(host: Host, image: Image, compose: Compose, root: Path, programs: Programs, kernels: Path) -> Composed:
    """Starts services of the compose file with the one for TLS over it; the secrets lie where they name them."""
    assert kernels.is_dir()
    over = read_compose(root / "docker" / "compose.tls.yaml")
    authority = trustme.CA(organization_name="gablework cluster")
    issued = authority.issue_cert("gablework.cluster")
    authority.cert_pem.write_to_path(str(host.folder / "cluster_ca"))
    issued.cert_chain_pems[0].write_to_path(str(host.folder / "cluster_cert"))
    issued.private_key_pem.write_to_path(str(host.folder / "cluster_key"))
    for name in over["secrets"]:
        (host.folder / name).chmod(0o444)
    return Composed(host, image, laid_over(compose, over), programs)


def documented(root: Path, pattern: str) -> list[str]:
    """The words after `docker compose run --rm api` of a documented command."""
    text = (root / "docs" / "how_to" / "docker.md").read_text()
    (line,) = re.findall(rf"^\$ docker compose .*run --rm api ({pattern}.*)$", text, re.MULTILINE)
    return shlex.split(line)


def new_key(composed: Composed, root: Path) -> str:
    """A key, made as the page says."""
    made = composed.run("api", documented(root, "keys create"))
    assert made.returncode == 0, made.stderr
    (key,) = re.findall(r"gw_[A-Za-z0-9_-]{43}", made.stdout)
    return str(key)


def send(address: str, key: str, tile: Path, driver: Program) -> list[str]:
    """Reconstruct a tile by the service; the statuses of its buildings."""
    with httpx.Client(base_url=address, headers={"Authorization": f"Bearer {key}"}, timeout=60.0) as client:
        with tile.open("rb") as stream:
            answer = client.post("/jobs", files={"tile": (tile.name, stream)})
        assert answer.status_code == 201, answer.text
        job_url = answer.headers["location"]

        def over() -> dict[str, Any] | None:
            job: dict[str, Any] = client.get(job_url).json()
            return job if job["status"] in {"successful", "failed", "dismissed"} else None

        status = driver.wait_for(over, "the end of the job", 3 * LONG_S)
        assert status["status"] == "successful", status
        page = client.get(f"{job_url}/buildings").json()
        return [feature["properties"]["status"] for feature in page["features"]]


def test_the_documented_way_leads_from_nothing_to_models(composed: Composed, root: Path, tmp_path: Path) -> None:
    # without keys the API refuses the image's default: to listen on all addresses
    refused = composed.start("api", "api-without-keys", GABLEWORK_HOST="0.0.0.0")
    assert refused.ended() != 0
    assert "gablework keys create" in refused.text

    key = new_key(composed, root)
    running = {name: composed.start(name, name) for name in ("scheduler", "driver", "api")}
    running |= {name: composed.start("worker", name) for name in ("worker-1", "worker-2")}
    address = f"http://{composed.host.here('0.0.0.0:8000')}"
    running["api"].wait_for(lambda: composed.healthy("api", "api"), "good health")
    running["scheduler"].wait_for(lambda: composed.healthy("scheduler", "scheduler"), "good health")

    tile = simulate("suburb", tmp_path / "scene", 3, size_m=(70.0, 70.0), density_per_m2=4.0).laz
    assert httpx.get(f"{address}/jobs").status_code == 401
    statuses = send(address, key, tile, running["driver"])
    assert len(statuses) >= 3
    assert set(statuses) <= {"ok", "doubtful", "fallback"}

    # compiled at build, used by all
    for name in ("driver", "worker-1", "worker-2"):
        here = {path.name for path in (composed.host.folder / name / "kernels").rglob("*.kernel")}
        assert here == set(), f"{name} compiled {sorted(here)}"

    for name, health in (("api", "api"), ("driver", "driver"), ("scheduler", "scheduler"), ("worker", "worker-1")):
        assert composed.healthy(name, health), name
    for name in ("api", "driver", "worker-1", "worker-2", "scheduler"):
        one = running[name]
        code = one.stop()
        # Dask's scheduler ends by the signal that it was sent
        assert code in ({0} if name != "scheduler" else {0, -signal.SIGTERM, 128 + signal.SIGTERM}), f"{name}: {code}"
        wait_for(lambda one=one: not one.children(), f"the end of all processes of {name}")
    assert not composed.healthy("api", "api")
    assert not composed.healthy("scheduler", "scheduler")


def test_the_same_services_work_over_tls(composed_tls: Composed, root: Path, tmp_path: Path) -> None:
    key = new_key(composed_tls, root)
    names = ("scheduler", "driver", "api", "worker")
    running = {name: composed_tls.start(name, f"{name}-tls") for name in names}
    port = int(composed_tls.host.here("8786"))
    running["worker"].wait_for_text(f"is at the scheduler tls://127.0.0.1:{port}")
    for name in ("api", "scheduler"):
        running[name].wait_for(lambda name=name: composed_tls.healthy(name, f"{name}-tls"), "good health")
    explained = explain_failure(f"tcp://127.0.0.1:{port}", None)
    assert "it speaks TLS" in explained
    assert "it wants a certificate of ours" in explain_failure(f"tls://127.0.0.1:{port}", None)

    tile = simulate("gable", tmp_path / "scene").laz
    statuses = send(f"http://{composed_tls.host.here('0.0.0.0:8000')}", key, tile, running["driver"])
    assert statuses == ["ok"]
    for name in ("api", "driver", "worker"):
        assert running[name].stop() == 0, name
