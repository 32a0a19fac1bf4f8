"""Each option of a run is described once, and every way to start a run has it."""

import dataclasses

import pytest
import typer.main

from pipeline.batch.batch_file import TABLES
from pipeline.batch.batch_keys import as_keys
from pipeline.cli import command_line
from pipeline.extras.classify.classify import ClassifyRequest
from pipeline.options import Option, all_options, option_named
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import resources_of
from service.cli import COMMANDS
from service.jobs import JobRequest
from service.wire.execute import INPUTS
from service.wire.jobs import JobForm
from service.wording import as_inputs

PARAMETERS = {
    name: {flag for one in command.params for flag in one.opts}
    for name, command in typer.main.get_command(command_line(COMMANDS)).commands.items()
}
"""The options of every command."""


@pytest.mark.parametrize("option", all_options(), ids=lambda one: one.name)
def test_an_option_reaches_every_way_to_start_a_run(option: Option) -> None:
    takers, is_served = option.meta["takers"], bool(option.meta["label"])
    assert {command for command in takers if option.flag not in PARAMETERS[command]} == set()
    assert (option.flag in PARAMETERS["submit"]) == is_served
    assert (option.flag in PARAMETERS["reconstruct"]) == ("reconstruct" in takers)
    for process, model in INPUTS.items():
        assert (option.input in model.model_fields) == (is_served and process in takers)
    assert (option.input in JobForm.model_fields) == is_served
    if option.meta["table"] and option.name != "bbox":
        assert option.name in {field.name for field in dataclasses.fields(TABLES[option.meta["table"]])}


def test_requests_have_the_options_that_their_command_takes() -> None:
    for command, request in {"reconstruct": RunRequest, "classify": ClassifyRequest}.items():
        fields = {field.name for field in dataclasses.fields(request)}
        missing = {
            one.name
            for one in all_options()
            if command in one.meta["takers"] and one.meta["table"] != "cluster" and not one.is_setting
        } - fields
        assert missing <= {"scratch"}  # a resource
    assert {"crs", "bbox", "points"} <= {field.name for field in dataclasses.fields(JobRequest)}


@pytest.mark.parametrize(
    ("text", "keys", "inputs"),
    [
        ("give another --out, or --overwrite", "give another [output] path, or [output] overwrite = true", None),
        ("start it with --tls-ca-file", "start it with --tls-ca-file", "start it with --tls-ca-file"),
        ("give --crs EPSG:n", 'give [inputs] crs = "EPSG:n"', "give the input crs"),
        (
            "or give --vertical-unit if it differs",
            "or give [inputs] vertical_unit if it differs",
            "or give the input verticalUnit if it differs",
        ),
        (
            "--allow-outside-area-of-use accepts it",
            "[inputs] allow_outside_area_of_use = true accepts it",
            "the input allowOutsideAreaOfUse accepts it",
        ),
    ],
)
def test_messages_name_keys_and_inputs_in_place_of_options(text: str, keys: str, inputs: str | None) -> None:
    assert as_keys(text) == keys
    assert inputs is None or as_inputs(text) == inputs


def test_resources_without_options_have_the_defaults() -> None:
    resources = resources_of({})
    assert resources.building_timeout_s == option_named("building_timeout_s").default
    assert resources.building_memory_bytes == option_named("building_memory_gib").default * 2**30
    assert resources_of({"workers": 0, "building_memory_gib": 1.0}, traffic="batch").building_memory_bytes == 2**30
