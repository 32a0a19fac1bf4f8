"""The CronJob and the systemd timer of a batch run, and the page about them and of the service's schedules."""

import configparser
import datetime as dt
import json
import re
import shlex
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from container_files import NO_RIGHTS

from pipeline import __version__
from pipeline.runtime.cluster.dispatch import SETTLE_S
from pipeline.schedule import Cron, Missed, Overlap
from service.schedules import OUTCOMES, Definition
from service.settings import ServiceSettings
from service.store.slot_book import MAX_KEPT
from service.wire.schedules import SchedulePatch, ScheduleRequest, ScheduleRun


@pytest.fixture(scope="module")
def cron_job(root: Path) -> dict[str, Any]:
    (found,) = yaml.safe_load_all((root / "docker" / "kubernetes" / "cronjob.yaml").read_text())
    return dict(found)


@pytest.fixture(scope="module")
def page(root: Path) -> str:
    return (root / "docs" / "how_to" / "schedules.md").read_text()


def unit(root: Path, name: str) -> configparser.ConfigParser:
    """A unit of systemd; its options are case-sensitive."""
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string((root / "docker" / "systemd" / name).read_text())
    return parser


def test_the_cron_job_is_what_kubernetes_understands(cron_job: dict[str, Any]) -> None:
    kubernetes_validate.validate(cron_job, kubernetes_validate.latest_version(), strict=True)
    wrong = cron_job | {"spec": {**cron_job["spec"], "schedules": "x"}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, kubernetes_validate.latest_version(), strict=True)


def test_the_cron_job_comes_every_day_and_never_twice_at_a_time(cron_job: dict[str, Any]) -> None:
    spec = cron_job["spec"]
    assert spec["concurrencyPolicy"] == "Forbid"
    assert 0 < spec["startingDeadlineSeconds"] < 86_400
    cron = Cron(spec["schedule"], spec["timeZone"])
    times = cron.next_times(dt.datetime(2026, 1, 1, tzinfo=dt.UTC), 365)
    # Kubernetes does not run a time that clocks leap over: its hour is there on each day of the year
    assert {f"{at:%H:%M}" for at in times} == {f"{cron.fields.split()[1]:>02}:{cron.fields.split()[0]:>02}"}
    assert len({at.date() for at in times}) == 365


