"""The manifests, held against Kubernetes' own schemas, against the operator's fields, the sources and each other."""

import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import typer
import yaml
from command_line import app
from container_files import NO_RIGHTS, Image

from pipeline import __version__
from pipeline.runtime.cluster.dispatch import SETTLE_S
from pipeline.runtime.cluster.tls import VARIABLES
from service.settings import ServiceSettings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import kubernetes_validate

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docker" / "kubernetes"
PAGE = (ROOT / "docs" / "how_to" / "kubernetes.md").read_text()
SINGLE = {"batch.yaml", "cronjob.yaml", "first_key.yaml"}
"""Applied by hand, one run each."""
ROLES = {"api": ("serve", "--no-driver"), "driver": ("driver",), "worker": ("worker",)}
SECRETS = {"gablework-tls", "gablework-postgres", "gablework-s3"}


def closed(**properties: object) -> dict[str, object]:
    """The schema of an object that has these members and no other."""
    return {"type": "object", "additionalProperties": False, "required": list(properties), "properties": properties}


OBJECT = {"type": "object"}
COUNT = {"type": "integer", "minimum": 0}
CLUSTER = closed(worker=closed(replicas=COUNT, spec=OBJECT), scheduler=closed(spec=OBJECT, service=OBJECT))
"""The fields of a DaskCluster's spec, as the operator reads them; its pods and its service are Kubernetes' own."""
AUTOSCALER = closed(cluster={"type": "string"}, minimum=COUNT, maximum={"type": "integer", "minimum": 1})

Document = Mapping[str, Any]


def documents() -> list[tuple[str, Document]]:
    """All manifests, with their files."""
    files = {path.name: yaml.safe_load_all(path.read_text()) for path in sorted(FOLDER.glob("*.yaml"))}
    return [(name, document) for name, held in files.items() for document in held]


DOCUMENTS = documents()
IDS = [f"{name}: {document['kind']} {document.get('metadata', {}).get('name', '')}" for name, document in DOCUMENTS]


def of_kind(kind: str) -> list[Document]:
    return [document for _, document in DOCUMENTS if document["kind"] == kind]


def pod_specs() -> Iterator[tuple[str, Document]]:
    """The specs of all pods, by what makes them."""
    for _, document in DOCUMENTS:
        name, spec = document.get("metadata", {}).get("name", ""), document.get("spec", {})
        if document["kind"] == "DaskCluster":
            yield "worker", spec["worker"]["spec"]
            yield "scheduler", spec["scheduler"]["spec"]
        elif document["kind"] == "CronJob":
            yield name, spec["jobTemplate"]["spec"]["template"]["spec"]
        elif "template" in spec:
            yield name, spec["template"]["spec"]


PODS = list(pod_specs())
CONTAINERS = [(name, container) for name, spec in PODS for container in spec["containers"]]
OURS = [(name, one) for name, one in CONTAINERS if one["image"].startswith("gablework")]


def variables(container: Document) -> dict[str, str]:
    """What a container's environment holds."""
    maps = {one["metadata"]["name"]: one["data"] for one in of_kind("ConfigMap")}
    found: dict[str, str] = {}
    for source in container.get("envFrom", []):
        found |= maps[source["configMapRef"]["name"]]
    return found | {entry["name"]: entry["value"] for entry in container.get("env", [])}


def validate(document: Document) -> None:
    kubernetes_validate.validate(document, kubernetes_validate.latest_version(), strict=True)


@pytest.mark.parametrize(("name", "document"), DOCUMENTS, ids=IDS)
def test_a_manifest_keeps_the_schema_of_its_kind(name: str, document: Document) -> None:
    kind = document["kind"]
    if kind == "Kustomization":
        listed = set(document["resources"])
        assert listed == {path.name for path in FOLDER.glob("*.yaml")} - SINGLE - {"kustomization.yaml"}
        return
    assert document["metadata"].get("namespace", "gablework") == "gablework"
    if kind == "DaskAutoscaler":
        jsonschema.validate(document["spec"], AUTOSCALER)
    elif kind == "DaskCluster":
        spec = document["spec"]
        jsonschema.validate(spec, CLUSTER)
        meta = {"metadata": {"name": "one"}}
        for part in ("worker", "scheduler"):
            validate({"apiVersion": "v1", "kind": "Pod", **meta, "spec": spec[part]["spec"]})
        validate({"apiVersion": "v1", "kind": "Service", **meta, "spec": spec["scheduler"]["service"]})
    else:
        validate(document)


def test_the_validator_finds_a_misspelt_field() -> None:
    (job,) = (one for name, one in DOCUMENTS if name == "batch.yaml")
    with pytest.raises(kubernetes_validate.ValidationError):
        validate({**job, "spec": {**job["spec"], "backOffLimit": 5}})


