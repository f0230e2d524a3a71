"""A run folder as format 1 had it: a present one with the old names of `schemas.renames`."""

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd

from schemas.renames import (
    OLD_ARRAYS,
    OLD_ATTRIBUTES,
    OLD_FIELD_VALUES,
    OLD_FIELDS,
    OLD_FOLDERS,
    OLD_KEYS,
    OLD_VALUES,
    OLD_WEIGHTS,
    REMOVED_KEYS,
)
from velfield.run.commits import digest_file


def to_format_1(run: Path, out: Path) -> Path:
    """Copy a run folder into one of format 1; returns ``out``."""
    shutil.copytree(run, out)
    _edit_json(out / "flight.json", _old_flight)
    for name in ("grid", "working"):
        if (out / "base" / f"{name}.json").exists():
            _edit_json(out / "base" / f"{name}.json", lambda record, name=name: _old_record(name, record))
    for folder in (out, out / "commits"):
        for name, old in OLD_FOLDERS.items():  # links before tracklets: one takes the place of the other
            if (folder / name).exists():
                (folder / name).rename(folder / old)
    for path in (out / OLD_FOLDERS["tracks"]).glob("*.parquet"):
        pd.read_parquet(path).drop(columns="track_id").to_parquet(path, index=False)
    for store in out.rglob("*.zarr"):
        _old_store(store)
    shutil.rmtree(out / "commits/page", ignore_errors=True)  # records of a later version, like the digest of each
    for path in (out / "commits").glob("*/*.json"):
        _edit_json(path, lambda record: _old_commit(out, record))
    return out


def _edit_json(path: Path, change: Any) -> None:
    record = change(json.loads(path.read_text()))
    record.pop("digest", None)
    path.write_text(json.dumps(record))


def _old_record(kind: str, record: dict[str, Any]) -> dict[str, Any]:
    names = {name: old for old, name in OLD_FIELDS[kind].items()}
    values = {name: {new: old for old, new in pairs.items()} for name, pairs in OLD_FIELD_VALUES.items()}
    return {
        names.get(name, name): values.get(name, {}).get(value, value) if isinstance(value, str) else value
        for name, value in record.items()
    }


def _old_flight(record: dict[str, Any]) -> dict[str, Any]:
    config = record["config"]
    for key, values in OLD_VALUES.items():
        section, name = key.split(".")
        value = config[section][name]
        config[section][name] = {new: old for old, new in values.items()}.get(value, value)
    for old, key in OLD_KEYS.items():
        (section, old_name), (_, name) = old.split("."), key.split(".")
        if name in config[section]:  # not every method of detection has every key
            config[section][old_name] = config[section].pop(name)
    for key in REMOVED_KEYS:
        section, name = key.split(".")
        config[section][name] = 8
    keys = {OLD_FOLDERS.get(stage, stage): key for stage, key in record["keys"].items()}
    return record | {"format_version": 1, "keys": keys}


def _old_commit(root: Path, record: dict[str, Any]) -> dict[str, Any]:
    stage, outputs = record["stage"], {}
    for path in record["outputs"]:
        folder, *inner = path.split("/")
        old = "/".join([OLD_FOLDERS.get(folder, folder), *(OLD_ARRAYS.get(part, part) for part in inner)])
        outputs[old] = digest_file(root / old)
    counts = _old_record("commit_counts", record["counts"])
    return record | {"stage": OLD_FOLDERS.get(stage, stage), "outputs": outputs, "counts": counts}


def _old_store(store: Path) -> None:
    def change(metadata: dict[str, Any]) -> dict[str, Any]:
        attributes = metadata["attributes"]
        attributes.pop("format_version", None)
        for name, old in OLD_ATTRIBUTES.items():
            if name in attributes:
                attributes[old] = attributes.pop(name)
        if "weighted_by" in attributes:
            attributes["weighted_by"] = OLD_WEIGHTS.get(attributes["weighted_by"], attributes["weighted_by"])
        return metadata

    _edit_json(store / "zarr.json", change)
    for name, old in OLD_ARRAYS.items():
        if (store / name).exists():
            (store / name).rename(store / old)
