"""The configuration: which source overrides which, and the errors of wrong keys."""

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import pytest

from schemas.detector import METHODS, CnnConfig, DetectorConfig, PaperConfig
from schemas.flight import READ_WITH, FlightConfig
from velfield.errors import IneffectiveSettingWarning, InputError
from velfield.pipeline.configuration import resolve_config


def test_without_settings_it_is_the_defaults() -> None:
    assert resolve_config() == FlightConfig()


def test_each_source_is_stronger_than_the_one_before(tmp_path: Path) -> None:
    file = tmp_path / "flight.yaml"
    file.write_text("preset: paper\ngsd_m: 0.3\ndetection: {rounds: 150}\ntracking: {max_speed_m_per_s: 20}\n")
    config = resolve_config(file=file, settings=["tracking.max_speed_m_per_s=25"], overrides={"gsd_m": 0.4})
    assert config.detection.method == "paper"  # the preset's
    assert config.detection.rounds == 150  # the file's, over the preset's 200
    assert config.tracking.max_speed_m_per_s == 25
    assert config.gsd_m == 0.4


@pytest.mark.parametrize(
    "settings", list(permutations(["detection.method=paper", "detection.rounds=100", "detection.seed=3"]))
)
@pytest.mark.parametrize("preset", ["best", "fast", "paper"])
def test_a_method_and_its_keys_are_set_in_any_order(settings: Sequence[str], preset: str) -> None:
    detection = resolve_config(preset=preset, settings=settings).detection
    assert detection == PaperConfig(rounds=100, seed=3)  # what the preset sets of another method is left out


def test_a_preset_sets_keys_of_its_own_method_only() -> None:
    assert resolve_config(preset="fast").detection == CnnConfig(fine_tune_steps=120)
    fast = resolve_config(preset="fast", settings=["detection.method=paper", "detection.rounds=100"]).detection
    assert fast == PaperConfig(rounds=100)


@pytest.mark.parametrize("model", METHODS)
def test_no_key_is_accepted_that_the_method_never_reads(model: type[DetectorConfig]) -> None:
    method = model.model_fields["method"].default
    for other in METHODS:
        for key in set(other.model_fields) - set(model.model_fields):
            said = rf"detection\.{key} is read by .*, not by {method}; .*choose detection\.method=\w+ or leave it out$"
            with pytest.raises(InputError, match=said):
                resolve_config(settings=[f"detection.{key}=1", f"detection.method={method}"])


def test_an_option_that_was_not_given_changes_nothing() -> None:
    assert resolve_config(overrides={"gsd_m": None, "frames.every": None}) == FlightConfig()


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (["tracking.max_sped_m_per_s=20"], "did you mean 'tracking.max_speed_m_per_s'"),
        (["tracking.max_sped=20"], "did you mean 'tracking.max_speed_m_per_s'"),
        (["trackin.max_speed_m_per_s=20"], "unknown key 'trackin'; did you mean 'tracking'?"),
        (["max_turn=20"], "did you mean 'tracking.max_turn_rad'"),
        (["frames.evry=2"], "did you mean 'frames.every'"),
        (["tracking.=3"], "unknown key 'tracking.'; `velfield schema` lists the keys"),
        (["gsd=0.2"], "did you mean 'gsd_m'"),
        (["tracking.foo=3"], "unknown key 'tracking.foo'; `velfield schema` lists the keys"),
        (["tracking.max_speed_m_per_s=.nan"], "finite"),
        (["tracking.max_speed_m_per_s=.inf"], "finite"),
        (["tracking.max_speed_m_per_s=-1"], "greater than 0"),
        (["detection.method=dnse"], "expected one of 'cnn', 'paper'"),
        (["gsd_m"], "expected section.key=value"),
        (["gsd_m.metres=1", "gsd_m=2"], ""),
        (["preset=worst"], "best, fast, paper"),
        (["tracking.stationary_speed_m_per_s=50"], "no vehicle could move"),
        (["tracking.max_turn_rad=30"], "max_turn_rad"),  # degrees
        (["field.bin_width_m_per_s=0.01"], "7200 bins an axis"),
        (["field.bin_width_m_per_s=80"], "bins an axis"),
        (["field.tile_size_px=1"], "tile_size_px"),
        (["gsd_m=0.0000001"], "gsd_m"),
        (["work.unit_frames=0"], "unit_frames"),
    ],
)
def test_a_wrong_setting_is_one_clear_line(settings: list[str], text: str) -> None:
    if not text:
        assert resolve_config(settings=settings).gsd_m == 2
        return
    with pytest.raises(InputError) as caught:
        resolve_config(settings=settings)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_yaml(tmp_path: Path) -> None:
    file = tmp_path / "flight.yaml"
    file.write_text("frames: [1, 2")
    with pytest.raises(InputError, match="this is not YAML"):
        resolve_config(file=file)
    file.write_text("preset: best\n\n# tracking:\n   max_speed_m_per_s: 20\n")
    with pytest.raises(InputError, match=r"line 4: this is not YAML.*`section:` on a line of its own") as caught:
        resolve_config(file=file)
    assert "\n" not in str(caught.value)


def test_a_section_without_keys_says_nothing(tmp_path: Path) -> None:
    file = tmp_path / "flight.yaml"
    file.write_text("tracking:\n# max_speed_m_per_s: 20\n")
    assert resolve_config(file=file) == resolve_config()


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such file; `velfield init VIDEO` writes one"):
        resolve_config(file=tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ("registration.model=homography", "registration.row_spline_knots=24"),
            "registration.row_spline_knots has no effect with registration.model=homography",
        ),
        (("registration.mesh=false", "registration.cell_size_px=80"), "cell_size_px has no effect with .*mesh=false"),
        (("registration.drop_fraction=0.1",), "drop_fraction has no effect with registration.model=row_spline"),
        (("lens.calibrate=never", "lens.frames=20"), "lens.frames has no effect with lens.calibrate=never"),
        (("frames.every=2", "frames.target_interval_s=0.1"), "target_interval_s has no effect with frames.every=2"),
        (("field.path_width=pixel", "field.lane_width_m=3"), "lane_width_m has no effect with field.path_width=pixel"),
    ],
)
def test_a_setting_that_the_chosen_method_does_not_read_is_warned_of(settings: tuple[str, ...], message: str) -> None:
    with pytest.warns(IneffectiveSettingWarning, match=message) as caught:
        resolve_config(settings=settings)
    assert len(caught) == 1


def test_settings_that_are_read_and_defaults_of_presets_are_not_warned_of() -> None:
    """Warnings are errors here."""
    paper = resolve_config(preset="paper", settings=["registration.drop_fraction=0.1", "tracking.min_confidence=0.5"])
    assert (paper.registration.drop_fraction, paper.tracking.min_confidence) == (0.1, 0.5)
    read = ["registration.model=homography", "field.lane_width_m=3", "frames.target_interval_s=0.1"]
    assert resolve_config(settings=read).field.lane_width_m == 3


def test_what_decides_whether_a_key_is_read_is_a_key_and_its_values_are_valid() -> None:
    for key, deciding in READ_WITH.items():
        resolve_config(overrides={other: values[0] for other, values in deciding.items()})
        section, name = key.split(".")
        assert name in type(getattr(FlightConfig(), section)).model_fields


def test_every_key_has_a_description_in_the_schema() -> None:
    schema = FlightConfig.model_json_schema()
    properties = {name: found for name, found in schema["properties"].items() if "$ref" not in str(found)}
    assert set(properties) >= {"gsd_m", "position_unit"}
    assert [name for name, found in properties.items() if not found.get("description")] == []