def test_all_that_the_issue_names_is_there() -> None:
    made = {(document["kind"], document.get("metadata", {}).get("name", "")) for _, document in DOCUMENTS}
    wanted = {
        *(("DaskCluster", "gablework"), ("DaskAutoscaler", "gablework"), ("Deployment", "api"), ("Service", "api")),
        *(("Deployment", "driver"), ("StatefulSet", "postgres"), ("Job", "gablework-batch"), ("Job", "first-key")),
        *(("PersistentVolumeClaim", "gablework-state"), ("Namespace", "gablework")),
    }
    assert wanted <= made
    (state,) = of_kind("PersistentVolumeClaim")
    assert state["spec"]["accessModes"] == ["ReadWriteMany"]


def test_images_are_those_of_the_sources_and_of_the_compose_file(compose: Document) -> None:
    images = {container["image"] for _, container in CONTAINERS}
    assert images == {f"gablework:{__version__}", compose["services"]["postgres"]["image"]}
    (named,) = of_kind("Kustomization")[0]["images"]
    assert (named["name"], named["newTag"]) == ("gablework", __version__)


@pytest.mark.parametrize(("name", "container"), OURS, ids=[name for name, _ in OURS])
def test_a_container_runs_a_command_that_exists_with_options_that_exist(name: str, container: Document) -> None:
    role, *options = container["args"]
    if role == "scheduler":
        assert all(word.split("=")[0] in {"--host", "--port", "--dashboard-address"} for word in options)
        return
    command, *before = ROLES.get(role, (role,))
    commands: Any = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    if command == "keys":
        assert {mount["mountPath"] for mount in container["volumeMounts"]} >= {"/state", "/run/secrets/postgres"}
    if command not in commands and command == "batch":
        pytest.skip("the command batch is not there yet")
    found = commands[command]
    if hasattr(found, "commands"):
        command, *options = options
        found = found.commands[command]
    assert found.make_context(command, [*before, *options], resilient_parsing=False).command.name == command


@pytest.mark.parametrize(("name", "spec"), PODS, ids=[name for name, _ in PODS])
def test_a_pod_has_no_rights_and_no_more_than_it_needs(name: str, spec: Document, image: Image) -> None:
    user = 999 if name == "postgres" else int(image.last.only("USER").text.split(":")[0])
    given = spec["securityContext"]
    assert (given["runAsNonRoot"], given["runAsUser"], given["fsGroup"]) == (True, user, user)
    assert given["seccompProfile"] == {"type": "RuntimeDefault"}
    assert spec["automountServiceAccountToken"] is False
    # Kubernetes would put variables such as GABLEWORK_SCHEDULER_PORT into every container
    assert spec["enableServiceLinks"] is False
    assert spec["terminationGracePeriodSeconds"] >= 30
    for container in spec["containers"]:
        assert container["securityContext"] == NO_RIGHTS
        assert {"cpu", "memory"} <= set(container["resources"]["requests"])
        assert "memory" in container["resources"]["limits"]
        mounted = {mount["name"] for mount in container["volumeMounts"]}
        assert mounted - {"database"} == {volume["name"] for volume in spec["volumes"]}


@pytest.mark.parametrize(("name", "container"), OURS, ids=[name for name, _ in OURS])
def test_the_variables_of_a_container_are_settings_and_files_that_it_has(name: str, container: Document) -> None:
    given = variables(container)
    known = {f"GABLEWORK_{setting.upper()}" for setting in ServiceSettings.model_fields} | set(VARIABLES.values())
    assert {v for v in given if v.startswith("GABLEWORK_")} - known <= {"GABLEWORK_DATABASE_PASSWORD_FILE"}
    folders = tuple(mount["mountPath"] for mount in container["volumeMounts"])
    files = [value for value in given.values() if value.startswith("/run/secrets/")]
    # the nightly batch has workers of its own and says all in its file
    assert files or "/etc/gablework" in folders
    assert [path for path in files if not path.startswith(folders)] in ([], ["/run/secrets/s3/credentials"])
    if files and name in {"worker", "driver", "gablework-batch"}:
        assert "/run/secrets/s3" in folders
    assert not any(re.search(r"://[^/@]*:[^/@]*@", value) for value in given.values())


def test_every_secret_is_made_by_a_command_of_the_page() -> None:
    used = {
        volume["secret"]["secretName"] for _, spec in PODS for volume in spec.get("volumes", []) if "secret" in volume
    }
    assert used == SECRETS
    made = dict(re.findall(r"kubectl .*create secret generic (\S+) (.*)", PAGE))
    assert set(made) == SECRETS
    keys = {name: set(re.findall(r"--from-file=(?:(\S+?)=)?", words)) for name, words in made.items()}
    assert "--from-file=ca.pem" in made["gablework-tls"]
    assert all(f"--from-file={file}" in made["gablework-tls"] for file in ("cluster.pem", "cluster.key"))
    assert keys["gablework-postgres"] == {"password"}
    assert keys["gablework-s3"] == {"credentials"}


