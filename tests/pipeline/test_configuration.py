"""The configuration: what is stronger than what, and what a wrong key is told."""

from pathlib import Path

import pytest

from schemas.flight import FlightConfig
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config


def test_nothing_said_is_the_defaults() -> None:
    assert resolve_config() == FlightConfig()


def test_each_source_is_stronger_than_the_one_before(tmp_path: Path) -> None:
    file = tmp_path / "flight.yaml"
    file.write_text("preset: paper\ngsd_m: 0.3\ndetection: {rounds: 150}\ntracking: {max_speed_m_per_s: 20}\n")
    config = resolve_config(file=file, settings=["tracking.max_speed_m_per_s=25"], overrides={"gsd_m": 0.4})
    assert config.detection.method == "dense"  # the preset's
    assert config.detection.rounds == 150  # the file's, over the preset's 200
    assert config.tracking.max_speed_m_per_s == 25
    assert config.gsd_m == 0.4


def test_an_option_that_was_not_given_changes_nothing() -> None:
    assert resolve_config(overrides={"gsd_m": None, "frames.every": None}) == FlightConfig()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (["tracking.max_sped_m_per_s=20"], "did you mean 'tracking.max_speed_m_per_s'"),
        (["tracking.max_speed_m_per_s=.nan"], "finite"),
        (["tracking.max_speed_m_per_s=.inf"], "finite"),
        (["tracking.max_speed_m_per_s=-1"], "greater than 0"),
        (["detection.method=dnse"], "'network', 'aligned' or 'dense'"),
        (["gsd_m"], "expected section.key=value"),
        (["gsd_m.metres=1", "gsd_m=2"], ""),
        (["preset=worst"], "best, fast, paper"),
    ],
)
def test_a_wrong_setting_is_one_clear_line(settings: list[str], told: str) -> None:
    if not told:
        assert resolve_config(settings=settings).gsd_m == 2
        return
    with pytest.raises(InputError) as caught:
        resolve_config(settings=settings)
    assert told in str(caught.value)
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
    with pytest.raises(InputError, match=r"is not there; give a YAML file"):
        resolve_config(file=tmp_path / "none.yaml")