def test_the_cron_jobs_pod_has_no_rights_and_keeps_the_run(cron_job: dict[str, Any]) -> None:
    pod = cron_job["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["image"] == f"gablework:{__version__}"
    assert container["args"][:2] == ["batch", "run"]
    assert pod["securityContext"]["runAsNonRoot"]
    assert container["securityContext"] == NO_RIGHTS
    assert {"requests", "limits"} == set(container["resources"])
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert set(mounts) == {volume["name"] for volume in pod["volumes"]}
    # what a read-only root file system still lets be written, and where the file is
    assert {"/state", "/tmp"} <= set(mounts.values())
    assert container["args"][2].startswith(mounts["file"])
    # a pod that ends is a new one, which goes on
    assert pod["restartPolicy"] == "Never"
    assert cron_job["spec"]["jobTemplate"]["spec"]["backoffLimit"] >= 1


def test_the_timer_starts_its_unit_also_after_the_machine_was_off(root: Path, page: str) -> None:
    timer, service = unit(root, "gablework-batch.timer"), unit(root, "gablework-batch.service")
    assert timer["Timer"]["Persistent"] == "true"
    assert timer["Install"]["WantedBy"] == "timers.target"
    found = re.fullmatch(r"\*-\*-\* (\d\d):(\d\d):00 (\S+)", timer["Timer"]["OnCalendar"])
    Cron(f"{int(found[2])} {int(found[1])} * * *", found[3])
    assert service["Service"]["Type"] == "oneshot"
    # a batch takes as long as it takes
    assert service["Service"]["TimeoutStartSec"] == "infinity"
    # and as long to stop as its tasks may take to end
    assert 60.0 * float(service["Service"]["TimeoutStopSec"].removesuffix("min")) >= SETTLE_S + 30.0
    assert "Install" not in service
    words = shlex.split(service["Service"]["ExecStart"])
    assert (Path(words[0]).name, words[1:3]) == ("gablework", ["batch", "run"])
    assert words[3].startswith(service["Service"]["ReadWritePaths"])
    block = re.search(r"```ini\n(.*?)```", page, re.DOTALL)
    shown = configparser.ConfigParser(interpolation=None)
    shown.optionxform = str  # type: ignore[assignment,method-assign]
    shown.read_string(block[1])
    assert dict(shown["Timer"]) == dict(timer["Timer"])


def test_the_page_lists_every_outcome_and_policy_with_the_defaults_of_the_code(page: str) -> None:
    row = r"^\| `(\w+)` \| (.*) \|$"
    fields, outcomes = page.split("| outcome | what it means |")
    rows = dict(re.findall(row, fields, re.MULTILINE))
    assert [name for name, _ in re.findall(row, outcomes, re.MULTILINE)] == list(OUTCOMES)
    assert rows["overlap"].startswith(f"`{Definition.overlap}` (default)")
    assert rows["missed"].startswith(f"`{Definition.missed}` (default)")
    assert rows["graceSeconds"].startswith(f"{Definition.grace_s:g} ")
    assert all(f"`{word}`" in page for word in (*Missed, *Overlap))
    assert f"The last {MAX_KEPT} runs" in page
    most = ServiceSettings.model_fields["max_schedules_per_key"].default
    assert f"`GABLEWORK_MAX_SCHEDULES_PER_KEY` ({most})" in page


def test_the_expressions_of_the_page_do_what_it_says(page: str) -> None:
    table = page.split("rules are those of Debian's cron:")[1].split("A nightly run therefore", maxsplit=1)[0]
    rows = re.findall(r"^\| `([^`]+)`[^|]* \| ([^|]+) \| ([^|]+) \|$", table, re.MULTILINE)

    def night(expression: str, day: int, month: int) -> list[str]:
        start = dt.datetime(2026, month, day - 1, 23, tzinfo=dt.UTC)
        times = Cron(expression, "Europe/Amsterdam").next_times(start, 20)
        inside = [at for at in times if (at.month, at.day) == (month, day) and at.hour in {2, 3}]
        return [f"{at:%H:%M}" for at in inside if at.hour == 2 or at.minute == 0]

    nights = {expression: (night(expression, 29, 3), night(expression, 25, 10)) for expression, _, _ in rows}
    assert nights == {
        "30 2 * * *": (["03:00"], ["02:30"]),
        "*/30 * * * *": (["03:00"], ["02:00", "02:30", "02:00", "02:30", "03:00"]),
        "*/30 2 * * *": ([], ["02:00", "02:30", "02:00", "02:30"]),
    }


def test_the_bodies_that_the_page_sends_are_those_that_the_service_reads(page: str) -> None:
    bodies = [json.loads(body) for body in re.findall(r"-d '(\{.*?\})'$", page, re.MULTILINE)]
    assert len(bodies) >= 3
    for body in bodies:
        assert set(body) <= set(SchedulePatch.model_fields)
        if "cron" in body:
            Cron(body["cron"], body.get("timeZone", "UTC"))


def test_the_models_of_schedules_agree_with_the_records() -> None:
    fields = ScheduleRequest.model_json_schema()["properties"]
    assert fields["missed"]["enum"] == list(Missed)
    assert fields["overlap"]["enum"] == list(Overlap)
    defaults = {name: fields[name]["default"] for name in ("missed", "graceSeconds", "overlap", "paused")}
    wanted = [Definition.missed, Definition.grace_s, Definition.overlap, Definition.is_paused]
    assert list(defaults.values()) == wanted
    assert ScheduleRun.model_json_schema()["properties"]["outcome"]["enum"] == list(OUTCOMES)
