"""Classes of labels: their names, and which of them are cars.

Names stand in the labels themselves, or in a file beside the numbers, as Ultralytics, Roboflow, Darknet, CVAT and Label
Studio write it. Numbers without names are never guessed: one single class counts as cars, several are a question.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import yaml

from schemas.model import load_yaml
from velfield.errors import InputError, parse_json
from velfield.sources.table import read_text

Label = str | int | None
"""A class by its name, by its number where that has no name, or none at all."""
_LEVELS = 4
"""Folders in which names are looked for: that of the labels, and three above it."""
_LISTS = ("classes.txt", "obj.names", "_darknet.labels", "predefined_classes.txt")
NAME_FILES = (*_LISTS, "notes.json")
"""Files of names that lie among labels."""
_CARS = (
    *("car", "auto", "automobile", "van", "suv", "sedan", "pickup", "taxi", "cab", "hatchback", "coupe", "jeep"),
    *("vehicle", "limousine", "wagon", "crossover", "mpv", "pkw", "voiture", "coche", "carro", "macchina", "bil"),
)
_NOT_CARS = re.compile(
    r"truck|lorr|bus|coach|train|tram|rail|street|cable|motorcycle|motorbike|cycl|bike|scooter|wheel|large|heavy|big|"
    r"trailer|cart|carriage|caravan|cargo|carrier|tractor|construct|agricult|engineering|boat|ship|water|plane|air|"
    r"person|park|space|plate|door|window|mirror|part|shadow|toy|non|not|no\b|box|side|hand|ignore|unknown|other"
)
_WORD = re.compile(r"[^\W\d_]+")


def is_car(name: str) -> bool:
    """Whether a class of this name is of cars: the last part of one of its words says so, and none says otherwise.

    Examples
    --------
    >>> [name for name in ("Cars", "small-vehicle", "large vehicle", "cargo", "minivan", "carpet") if is_car(name)]
    ['Cars', 'small-vehicle', 'minivan']
    """
    plain = name.lower()
    words = [word.removesuffix("s") for word in _WORD.findall(plain)]
    return any(word.endswith(_CARS) for word in words) and not _NOT_CARS.search(plain)


def choose_cars(labels: Iterable[Label], names: Mapping[int, str], origin: str) -> tuple[set[Label], list[str]]:
    """The labels that are of cars, and a line that says which these are.

    ``labels`` has the class of every annotation, ``names`` of those given by number; they stand in ``origin``.

    Raises
    ------
    InputError
        No class is of cars, or there are several numbers without a name.
    """
    counts = Counter(labels)
    numbered = {label: names.get(label) for label in counts if isinstance(label, int)}
    if names and (beyond := sorted(number for number, name in numbered.items() if name is None)):
        raise InputError(f"{origin}: found the class {beyond[0]} in labels, but no name of it; name every class")
    titles: dict[Label, str] = {label: label for label in counts if isinstance(label, str)}
    titles |= {number: name for number, name in numbered.items() if name is not None}
    unnamed = [label for label in counts if label is not None and titles.get(label, "").strip(" 0123456789") == ""]
    if unnamed and len(counts) > 1:
        listed = ", ".join(f"{label} ({counts[label]} boxes)" for label in sorted(unnamed, key=str)[:8])
        raise InputError(
            f"{origin}: found the classes {listed} without names, expected to know which are cars; name them in a "
            "classes.txt with the labels, a name a line from class 0 on"
        )
    cars: set[Label] = {label for label, title in titles.items() if is_car(title)} | (counts.keys() & {None})
    cars |= set(unnamed)
    if counts and not cars:
        listed = ", ".join(sorted(titles.values())[:8])
        raise InputError(f"{origin}: found the classes {listed}, expected one of cars (car, vehicle, van); name one so")
    if unnamed:
        return cars, [f"no names of classes: the only class, {unnamed[0]}, is taken as cars ({counts[unnamed[0]]})"]
    if not titles:
        return cars, []
    return cars, [_describe(counts, titles, cars, origin)]


def _describe(counts: Mapping[Label, int], titles: Mapping[Label, str], cars: set[Label], origin: str) -> str:
    used = [f"{titles[label]} ({counts[label]})" for label in titles if label in cars]
    used += [f"shapes without a class ({counts[None]})"] if None in counts else []
    left = [f"{titles[label]} ({counts[label]})" for label in titles if label not in cars]
    return f"classes by {origin}: cars are {', '.join(used)}" + (f"; ignored: {', '.join(left)}" if left else "")


def names_of_numbers(given: Path, files: Iterable[Path]) -> tuple[dict[int, str], str]:
    """Names of the classes that label files give by numbers, and the file that holds them; none where there is none.

    Raises
    ------
    InputError
        Files of one folder that disagree, or one that holds no names.
    """
    first = next(iter(files), given)
    folders = [given] if given.is_dir() else []
    folders += [folder for folder in list(first.parents)[:_LEVELS] if folder not in folders]
    for folder in sorted(folders, key=lambda one: -len(one.parts)):
        found = [(path, names) for path in _name_files(folder) if (names := _read_names(path))]
        if found:
            path, names = found[0]
            for other, others in found[1:]:
                if other.name in (*NAME_FILES, "data.yaml", "dataset.yaml") and others != names:
                    raise InputError(
                        f"{path.name} and {other.name} of {folder.name} name classes differently; remove the wrong one"
                    )
            return names, path.name
    return {}, given.name


def _name_files(folder: Path) -> Iterator[Path]:
    known = [folder / name for name in ("data.yaml", "dataset.yaml", *NAME_FILES)]
    yield from (path for path in known if path.is_file())
    yield from (path for path in sorted(folder.glob("*.y*ml")) if path not in known)


def _read_names(path: Path) -> dict[int, str]:
    text = read_text(path, "class names")
    if path.name in _LISTS:
        return {number: name.strip() for number, name in enumerate(text.splitlines()) if name.strip()}
    is_data = path.name in ("data.yaml", "dataset.yaml")
    try:
        if path.suffix == ".json":
            return {int(one["id"]): str(one["name"]) for one in parse_json(text)["categories"]}
        names = load_yaml(text)["names"]
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        return {int(number): str(name) for number, name in pairs}
    except (yaml.YAMLError, TypeError, KeyError, ValueError, AttributeError):
        if not is_data:
            return {}
        raise InputError(
            f"{path.name}: found no `names` of classes in it, expected YOLO's data file; fix or move it"
        ) from None
