"""The first page: five questions with their answers, and what could not be said."""

from collections.abc import Mapping
from dataclasses import dataclass

from schemas.export import SpeedUnit
from velfield.analysis.answers import find_answers, longest_queues, queue_text, seen_text
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.signals.cycles import Queue
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import count_text
from velfield.report.traffic.approaches import (
    ApproachDelay,
    approach_delays,
    arms_without_delay,
    compare_delays,
    list_text,
)

_PER_QUESTION = 4
_NO_DELAY = "delay not known"
_WHY_NO_DELAY = "too little data: 10 vehicles must be seen from 60 m before the junction on, and 3 pass without a stop"
_EVENTS = {
    "conflicts": "conflicts",
    "u-turns": "U-turns",
    "unusual": "against the traffic, or by a way that others avoid",
}


@dataclass(frozen=True)
class FirstPage:
    """Content of the first page: summary of the flight, answers by question, and what is missing for the rest."""

    seen: str
    answers: tuple[tuple[str, tuple[str, ...]], ...]
    withheld: tuple[str, ...]

    @property
    def sections(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """The questions, and what could not be said as the last one where there is any."""
        missing = ("What is not known, and why", self.withheld)
        return (*self.answers, missing) if self.withheld else self.answers


def first_page(analysis: TrafficAnalysis, *, unit: SpeedUnit = "km/h") -> FirstPage:
    """The first page's words, with speeds in a unit: km/h or mph."""
    found: dict[str, list[str]] = {}
    withheld: list[str] = []
    reasons: dict[str, list[str]] = {}
    delays = {found.junction.number: approach_delays(analysis, found) for found in analysis.movements}
    unknown = {m.junction.number: arms_without_delay(m, delays[m.junction.number]) for m in analysis.movements}
    fairness = {f"junction {number}": compare_delays(known, unknown[number]) for number, known in delays.items()}
    for answer in find_answers(analysis, unit=unit):
        place = f"{answer.subject}: " if answer.subject else ""
        text = place + answer.text
        if answer.state == "too little data":
            withheld.append(f"{answer.topic}: {text}")
            reasons.setdefault(answer.topic, []).append(place + answer.text.removeprefix("too little data: "))
        else:
            found.setdefault(answer.topic, []).append(text)
            if answer.topic == "signal" and answer.estimate and fairness.get(answer.subject):
                found["signal"].append(place + fairness[answer.subject])

    waits: list[str] = []
    longest_waits: list[str] = []
    for found_at in _met(analysis):
        number, longest = found_at.junction.number, longest_queues(analysis, found_at)
        waits += _approaches(found_at, delays[number], longest)
        if unknown[number] and (longest or delays[number]):
            withheld.append(f"delay: junction {number} from {list_text(unknown[number])}: {_WHY_NO_DELAY}")
            longest_waits.append(f"junction {number}: {_longest_wait(unknown[number], longest)}")

    def why(topic: str, otherwise: str) -> str:
        return "; ".join(reasons.get(topic, [])[:_PER_QUESTION]) or otherwise

    events = [f"{name}: {text}" for topic, name in _EVENTS.items() for text in found.get(topic, [])[:1]]
    no_junction = "no junction of lanes was found"
    no_signal = "no junction was found where lanes cross" if analysis.movements else no_junction
    questions = (
        (
            "Where do vehicles go?",
            [
                *_few(found.get("movement") or found.get("through", [])),
                *found.get("merging", []),
                *(_few(found.get("other lanes", [])) if "movement" in found or "through" not in found else []),
            ],
            "no turn was seen three times",
        ),
        (
            "Which approach waits longest, and how long are the queues?",
            [*_few(longest_waits), *_few(waits)],
            "no approach has a signal or a delay that could be measured" if analysis.movements else no_junction,
        ),
        ("Is there a signal, and is it fair?", _few(found.get("signal", [])), why("signal", no_signal)),
        (
            "How fast do vehicles drive?",
            _few(found.get("speed") or found.get("mean speed", [])),
            why("speed", "no lane was found"),
        ),
        ("Where is it dangerous?", events, f"conflicts: {why('conflicts', 'no lane was found')}"),
    )
    return FirstPage(
        seen_text(analysis.trajectories),
        tuple((question, tuple(lines) or (f"Not known: {why}.",)) for question, lines, why in questions),
        tuple(dict.fromkeys(withheld)),
    )


def _few(lines: list[str]) -> list[str]:
    """The first lines of an answer, and how many more there are."""
    more = len(lines) - _PER_QUESTION
    return [*lines[:_PER_QUESTION], f"and {more} more, in the tables"] if more > 0 else lines


def _met(analysis: TrafficAnalysis) -> list[JunctionMovements]:
    """Junctions where ways meet, that with most vehicles first."""
    return sorted((m for m in analysis.movements if analysis.ways_meet(m.junction.number)), key=lambda m: -m.volume)


def _longest_wait(unknown: list[str], longest: Mapping[str, Queue]) -> str:
    """That it is not known which approach of a junction waits longest; and which has the longest queue, if one has."""
    by_length = sorted(longest, key=lambda arm: -longest[arm].length_m)
    text = f"which approach waits longest is not known, as the delay from {list_text(unknown)} is not"
    sure = len(by_length) > 1 and longest[by_length[0]].vehicles.low > longest[by_length[1]].vehicles.high
    return f"{text}; the longest queue is that from {by_length[0]}" if sure else text


def _approaches(found: JunctionMovements, known: list[ApproachDelay], longest: Mapping[str, Queue]) -> list[str]:
    """A line on each approach of a junction with a known delay or queue: that which waits longest first, or that with
    the longest queue where a delay is not known."""
    delays = {delay.arm: delay for delay in known}
    names = list(dict.fromkeys((*delays, *longest)))
    if arms_without_delay(found, known):
        names.sort(key=lambda name: -longest[name].length_m if name in longest else 0.0)
    out = []
    for name in names:
        said = [count_text(found.entered(name), "vehicle")]
        said.append(f"mean delay {delays[name].text}" if name in delays else _NO_DELAY)
        if name in longest:
            said.append(f"longest queue of a lane when green begins {queue_text(longest[name])}")
        out.append(f"junction {found.junction.number} from {name}: " + "; ".join(said))
    return out
