"""The network that tells cars: its arithmetic against plain ways, what it hands back, its file, and that it learns."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import correlate

from schemas.arrays import FloatArray
from schemas.flight import DetectionConfig
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.convolution import Layout, convolved, gathered, handed_back, spread
from velfield.detection.cnn.dataset import Pieces
from velfield.detection.cnn.fine_tuning import evidence_of_network, train_on
from velfield.detection.cnn.inference import network_finds
from velfield.detection.cnn.model import LAYERS, Network, network_of, odds_map, record_of_network, said_of
from velfield.detection.cnn.trainer import Batch, Learner, learnt
from velfield.detection.detector import Detector, shipped_detector
from velfield.detection.label_orientation import with_axes
from velfield.detection.orientation import axial_difference
from velfield.detection.samples import LabelledImage
from velfield.errors import InputError


def random(*shape: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("taps", [1, 9])
def test_a_convolution_is_scipys(taps: int) -> None:
    layout, values, weights = Layout(2, 13, 41), random(2, 13, 41, 3), random(taps, 3, 5, seed=1)
    out = layout.framed(convolved(layout.laid_out(values), weights, layout))
    side = 3 if taps == 9 else 1
    for picture in range(2):
        for k in range(5):
            kernel = weights[:, :, k].reshape(side, side, 3)
            plain = sum(correlate(values[picture, :, :, c], kernel[:, :, c], mode="same") for c in range(3))
            np.testing.assert_allclose(out[picture, 1:-1, 1:-1, k], plain, atol=1e-4)
    assert not out[:, 0].any()
    assert not out[:, -1].any()
    assert not out[:, :, 0].any()
    assert not out[:, :, -1].any()


@pytest.mark.parametrize("taps", [1, 9])
def test_what_a_convolution_hands_back_is_its_transpose(taps: int) -> None:
    layout = Layout(2, 12, 17)
    values, slope = layout.laid_out(random(2, 12, 17, 4)), layout.laid_out(random(2, 12, 17, 6, seed=1))
    weights = random(taps, 4, 6, seed=2)
    said = float((convolved(values, weights, layout) * slope).sum())
    by_values, by_weights = handed_back(values, weights, slope, layout)
    assert float((by_values * values).sum()) == pytest.approx(said, rel=1e-3, abs=1e-2)
    assert float((by_weights * weights).sum()) == pytest.approx(said, rel=1e-3, abs=1e-2)


def test_spreading_undoes_gathering() -> None:
    layout, values = Layout(3, 8, 12), random(3, 8, 12, 5)
    together = gathered(layout.laid_out(values), layout)
    assert layout.halved().inner(together)[0, 1, 2, :5].tolist() == values[0, 2, 4].tolist()
    np.testing.assert_array_equal(layout.inner(spread(together, layout)), values)


def batch() -> Batch:
    rng = np.random.default_rng(3)
    some = [rng.random(shape).astype(np.float32) for shape in ((2, 16, 16), (2, 8, 8), (2, 8, 8), (2, 8, 8))]
    return Batch(some[0], some[1] ** 6, np.ones((2, 8, 8), np.float32), random(2, 8, 8, 2, seed=4), some[3])


@pytest.mark.parametrize("normalised", [True, False])
def test_slopes_are_what_small_changes_make_of_the_loss(normalised: bool) -> None:
    learner = Learner.from_nothing(1)
    for _ in range(20):
        learner.learn(batch(), 1e-3)
    learner = learner if normalised else Learner.of(learner.network())
    _, slopes = learner.slopes(batch())
    assert slopes.keys() == learner.values.keys()
    for name, slope in slopes.items():
        steep = float(np.linalg.norm(slope.astype(np.float64)))
        value, step = learner.values[name], (2e-3 / steep * slope).astype(np.float32)
        learner.values[name] = value + step
        above, _ = learner.slopes(batch())
        learner.values[name] = value - step
        below, _ = learner.slopes(batch())
        learner.values[name] = value
        assert (above - below) / 4e-3 == pytest.approx(steep, rel=0.05, abs=2e-4), name


@cache
def city(seed: int) -> LabelledImage:
    return simulated_image(seed)


def shipped() -> Network:
    return shipped_detector().network


def test_gains_and_means_go_into_the_weights() -> None:
    learner = Learner.from_nothing(2)
    for size in [1e-3] * 10 + [0.0] * 250:  # then the means are those of this batch
        learner.learn(batch(), size)
    loss, _ = Learner.of(learner.network()).slopes(batch())
    assert loss == pytest.approx(learner.slopes(batch())[0], rel=1e-3)


def test_tiles_say_what_the_whole_picture_says() -> None:
    image = np.tile(city(77).image, (2, 2))[:500, :900]
    likely, axes = odds_map(shipped(), image)
    whole = said_of(shipped(), (image / np.float32(255))[None])[0]
    inner = slice(32, -32)
    assert likely.shape == (250, 450)
    np.testing.assert_allclose(likely[inner, inner], 1 / (1 + np.exp(-whole[inner, inner, 0])), atol=1e-5)
    np.testing.assert_allclose(axes[inner, inner], whole[inner, inner, 1:], atol=1e-4)


@pytest.mark.parametrize("shape", [(61, 83), (4, 4), (30, 500)])
def test_pictures_of_any_size_are_looked_at(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
    assert odds_map(shipped(), image)[0].shape == (-(-shape[0] // 2), -(-shape[1] // 2))
    assert network_finds(shipped(), image, None).shape[1] == 5


def test_a_network_comes_back_from_its_record_at_half_precision() -> None:
    network = Learner.of(shipped()).network()
    again = network_of(record_of_network(network))
    for name in LAYERS:
        np.testing.assert_allclose(again.weights[name], network.weights[name], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(again.biases[name], network.biases[name], rtol=1e-3, atol=1e-6)


def test_a_network_of_other_layers_is_one_clear_line() -> None:
    record = record_of_network(shipped())
    with pytest.raises(InputError, match=r"layer told is None, expected \(1, 32, 3\)"):
        network_of({name: layer for name, layer in record.items() if name != "told"})
    odd = {**record, "told": record["grain"]}
    with pytest.raises(InputError, match=r"layer told is \(9, 1, 16\)"):
        network_of(odd)


def test_batches_follow_from_their_number_and_the_seed() -> None:
    one, two = (Pieces([[city(9501)], [city(9502)]], [1.0, 2.0], seed) for seed in (4, 4))
    first = one(0)
    one(1)
    two(1)
    again = two(0)
    np.testing.assert_array_equal(first.pictures, again.pictures)
    np.testing.assert_array_equal(one(5).axes, two(5).axes)
    assert not np.array_equal(first.pictures, Pieces([[city(9501)], [city(9502)]], [1.0, 2.0], 5)(0).pictures)


def test_axes_turn_with_the_piece() -> None:
    """Where a piece shows a car, the picture's outline there runs along the axis that is told."""
    made = Pieces([[city(9501)]], [1.0], 0)(0)
    off = []
    for picture, middles, axes in zip(made.pictures, made.middles, made.axes, strict=True):
        for y, x in np.argwhere(middles > 0.9):
            if 8 < x < 40 and 8 < y < 40:
                car = np.array([[2 * x + 0.5, 2 * y + 0.5, np.nan, 16.0, 7.2]])
                seen = with_axes((255 * picture).astype(np.uint8), car)[:, 2]
                off.append(axial_difference(seen, 0.5 * np.arctan2(axes[y, x, 1:], axes[y, x, :1])))
    assert len(off) > 20
    assert np.median(off) < np.radians(8)


