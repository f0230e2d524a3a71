"""The first page: five questions with their answers, and what could not be said."""

from collections.abc import Iterator
from dataclasses import dataclass

from schemas.export import SpeedUnit
from velfield.analysis.answers import COVERED, Answer, duration_text, find_answers, rate_text, seen_text
from velfield.analysis.approaches import (
    ApproachDelay,
    approach_delays,
    arms_without_delay,
    compare_delays,
    lane_text,
    lanes_without_queue,
    longest_queues,
    wait_longest,
)
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import count_text, list_text

_PER_QUESTION, _LINES = 4, 8
"""Most lines of an answer, and of one on junctions, which takes several on each."""
_SAFE_PER_H = 3.0
"""Where there may be more near misses an hour than this, none being seen says little."""
_EVENTS = {
    "conflicts": "near misses",
    "u-turns": "U-turns",
    "wrong way": "against the traffic",
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
    answers = list(find_answers(analysis, unit=unit))
    for answer in answers:
        place = f"{answer.subject}: " if answer.subject else ""
        text = place + answer.text
        if answer.state == "too little data":
            withheld.append(f"{answer.topic}: {text}")
            reasons.setdefault(answer.topic, []).append(place + answer.text.removeprefix("too little data: "))
        elif answer.topic == "signal" and answer.estimate:
            cycle, *phases = answer.text.split("; ")
            fair = [place + fairness[answer.subject]] if fairness.get(answer.subject) else []
            found.setdefault("signal", []).extend([f"{place}there is a signal: {cycle}", *fair, *phases])
        else:
            found.setdefault(answer.topic, []).append(text)

    waits: list[str] = []
    for found_at in _met(analysis):
        number = found_at.junction.number
        waits += _waits(analysis, found_at, delays[number], unknown[number])

    def why(topic: str, otherwise: str) -> str:
        return "; ".join(reasons.get(topic, [])[:_PER_QUESTION]) or otherwise

    no_junction = "no junction of lanes was found"
    no_signal = "no junction was found where lanes cross" if analysis.movements else no_junction
    questions = (
        (
            "Where do vehicles go?",
            [
                *(_entered(analysis, found_at) for found_at in _met(analysis)[:_PER_QUESTION] if found_at.movements),
                *_few(found.get("movement") or found.get("through", [])),
                *found.get("merging", []),
                *(f"rare: {line}" for line in _few(found.get("rare turn", []))),
                *(_few(found.get("other lanes", [])) if "movement" in found or "through" not in found else []),
            ],
            "no turn was seen three times",
        ),
        (
            "Which approach waits longest, and how long are the queues?",
            waits[:_LINES],
            "no approach has a signal or a delay that could be measured" if analysis.movements else no_junction,
        ),
        ("Is there a signal, and is it fair?", found.get("signal", [])[:_LINES], why("signal", no_signal)),
        (
            "How fast do vehicles drive?",
            _few(found.get("speed") or found.get("mean speed", [])),
            why("speed", "no lane was found"),
        ),
        (
            "Where is it dangerous?",
            [*_danger(answers, analysis.trajectories.duration_s)],
            f"conflicts: {why('conflicts', 'no lane was found')}",
        ),
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


def _entered(analysis: TrafficAnalysis, found: JunctionMovements) -> str:
    """How many of the vehicles enter a junction, and by which arms."""
    by_arm = {m.arm_in: found.entered(m.arm_in) for m in found.movements}
    arms = list_text([f"{n:.0f} from {arm}" for arm, n in sorted(by_arm.items(), key=lambda item: -item[1])])
    of = count_text(len(analysis.trajectories), "vehicle")
    return (
        f"junction {found.junction.number}: {sum(by_arm.values()):.0f} of the {of} were seen to enter it, {arms}; the "
        "others drove away from it, had not reached it, or passed elsewhere"
    )


def _waits(
    analysis: TrafficAnalysis, found: JunctionMovements, delays: list[ApproachDelay], unknown: list[str]
) -> Iterator[str]:
    """The longest queue of a junction and who waits longest; then a line on each approach that has either."""
    longest = longest_queues(analysis, found)
    if not longest and not delays:
        return
    place = f"junction {found.junction.number}"
    if longest:
        first, *others = longest
        least = longest[first].queue.vehicles.low
        open_ = set(lanes_without_queue(analysis, found)) - {first}
        alike = open_ | {arm for arm in others if not (v := longest[arm].vehicles) or v.high >= least}
        also = f"; the longest from {list_text(sorted(alike))} may be as long" if alike else ""
        yield (
            f"{place}: the longest queue is from {first}, {lane_text(found, longest[first].lane)}: "
            f"{longest[first].text}{also}"
        )
    most = wait_longest(delays) if delays else []
    beyond = [d.arm for d in delays if d.partly and d.arm in most and len(most) > 1]
    part = f"; vehicles from {list_text(beyond)} also wait out of view" if beyond else ""
    first_of = f"vehicles from {list_text(most, 'or')} wait longest{part}" if len(most) < len(delays) else ""
    if unknown:
        but = f"; of the others {first_of}" if first_of else ""
        yield f"{place}: which approach waits longest is not known, as the delay from {list_text(unknown)} is not{but}"
    elif len(delays) > 1:
        yield f"{place}: {first_of or f'no approach is shown to wait longest{part}'}"
    for name in dict.fromkeys((*(delay.arm for delay in delays), *longest)):
        said = [count_text(found.entered(name), "vehicle")]
        said += [f"mean delay {delay.text}" for delay in delays if delay.arm == name] or [
            f"delay not known, with {found.timed(name)} vehicles seen from 60 m before the junction to behind it"
        ]
        if name in longest:
            said.append(f"longest queue {longest[name].text}")
        yield f"from {name}: " + "; ".join(said)


def _danger(answers: list[Answer], duration_s: float) -> Iterator[str]:
    """The verdict where neither a near miss nor an unusual track was seen; else, and of U-turns, what was."""
    events = {answer.topic: answer for answer in answers if answer.topic in _EVENTS}
    seen = {topic: answer for topic, answer in events.items() if answer.state != "too little data"}
    if all(topic in seen and seen[topic].at_most_per_h for topic in ("conflicts", "wrong way")):
        most = seen.pop("conflicts").at_most_per_h or 0.0
        del seen["wrong way"]
        short = f". That is too short to call the place safe: even {rate_text(most)} near misses an hour may not show"
        yield (
            f"nothing dangerous was seen in {duration_text(duration_s)}: no two vehicles came within 1.5 s of meeting "
            f"each other {COVERED}, and none drove against the traffic{short if most > _SAFE_PER_H else ''}"
        )
    elif "conflicts" in events and seen and "conflicts" not in seen:
        yield f"near misses: {events['conflicts'].text}"
    yield from (f"{name}: {seen[topic].text}" for topic, name in _EVENTS.items() if topic in seen)
