"""The OpenAPI document: valid, of version 3.0 throughout, and complete."""

from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest
from openapi_spec_validator import OpenAPIV30SpecValidator

from service.app import ROUTERS, create_app
from service.openapi import TAGS, operations
from service.problems import MEDIA_TYPE
from service.settings import ServiceSettings


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return create_app(ServiceSettings(state=tmp_path_factory.mktemp("state"))).openapi()


def schemas(value: Any, within: str = "") -> Iterator[dict[str, Any]]:
    """All schema objects of a document."""
    if isinstance(value, list):
        for item in value:
            yield from schemas(item, within)
    elif isinstance(value, dict):
        if within == "schema":
            yield value
        for name, item in value.items():
            if name in {"example", "enum", "default", "required"}:
                continue
            if name in {"schema", "items", "additionalProperties", "allOf", "anyOf", "oneOf"}:
                yield from schemas(item, "schema")
            elif name in {"schemas", "properties"} and isinstance(item, dict):
                for found in item.values():
                    yield from schemas(found, "schema")
            else:
                yield from schemas(item)


def test_no_schema_uses_what_version_3_0_does_not_know(document: dict[str, Any]) -> None:
    assert document["openapi"].startswith("3.0.")
    newer = {"const", "examples", "prefixItems", "contentEncoding", "contentMediaType"}
    newer |= {"$defs", "patternProperties", "if"}
    count = 0
    for schema in schemas(document):
        count += 1
        assert not newer & set(schema), schema
        assert isinstance(schema.get("type", ""), str), schema
        assert schema.get("type") != "null", schema
        for bound in ("exclusiveMinimum", "exclusiveMaximum"):
            assert isinstance(schema.get(bound, True), bool), schema
        assert schema.get("type") != "array" or "items" in schema, schema
    assert count > 100


def test_an_independent_validator_accepts_the_document(document: dict[str, Any]) -> None:
    assert [fault.message for fault in OpenAPIV30SpecValidator(document).iter_errors()] == []


def test_the_independent_validator_sees_a_fault(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    broken = {**document, "components": {"schemas": {**schemas, "Execute": {**schemas["Execute"], "required": []}}}}
    assert list(OpenAPIV30SpecValidator(broken).iter_errors())


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    names = {schema["$ref"] for schema in schemas(document) if "$ref" in schema}
    known = {f"#/components/schemas/{name}" for name in document["components"]["schemas"]}
    assert names <= known
    assert len(names) > 5


def test_every_operation_says_what_it_does_what_it_answers_and_shows_an_example(document: dict[str, Any]) -> None:
    ids = [operation["operationId"] for _, operation in operations(document)]
    assert len(ids) == len(set(ids)) > 15
    tags = {tag["name"] for tag in TAGS}
    for _, operation in operations(document):
        assert operation["summary"]
        assert operation["description"]
        assert set(operation["tags"]) <= tags
        for status, answer in operation["responses"].items():
            assert answer["description"], (operation["operationId"], status)
            if int(status) >= 400 and "Health" not in str(answer):
                assert list(answer["content"]) == [MEDIA_TYPE], (operation["operationId"], status)
        assert "'example" in repr(operation), operation["operationId"]


def test_what_needs_a_key_says_so_and_how_it_refuses(document: dict[str, Any]) -> None:
    open_paths = {"/", "/conformance", "/processes", "/processes/{processID}", "/healthz", "/readyz"}
    for path, item in document["paths"].items():
        for _, operation in operations({"paths": {path: item}}):
            assert ("security" in operation) == (path not in open_paths or "post" in item), path
            if "security" in operation:
                assert {"401", "403", "429"} <= set(operation["responses"])


def test_examples_fit_their_schemas(document: dict[str, Any]) -> None:
    checked = 0
    for _, operation in operations(document):
        bodies = [operation.get("requestBody", {}), *operation["responses"].values()]
        for media in (media for body in bodies for media in body.get("content", {}).values()):
            examples = [media.get("example"), *(each["value"] for each in media.get("examples", {}).values())]
            for example in (each for each in examples if isinstance(each, dict)):
                schema = {**media["schema"], "components": document["components"]}
                jsonschema.Draft4Validator(schema).validate(example)
                checked += 1
    assert checked >= 20


def test_every_route_is_in_the_document_or_left_out_on_purpose(document: dict[str, Any]) -> None:
    routes = {route.path for router in ROUTERS for route in router.routes}
    assert routes - set(document["paths"]) == {"/docs"}
