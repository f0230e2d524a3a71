"""Which source of the ground sample distance is used, and which contradict it."""

import pytest
from pydantic import ValidationError

from schemas.scale import ScaleEstimate, ScaleSource
from velfield.sources.scale import PRECEDENCE, choose_scale


def estimate(gsd_m: float, source: ScaleSource, spread: float = 0.03) -> ScaleEstimate:
    return ScaleEstimate(gsd_m=gsd_m, low_m=gsd_m * (1 - spread), high_m=gsd_m * (1 + spread), source=source)


def test_the_more_trusted_source_is_used_whatever_the_order() -> None:
    estimates = [estimate(0.1, source) for source in PRECEDENCE]
    assert choose_scale(reversed(estimates)).used == estimates[0]
    assert choose_scale(reversed(estimates)).others == tuple(estimates[1:])
    assert choose_scale(estimates[3:]).used == estimates[3]
    assert choose_scale([]).used is None


def test_disagreement_is_reported_where_intervals_do_not_meet() -> None:
    vehicles = estimate(0.1, "vehicles", 0.05)
    assert not choose_scale([vehicles, estimate(0.108, "metadata")]).disagreements
    (line,) = choose_scale([vehicles, estimate(0.12, "given", 0.0)]).disagreements
    assert "--gsd-m" in line
    assert "0.833 times" in line


@pytest.mark.parametrize(
    ("metadata_m", "used"), [(1.0, "vehicles"), (0.12, "metadata"), (0.105, "metadata"), (0.07, "vehicles")]
)
def test_lengths_of_vehicles_overrule_metadata_that_cannot_be_alone(metadata_m: float, used: str) -> None:
    vehicles, metadata = estimate(0.1, "vehicles", 0.08), estimate(metadata_m, "metadata")
    choice = choose_scale([metadata, vehicles])
    assert choice.used.source == used
    assert len(choice.disagreements) == (metadata_m != 0.105)
    assert choose_scale([metadata, vehicles, estimate(0.1, "given")]).used == estimate(0.1, "given")


def test_an_interval_holds_its_estimate() -> None:
    with pytest.raises(ValidationError, match="not between"):
        ScaleEstimate(gsd_m=0.1, low_m=0.2, high_m=0.3, source="given")
