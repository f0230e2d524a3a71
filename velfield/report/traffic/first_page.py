"""The first page: five questions with their answers, and what could not be said."""

from dataclasses import dataclass

from schemas.export import SpeedUnit
from velfield.analysis.answers import (
    DELAY_OF_PART,
    duration_text,
    find_answers,
    lanes_text,
    queue_text,
)
from velfield.analysis.signals.cycles import ends_out_of_view, queues
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.report.traffic.approaches import approach_delays, lane_names

_PER_QUESTION = 3
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
    for answer in find_answers(analysis, unit=unit):
        place = f"{answer.subject}: " if answer.subject else ""
        text = place + answer.text
        if answer.state == "too little data":
            withheld.append(f"{answer.topic}: {text}")
            reasons.setdefault(answer.topic, []).append(place + answer.text.removeprefix("too little data: "))
        else:
            found.setdefault(answer.topic, []).append(text)

    def why(topic: str, otherwise: str) -> str:
        return "; ".join(reasons.get(topic, [])[:_PER_QUESTION]) or otherwise

    events = [f"{name}: {text}" for topic, name in _EVENTS.items() for text in found.get(topic, [])[:1]]
    no_junction = "no junction of lanes was found"
    questions = (
        (
            "Where do vehicles go?",
            found.get("movement", []) or found.get("through", []),
            "no turn was seen three times",
        ),
        (
            "Which approach waits longest, and how long are the queues?",
            _waits(analysis),
            "no approach has a signal or a delay that could be measured" if analysis.movements else no_junction,
        ),
        ("Is there a signal?", found.get("signal", []), why("signal", no_junction)),
        (
            "How fast do vehicles drive?",
            found.get("speed", []) or found.get("mean speed", []),
            why("speed", "no lane was found"),
        ),
        ("Where is it dangerous?", events, why("conflicts", "no lane was found")),
    )
    n = len(analysis.trajectories)
    seen = f"{n} vehicle{'s' if n != 1 else ''} that move, in {duration_text(analysis.trajectories.duration_s)}"
    return FirstPage(
        seen,
        tuple(
            (question, (*lines[:_PER_QUESTION], *_more(lines)) or (f"Not known: {why}.",))
            for question, lines, why in questions
        ),
        tuple(dict.fromkeys(withheld)),
    )


def _more(lines: list[str]) -> tuple[str, ...]:
    return (f"and {len(lines) - _PER_QUESTION} more, in the tables",) if len(lines) > _PER_QUESTION else ()


def _waits(analysis: TrafficAnalysis) -> list[str]:
    """A line on each junction with a known delay or queue, those with most vehicles first."""
    out = []
    for found in sorted(analysis.movements, key=lambda m: -m.volume):
        number = found.junction.number
        signal = analysis.signals.get(number)
        if not analysis.ways_meet(number):
            continue
        delays = approach_delays(analysis, found)
        parts = [f"from {d.arm} {d.text}" for d in delays]
        names = lane_names(found)
        longest = max(
            ((q, s) for s in (signal.streams if signal else ()) for q in queues(s.stream, s.green_s)),
            key=lambda pair: pair[0].length_m,
            default=None,
        )
        part = DELAY_OF_PART if any(d.partly for d in delays) else ""
        said = [f"mean delay{part} " + ", ".join(parts)] if parts else []
        silent = {m.arm_in for m in found.movements} - {d.arm for d in delays}
        said += (
            [f"delay from {', '.join(sorted(silent))} not known: 10 must be seen for 60 m, 3 of them without a stop"]
            if parts and silent
            else []
        )
        if longest and longest[0].vehicles.value:
            lane = longest[1].stream.approach.lane
            said.append(f"longest queue at green in view {names.get(lane, f'lane {lane}')}: {queue_text(longest[0])}")
            beyond = [s.stream.approach.lane for s in signal.streams if ends_out_of_view(s)] if signal else []
            others = [other for other in beyond if other != lane]
            said += [f"those of {lanes_text(others)} end out of view too"] if others else []
        if said:
            out.append(f"junction {number}: " + "; ".join(said))
    return out
