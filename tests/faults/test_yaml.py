"""YAML that stands for more values than a machine can hold is refused at once."""

from pathlib import Path

import pytest
import yaml

from flows.runners import read_runner
from schemas.model import load_yaml
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config

BOMB = "a0: &a0 [1]\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12))


def test_aliases_within_aliases_are_refused_with_their_line(tmp_path: Path) -> None:
    """Written out, this one holds 10^11 values; to format an error about it takes hours."""
    with pytest.raises(yaml.YAMLError, match=r"alias \*a0 is not read"):
        load_yaml(BOMB)
    file = tmp_path / "flight.yaml"
    file.write_text(BOMB + "tracking:\n  max_speed_m_per_s: *a11\n")
    with pytest.raises(InputError, match=r"line 2: .*alias \*a0 is not read") as error:
        resolve_config(file=file)
    assert "\n" not in str(error.value)
    file.write_text(BOMB + "cluster_class: *a11\n")
    with pytest.raises(InputError, match=r"alias \*a0 is not read"):
        read_runner(file)


def test_plain_values_are_read_as_ever() -> None:
    text = "a: [1, 2.5, true, null, 'x']\nb: {c: 2026-11-25}\n"
    assert load_yaml(text) == yaml.safe_load(text)
    assert load_yaml("") is None