def test_it_learns_cars_from_nothing() -> None:
    """In few steps: not well, but far better than chance, in a city that it did not see."""
    losses: list[float] = []
    pieces = Pieces([[city(9501), city(9502)]], [1.0], 0)
    learnt(Learner.from_nothing(0), pieces, steps=60, size=3e-3, tell=lambda _, loss: losses.append(loss))
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:5])


def test_the_shipped_network_tells_cars_and_their_axes_in_a_city_it_did_not_see() -> None:
    evidence = evidence_of_network(shipped(), city(9503))
    above = evidence.score > shipped_detector().threshold
    assert evidence.right[above].mean() > 0.85
    assert evidence.right[above].sum() > 0.75 * evidence.cars


def test_learning_on_is_deterministic_and_keeps_whose_pictures_it_learnt_from() -> None:
    few = replace(city(9504), cars=city(9504).cars[:12], complete=False)
    config = DetectionConfig(network_steps=5)
    one, again = (train_on([few], shipped_detector(), config) for _ in range(2))
    assert one.record == again.record
    assert one.record.attribution == shipped_detector().record.attribution
    assert one.threshold == shipped_detector().threshold  # too few to leave some out
    assert one.record.network != shipped_detector().record.network


def test_the_threshold_of_few_cars_is_drawn_towards_the_one_of_before() -> None:
    marked = city(9504)
    own = train_on([marked], shipped_detector(), DetectionConfig(network_steps=2)).record
    strict = shipped_detector().record.model_copy(update={"threshold": shipped_detector().threshold + 0.1})
    drawn = train_on([marked], Detector(strict), DetectionConfig(network_steps=2)).record
    share = len(marked.cars) / (len(marked.cars) + 150)
    assert drawn.threshold - own.threshold == pytest.approx(0.1 * (1 - share))
    assert own.curve is not None
    assert own.curve.chosen is not None
    assert own.curve.threshold[own.curve.chosen] == pytest.approx(own.threshold, abs=0.03)


def test_cars_of_another_size_are_not_learnt_on_from() -> None:
    with pytest.raises(InputError, match="cars of 16 px to continue, expected 20 px"):
        train_on([city(9504)], shipped_detector(), DetectionConfig(working_car_length_px=20.0))


def test_what_the_frame_cuts_deep_is_no_find() -> None:
    """A car alone on a road, whole and cut: of the half car there is no find, of the whole one there is."""
    image = np.full((96, 160), 90, np.uint8)
    image[:] += np.random.default_rng(0).integers(0, 12, image.shape).astype(np.uint8)
    for x in (0, 80):
        image[44:52, max(x - 8, 0) : x + 8] = 225
        image[46:50, max(x - 3, 0) : x + 3] = 60
    found = network_finds(shipped(), image, None)
    sure = found[found[:, 3] > 0]
    assert (np.hypot(sure[:, 0] - 79.5, sure[:, 1] - 47.5) < 4).any()
    assert not (sure[:, 0] < 3).any()
