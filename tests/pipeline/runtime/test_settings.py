"""Settings: all faults at once, a hash of what can change geometry and of nothing else."""

import dataclasses
from pathlib import Path

import pytest

from pipeline.errors import SettingsError
from pipeline.methods import METHODS
from pipeline.renamed_settings import RENAMED
from pipeline.settings import SECTIONS, RunSettings


def test_all_faults_are_reported_at_once() -> None:
    with pytest.raises(SettingsError) as caught:
        RunSettings.from_mapping(
            {
                "method": "magic",
                "tile_size_m": -5,
                "ground": {"max_slope": 9.0, "windows": 3},
                "roofs": {},
                "fuzzy-sart": {"vigilance": "high"},
            }
        )
    text = str(caught.value)
    for part in (
        "method is 'magic': use one of arrangement",
        "tile_size_m is -5",
        "[ground] max_slope is 9",
        "[ground] windows is not a setting",
        "[roofs] is not a table of settings",
        "[fuzzy-sart] vigilance is 'high'",
    ):
        assert part in text


def test_the_hash_ignores_what_cannot_change_results() -> None:
    plain = RunSettings()
    assert RunSettings.from_mapping({"tile_size_m": 77.0, "lattice_x_m": 3.0}).settings_hash == plain.settings_hash
    assert RunSettings.from_mapping({"classes": "ignore"}).settings_hash != plain.settings_hash


OF_PAPERS = [name for name, entry in METHODS.items() if entry.follows_paper]


def test_a_method_of_our_own_has_no_preset_that_keeps_to_a_paper() -> None:
    fault = "preset is 'faithful', and arrangement follows no paper: use robust"
    for table in ({}, {"arrangement": {"min_points": 9}}):
        with pytest.raises(SettingsError, match=fault):
            RunSettings.from_mapping({"method": "arrangement", "preset": "faithful", **table})


@pytest.mark.parametrize("name", OF_PAPERS)
def test_a_preset_is_where_the_settings_of_a_method_start(name: str) -> None:
    faithful = RunSettings.from_mapping({"method": name, "preset": "faithful"})
    assert faithful.building.method == METHODS[name].preset("faithful")
    assert RunSettings.from_mapping({"method": name}).building.method == METHODS[name].settings_type()
    field = next(f for f in dataclasses.fields(METHODS[name].settings_type) if isinstance(f.default, int | float))
    changed = RunSettings.from_mapping({"method": name, "preset": "faithful", name: {field.name: field.default}})
    assert changed.building.method == dataclasses.replace(
        METHODS[name].preset("faithful"), **{field.name: field.default}
    )


def test_an_unknown_preset_is_reported_with_the_known_ones() -> None:
    with pytest.raises(SettingsError, match="preset is 'bold': use one of robust, faithful"):
        RunSettings.from_mapping({"preset": "bold", "fuzzy-sart": {"vigilance": 0.8}})


@pytest.mark.parametrize("name", OF_PAPERS)
def test_the_hash_is_of_the_values_and_not_of_the_preset_that_gave_them(name: str) -> None:
    values = {
        field.name: getattr(METHODS[name].preset("faithful"), field.name)
        for field in dataclasses.fields(METHODS[name].preset("faithful"))
    }
    spelt_out = RunSettings.from_mapping({"method": name, name: values})
    preset = RunSettings.from_mapping({"method": name, "preset": "faithful"})
    assert spelt_out.settings_hash == preset.settings_hash != RunSettings.from_mapping({"method": name}).settings_hash


@pytest.mark.parametrize("section", sorted(RunSettings().sections()))
def test_every_setting_of_geometry_changes_the_hash(section: str) -> None:
    plain = RunSettings()
    for field in dataclasses.fields(plain.sections()[section]):
        value = getattr(plain.sections()[section], field.name)
        if not field.metadata["changes_geometry"] or isinstance(value, str | bool):
            continue
        low, high = field.metadata["minimum"], field.metadata["maximum"]
        numbers = () if isinstance(value, tuple) else (low, high, value + 1)
        other = next((v for v in numbers if v is not None and v != value), ())
        table = {field.name: type(value)(other)}
        try:
            changed = RunSettings.from_mapping(table if section == "general" else {section: table})
        except SettingsError as fault:
            # bounds of one range depend on each other: the fault must say so
            assert field.name.rsplit("_", 2)[0] in str(fault)  # noqa: PT017
            continue
        assert changed.settings_hash != plain.settings_hash, field.name


def test_a_toml_file_and_the_command_line_meet(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text('[settings]\nclasses = "audit"\ntile_size_m = 200\n[settings.ground]\nmax_window_m = 30\n')
    settings = RunSettings.from_toml(str(path), {"classes": "ignore"})
    assert settings.general.classes == "ignore"
    assert settings.general.tile_size_m == 200.0
    assert settings.scene.ground.max_window_m == 30
    # the chain with both openings, 126 m, then looks farther than the search for wide objects, 122 m
    assert settings.scene.ground.support_m == RunSettings().scene.ground.support_m + 4
    assert settings.halo_m == RunSettings().halo_m, "the ground is found over cells, which no tile's halo holds"


def test_a_settings_file_that_is_no_toml_is_named(tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text("classes = trust")
    with pytest.raises(SettingsError, match=r"run.toml is not TOML"):
        RunSettings.from_toml(str(path), {})


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_an_old_name_of_a_setting_is_rejected_with_the_new_one(old: str, new: str) -> None:
    kinds = {**SECTIONS, **{name: entry.settings_type for name, entry in METHODS.items()}}
    tables = [name for name, kind in kinds.items() if new in {field.name for field in dataclasses.fields(kind)}]
    assert tables
    for table in tables:
        with pytest.raises(SettingsError, match=rf"\[{table}\] {old} is not a setting: it is called {new} now"):
            RunSettings.from_mapping({table: {old: 1}})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[settings]\nmethod = " + b"[" * 5000 + b"]" * 5000, "is not TOML: its brackets are nested too deeply"),
        (b"[settings]\nhalo_m = " + b"9" * 5000, "cannot be read: a number has thousands of digits"),
        (b"[settings]\nhalo_m = " + b"9" * 400, r"halo_m is 9+\.\.\.9+: use a finite number"),
        (b"[settings]\nlattice_x_m = -" + b"9" * 400, r"lattice_x_m is -9+\.\.\.9+: use a finite number"),
        (b"settings = 3", "has settings that are not a table"),
        (b"[settings]\nmethod = '\xe9'", "is not TOML: byte 21 is not UTF-8: save it as UTF-8"),
        (b"[settings]\nmethod = '" + b"x" * 70_000 + b"'", r"method is 'x+\.\.\.x+'"),
    ],
)
def test_whatever_a_settings_file_holds_is_refused_in_a_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "run.toml"
    path.write_bytes(content)
    with pytest.raises(SettingsError, match=words) as refusal:
        RunSettings.from_toml(str(path), {})
    assert len(str(refusal.value)) < 2000
