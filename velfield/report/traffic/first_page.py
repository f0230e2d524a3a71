"""The first page: five questions with their answers, and what could not be said."""

from dataclasses import dataclass

from schemas.export import SpeedUnit
from velfield.analysis.answers import duration_text, find_answers, queue_text
from velfield.analysis.signals.cycles import queues
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.report.traffic.approaches import approach_delays, lane_names

_PER_QUESTION = 3


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

    events = [f"{topic}: {text}" for topic in ("conflicts", "u-turns", "unusual") for text in found.get(topic, [])[:1]]
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
            (question, tuple(lines[:_PER_QUESTION]) or (f"Not known: {why}.",)) for question, lines, why in questions
        ),
        tuple(dict.fromkeys(withheld)),
    )


def _waits(analysis: TrafficAnalysis) -> list[str]:
    """A line on each junction with a known delay or queue, those with most vehicles first."""
    out = []
    for found in sorted(analysis.movements, key=lambda m: -m.volume):
        number = found.junction.number
        signal = analysis.signals.get(number)
        if analysis.junction_kind(number) not in ("intersection", "roundabout"):
            continue
        parts = [
            f"from {d.arm} {d.delay_s:.0f} s" + (f" (level of service {d.level})" if d.level else "")
            for d in approach_delays(analysis, found)
        ]
        names = lane_names(found)
        longest = max(
            ((q, s) for s in (signal.streams if signal else ()) for q in queues(s.stream, s.green_s)),
            key=lambda pair: pair[0].length_m,
            default=None,
        )
        line = f"junction {number}: mean delay " + ", ".join(parts) if parts else f"junction {number}:"
        if longest and longest[0].vehicles.value:
            lane = longest[1].stream.approach.lane
            line += f"; longest queue {names.get(lane, f'lane {lane}')}: {queue_text(longest[0])}"
        if not line.endswith(":"):
            out.append(line)
    return out
