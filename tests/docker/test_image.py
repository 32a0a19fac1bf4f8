"""The Dockerfile, the compose file and the entry point, held against the sources and against each other."""

import importlib.util
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import ModuleType

import pytest
import typer
from command_line import app
from container_files import Compose, Image, read_compose, sent_to_the_builder
from moto.server import ThreadedMotoServer
from processes import program

from pipeline import __version__
from pipeline.runtime.cluster.tls import DASK_VARIABLES, VARIABLES
from service.settings import ServiceSettings

OURS = ("api", "driver", "scheduler", "worker")


@pytest.fixture(scope="module")
def entrypoint(root: Path) -> ModuleType:
    """docker/entrypoint.py as a module."""
    spec = importlib.util.spec_from_file_location("image_entrypoint", root / "docker" / "entrypoint.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_hadolint_finds_nothing(root: Path) -> None:
    command = [program("hadolint"), "--failure-threshold", "style", root / "docker" / "Dockerfile"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, "")


@pytest.mark.parametrize("name", ["compose.yaml", "compose.tls.yaml", "compose.s3.yaml"])
def test_the_compose_file_keeps_the_schema(root: Path, name: str) -> None:
    command = [program("check-jsonschema"), "--builtin-schema", "vendor.compose-spec", root / "docker" / name]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr


def test_everything_that_is_copied_exists_and_is_sent_to_the_builder(image: Image, root: Path) -> None:
    rules = (root / ".dockerignore").read_text()
    copies = [one for stage in image.stages for one in stage.all("COPY") if "from" not in one.options]
    sources = [source for one in copies for source in one.words[:-1]]
    assert len(sources) >= 9
    assert [source for source in sources if not (root / source).exists()] == []
    assert [source for source in sources if not sent_to_the_builder(source, rules)] == []


def test_nothing_else_is_sent_to_the_builder(root: Path) -> None:
    rules = (root / ".dockerignore").read_text()
    private = [".git", ".venv", "tests", "docs", "docker/secrets/postgres_password", "requirements-test.lock", ".env"]
    private += ["service/viewer/node_modules", "service/viewer/dist/index.html", "pipeline/__pycache__/model.pyc"]
    private += ["pipeline/compiled/kernels.json"]
    assert [path for path in private if sent_to_the_builder(path, rules)] == []


def test_what_one_stage_copies_from_another_is_made_there(image: Image) -> None:
    folders = {"page": "/viewer/dist", "environment": "/opt/gablework"}
    copies = [one for stage in image.stages for one in stage.all("COPY") if "from" in one.options]
    assert {one.options["from"]: one.words[0] for one in copies} == folders
    assert image.stage("page").only("WORKDIR").text == "/viewer"
    assert all(folders["environment"] in one.text for one in image.stage("environment").all("RUN")[:1])


def test_the_base_images_are_pinned_to_a_version_and_a_distribution(image: Image, compose: Compose) -> None:
    bases = [stage.base for stage in image.stages] + [compose["services"]["postgres"]["image"]]
    assert all(re.fullmatch(r"\w+:\d[\d.]*(-slim)?-bookworm(-slim)?", base) for base in bases), bases
    # the environment is made with the interpreter that runs it
    assert image.stage("environment").base == image.last.base


def test_no_image_is_whatever_is_newest(composed_files: Compose) -> None:
    images = {service["image"] for service in composed_files["services"].values()}
    assert all(re.fullmatch(r"[\w/]+:\d[\w.-]*", image) for image in images), images


def test_libraries_are_installed_by_hash(image: Image) -> None:
    (install, *_) = image.stage("environment").all("RUN")
    assert install.text.count("--require-hashes") == len(re.findall(r"pip install", install.text)) == 2
    for one in image.stage("environment").all("RUN")[1:]:
        assert "pip install" not in one.text or "--no-index" in one.text


def test_the_image_runs_as_a_user_without_rights(image: Image, composed_files: Compose) -> None:
    user = image.last.only("USER").text
    assert re.fullmatch(r"[1-9]\d{4}:[1-9]\d{4}", user)
    assert f"--uid {user.split(':')[0]}" in image.last.only("RUN").text
    names = [one.name for one in image.last.instructions]
    assert "RUN" not in names[names.index("USER") :]
    for name, service in composed_files["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert "privileged" not in service, name
        assert "cap_add" not in service, name
        assert service["deploy"]["resources"]["limits"]["memory"], name


def test_only_the_api_is_published_and_only_on_this_machine(composed_files: Compose) -> None:
    published = {name: service["ports"] for name, service in composed_files["services"].items() if "ports" in service}
    assert published == {"api": ["127.0.0.1:8000:8000"]}
    assert composed_files["networks"]["inside"] == {"internal": True}
    for name in composed_files["services"].keys() - {"api", "driver"}:
        assert composed_files["services"][name]["networks"] == ["inside"], name


def test_no_secret_is_in_the_environment(image: Image, composed_files: Compose) -> None:
    given = {name: dict(service.get("environment", {})) for name, service in composed_files["services"].items()}
    given["image"] = dict(image.last.environment)
    for name, variables in given.items():
        for variable, value in variables.items():
            if any(word in variable for word in ("PASSWORD", "SECRET", "KEY", "CREDENTIALS", "CERT", "TLS")):
                assert value.startswith("/run/secrets/"), f"{name} {variable}"
            assert not re.search(r"://[^/@]*:[^/@]*@", value), f"{name} {variable}"
    # each service that reads a secret has it, and no other
    for name, service in composed_files["services"].items():
        words = [*given[name].values(), *service.get("command", [])]
        read = {Path(word.rpartition("=")[2]).name for word in words if "/run/secrets/" in word}
        assert read == set(service.get("secrets", [])), name
    used = {secret for service in composed_files["services"].values() for secret in service.get("secrets", [])}
    assert used == set(composed_files["secrets"])


def test_every_service_of_ours_is_a_role(compose: Compose, entrypoint: ModuleType) -> None:
    assert tuple(entrypoint.ROLES) == OURS
    roles = {name: service["command"][0] for name, service in compose["services"].items() if name != "postgres"}
    assert roles == {role: role for role in OURS}


def test_the_default_command_is_a_role(image: Image, entrypoint: ModuleType) -> None:
    assert image.last.only("CMD").words[0] in entrypoint.ROLES


def test_every_role_is_a_command_that_exists_with_options_that_exist(
    composed_files: Compose, entrypoint: ModuleType
) -> None:
    commands = dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    for role in ("api", "driver", "worker"):
        _, command, *options = entrypoint.command_of(composed_files["services"][role]["command"])
        context = commands[command].make_context(command, list(options), resilient_parsing=False)
        assert context.command.name == command
    help_text = subprocess.run([program("dask"), "scheduler", "--help"], capture_output=True, text=True, check=True)
    words = entrypoint.command_of(composed_files["services"]["scheduler"]["command"])
    assert words[:2] == ("dask", "scheduler")
    assert [word for word in words if word.startswith("--") and f"{word} " not in help_text.stdout] == []


def test_every_variable_is_a_setting(image: Image, composed_files: Compose) -> None:
    known = {f"GABLEWORK_{name.upper()}" for name in ServiceSettings.model_fields}
    known |= {"GABLEWORK_KERNELS", "GABLEWORK_DATABASE_PASSWORD_FILE", *VARIABLES.values()}
    given = set(image.last.environment)
    for role in OURS:
        given |= set(composed_files["services"][role].get("environment", {}))
    assert {name for name in given if name.startswith("GABLEWORK_")} - known == set()


def test_a_role_has_as_long_to_stop_as_it_may_take(composed_files: Compose) -> None:
    services = composed_files["services"]
    assert "GABLEWORK_DRAIN_S" not in services["driver"]["environment"]  # so the default is what counts
    settings = ServiceSettings.model_fields
    grace_s = {role: float(services[role]["stop_grace_period"].removesuffix("s")) for role in ("driver", "worker")}
    assert settings["drain_s"].default + 30.0 <= grace_s["driver"] <= settings["drain_s"].default + 60.0
    assert grace_s["worker"] >= settings["building_timeout_s"].default + 30.0


def test_a_worker_and_its_building_fit_into_the_container(composed_files: Compose) -> None:
    services = composed_files["services"]
    limit = services["worker"]["deploy"]["resources"]["limits"]["memory"]
    command = services["worker"]["command"]
    worker = command[command.index("--memory-limit") + 1]
    building = int(services["driver"]["environment"]["GABLEWORK_BUILDING_MEMORY_BYTES"])
    assert int(worker.removesuffix("GiB")) * 2**30 + building <= int(limit.removesuffix("g")) * 2**30


def test_build_and_run_agree_on_where_and_for_what_kernels_are_compiled(image: Image) -> None:
    build, run = image.stage("environment").environment, image.last.environment
    (line,) = [one.text for one in image.stage("environment").all("RUN") if "warm-up" in one.text]
    assert f"warm-up all --into {run['GABLEWORK_KERNELS']}" in line
    assert run["NUMBA_CACHE_DIR"] != run["GABLEWORK_KERNELS"]
    assert "NUMBA_CPU_NAME" not in {*build, *run}
    assert build["OPENBLAS_NUM_THREADS"] == run["OPENBLAS_NUM_THREADS"] == "1"


def test_the_image_has_the_version_of_the_sources(image: Image, compose: Compose) -> None:
    versions = [one.text.split("=")[1] for one in image.last.all("ARG") if one.text.startswith("VERSION=")]
    assert versions == [__version__]
    assert {compose["services"][role]["image"] for role in OURS} == {f"gablework:{__version__}"}


def test_signals_reach_the_role(image: Image) -> None:
    assert image.last.only("ENTRYPOINT").text.startswith('["tini", "--",')
    assert image.last.only("STOPSIGNAL").text == "SIGTERM"
    assert "tini=" in image.last.only("RUN").text


def test_a_password_goes_from_its_file_into_the_url(entrypoint: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "password").write_text("a:b@c/d\n")
    given = {
        "GABLEWORK_DATABASE_URL": "postgresql+pg8000://me@db:5432/jobs",
        "GABLEWORK_DATABASE_PASSWORD_FILE": str(tmp_path / "password"),
    }
    url = "postgresql+pg8000://me:a%3Ab%40c%2Fd@db:5432/jobs"
    assert entrypoint.environment_of(given) == {"GABLEWORK_DATABASE_URL": url}
    with pytest.raises(SystemExit, match="user and no password"):
        entrypoint.environment_of({**given, "GABLEWORK_DATABASE_URL": "sqlite:///jobs.db"})
    with pytest.raises(SystemExit, match="No such file"):
        entrypoint.environment_of({**given, "GABLEWORK_DATABASE_PASSWORD_FILE": str(tmp_path / "none")})


def test_certificates_are_passed_to_dask_in_its_own_variables(entrypoint: ModuleType) -> None:
    given = {VARIABLES[name]: f"/run/secrets/{name}" for name in VARIABLES}
    environment = entrypoint.environment_of(given)
    for name, theirs in DASK_VARIABLES.items():
        assert {environment[variable] for variable in theirs} == {f"/run/secrets/{name}"}
    assert environment["DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION"] == "True"
    own = {"DASK_DISTRIBUTED__COMM__TLS__CA_FILE": "/mine"}
    assert entrypoint.environment_of({**given, **own})["DASK_DISTRIBUTED__COMM__TLS__CA_FILE"] == "/mine"


def test_address_and_certificates_go_together(composed_files: Compose) -> None:
    services = composed_files["services"]
    worker = services["worker"]["command"]
    secure = "GABLEWORK_TLS_CA" in services["scheduler"].get("environment", {})
    expected = f"{'tls' if secure else 'tcp'}://scheduler:8786"
    assert worker[worker.index("--scheduler") + 1] == expected
    assert services["driver"]["environment"]["GABLEWORK_SCHEDULER"] == expected
    for role in ("driver", "worker"):
        assert ("GABLEWORK_TLS_CA" in services[role].get("environment", {})) == secure


def test_storage_is_found_by_the_variables_of_the_compose_file(root: Path, tmp_path: Path) -> None:
    (given,) = {
        tuple(sorted(read_compose(root / "docker" / "compose.s3.yaml")["services"][role]["environment"].items()))
        for role in ("driver", "worker")
    }
    credentials = tmp_path / "s3_credentials"
    credentials.write_text("[default]\naws_access_key_id = gablework\naws_secret_access_key = secret\n")
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        _, port = server.get_host_and_port()
        here = {"http://s3:8333": f"http://127.0.0.1:{port}", "/run/secrets/s3_credentials": str(credentials)}
        env = {name: here.get(value, value) for name, value in given}
        code = "import s3fs; fs = s3fs.S3FileSystem(); fs.mkdir('one'); fs.pipe('one/a', b'x'); print(fs.cat('one/a'))"
        command, env = [sys.executable, "-c", code], {**env, "HOME": str(tmp_path)}
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        assert done.stdout.strip() == "b'x'", done.stderr
    finally:
        server.stop()


def test_the_wheel_of_the_image_holds_all_modules_and_the_page(image: Image, root: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    stage = image.stage("environment")
    for one in stage.all("COPY"):
        if "from" in one.options or one.words[-1] not in {"./", "pipeline", "service"}:
            continue
        for name in one.words[:-1]:
            if (root / name).is_dir():
                ignored = shutil.ignore_patterns("__pycache__", "node_modules", "viewer", "compiled")
                shutil.copytree(root / name, source / name, ignore=ignored)
            else:
                shutil.copy2(root / name, source / name)
    page = source / "service" / "viewer" / "dist" / "assets"
    page.mkdir(parents=True)
    (page.parent / "index.html").write_text("<!doctype html>")
    (page / "page.js").write_text("")
    (build,) = [one.text for one in stage.all("RUN") if "hatchling build" in one.text]
    words = build.split(" && ")[0].split()
    command = [sys.executable, *words[1 : words.index("--directory") + 1], str(tmp_path / "wheel")]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (wheel,) = (tmp_path / "wheel").glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    paths = [path for folder in ("pipeline", "service") for path in (source / folder).rglob("*")]
    wanted = {path.relative_to(source).as_posix() for path in paths if path.is_file()}
    assert len(wanted) > 100
    assert wanted - held == set()
    licences = {name.partition(".dist-info/licenses/")[2] for name in held}
    assert {"LICENSE", "THIRD_PARTY_NOTICES.md"} <= licences
