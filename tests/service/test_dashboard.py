"""The dashboard for Grafana: its queries name metrics and labels that the service has."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

DASHBOARD = Path(__file__).resolve().parents[2] / "docker" / "grafana" / "gablework.json"
_FUNCTIONS = {"sum", "by", "rate", "max", "min", "histogram_quantile"}
_NAME = re.compile(r"[a-z_]+")


def queries() -> list[str]:
    panels = json.loads(DASHBOARD.read_text(encoding="utf-8"))["panels"]
    return [target["expr"] for panel in panels for target in panel["targets"]]


def names_in(query: str) -> tuple[set[str], set[str]]:
    """Metrics and labels of a query."""
    labels = set(re.findall(r"([a-z_]+)(?:=|!=|=~|!~)\"", query))
    for listed in re.findall(r"by \(([^)]*)\)", query):
        labels |= {name.strip() for name in listed.split(",")}
    plain = re.sub(r"\"[^\"]*\"|\[[^\]]*\]", "", query)
    return {name for name in _NAME.findall(plain) if name not in labels | _FUNCTIONS}, labels


@pytest.fixture
def samples(local_service: Any) -> dict[str, set[str]]:
    """The labels of every sample that the service has, by its name."""
    local_service.waiting()
    assert local_service.client.get("/jobs").status_code == 200
    text = local_service.client.get("/metrics").text
    found: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


def test_every_query_names_metrics_and_labels_of_the_service(samples: dict[str, set[str]]) -> None:
    assert len(queries()) > 10
    for query in queries():
        metrics, labels = names_in(query)
        assert len(metrics) == 1, query
        (metric,) = metrics
        assert metric in samples, query
        assert labels <= samples[metric], query


def test_every_metric_of_the_service_is_shown(samples: dict[str, set[str]]) -> None:
    shown = {metric for query in queries() for metric in names_in(query)[0]}
    families = {re.sub(r"_(total|bucket|count|sum|created)$", "", name) for name in samples if name.startswith("gable")}
    assert families == {re.sub(r"_(total|bucket)$", "", name) for name in shown if name.startswith("gablework")}


def test_a_query_with_a_name_that_is_wrong_would_be_seen(samples: dict[str, set[str]]) -> None:
    metrics, labels = names_in('sum by (stat) (rate(gablework_reqests_total{status=~"5.."}[5m]))')
    assert metrics == {"gablework_reqests_total"}
    assert not metrics & set(samples)
    assert labels == {"stat", "status"}