def test_a_pod_has_as_long_to_stop_as_it_may_take() -> None:
    (service,) = (one["data"] for one in of_kind("ConfigMap") if one["metadata"]["name"] == "gablework-service")
    assert "GABLEWORK_DRAIN_S" not in service  # so the default is what counts
    settings, pods = ServiceSettings.model_fields, dict(PODS)
    grace_s = {name: spec["terminationGracePeriodSeconds"] for name, spec in PODS}
    assert settings["drain_s"].default + 30.0 <= grace_s["driver"] <= settings["drain_s"].default + 60.0
    assert grace_s["worker"] >= settings["building_timeout_s"].default + 30.0
    batches = [spec["terminationGracePeriodSeconds"] for name, spec in PODS if name == "gablework-batch"]
    assert len(batches) == 2
    assert min(batches) >= SETTLE_S + 30.0
    rows = dict(re.findall(r"^\| (\w+) \| (\d+)", PAGE.split("## Ending")[1], re.MULTILINE))
    named = {row: "gablework-batch" if row == "batch" else row for row in rows}
    assert set(rows) == {"worker", "driver", "api", "batch", "postgres"}
    assert {row: float(seconds) for row, seconds in rows.items()} == {row: grace_s[named[row]] for row in rows}
    hooks = {name: container["lifecycle"] for name, container in CONTAINERS if "lifecycle" in container}
    assert set(hooks) == {"api", "postgres"}
    assert float(hooks["api"]["preStop"]["exec"]["command"][1]) < pods["api"]["terminationGracePeriodSeconds"]


def test_a_worker_and_its_building_fit_into_the_container() -> None:
    (worker,) = (container for name, container in CONTAINERS if name == "worker")
    (service,) = (one["data"] for one in of_kind("ConfigMap") if one["metadata"]["name"] == "gablework-service")
    (limit,) = (word.split("=")[1] for word in worker["args"] if word.startswith("--memory-limit="))
    building = int(service["GABLEWORK_BUILDING_MEMORY_BYTES"])
    gib = 2**30
    whole = int(worker["resources"]["limits"]["memory"].removesuffix("Gi")) * gib
    assert int(limit.removesuffix("GiB")) * gib + building <= whole
    assert worker["resources"]["requests"]["memory"] == worker["resources"]["limits"]["memory"]


def test_all_name_the_scheduler_of_the_operator_over_tls() -> None:
    (cluster,) = of_kind("DaskCluster")
    name = f"{cluster['metadata']['name']}-scheduler.{cluster['metadata']['namespace']}.svc"
    address = f"tls://{name}:8786"
    (data,) = (one["data"] for one in of_kind("ConfigMap") if one["metadata"]["name"] == "gablework-cluster")
    (worker,) = (container for name, container in CONTAINERS if name == "worker")
    assert data["GABLEWORK_SCHEDULER"] == address
    assert f"--scheduler={address}" in worker["args"]
    assert of_kind("DaskAutoscaler")[0]["spec"]["cluster"] == cluster["metadata"]["name"]
    ports = {port["name"]: port["port"] for port in cluster["spec"]["scheduler"]["service"]["ports"]}
    # the operator looks for them by these names
    assert ports == {"tcp-comm": 8786, "http-dashboard": 8787}
    (scheduler,) = (container for name, container in CONTAINERS if name == "scheduler")
    routes = yaml.safe_load(variables(scheduler)["DASK_DISTRIBUTED__SCHEDULER__HTTP__ROUTES"])
    assert "distributed.http.scheduler.api" in routes


def test_the_scheduler_is_reached_from_inside_only() -> None:
    policies = {one["metadata"]["name"]: one["spec"] for one in of_kind("NetworkPolicy")}
    assert policies["deny-all"] == {"podSelector": {}, "policyTypes": ["Ingress"]}
    labels = {"dask.org/cluster-name": "gablework", "dask.org/component": "scheduler"}
    (scheduler,) = (one for one in policies.values() if one["podSelector"].get("matchLabels") == labels)
    by_port = {rule["ports"][0]["port"]: rule["from"] for rule in scheduler["ingress"]}
    assert set(by_port) == {8786, 8787}
    assert not any("namespaceSelector" in source or "ipBlock" in source for source in by_port[8786])
    assert by_port[8787] == [{"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "dask-operator"}}}]
    # all others of these ports are those of services inside
    assert all(one["spec"].get("type", "ClusterIP") == "ClusterIP" for one in of_kind("Service"))


def test_every_service_finds_its_pods() -> None:
    specs = [document.get("spec", {}) for _, document in DOCUMENTS]
    labels = [spec["template"]["metadata"]["labels"] for spec in specs if "template" in spec]
    for service in of_kind("Service"):
        assert service["spec"]["selector"] in labels
    for one in (*of_kind("Deployment"), *of_kind("StatefulSet")):
        assert one["spec"]["selector"]["matchLabels"].items() <= one["spec"]["template"]["metadata"]["labels"].items()
