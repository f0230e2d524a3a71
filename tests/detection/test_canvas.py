"""The network on canvases, as on a GPU: to the bits of each crop by itself, as the processor computes both."""

import pickle
from collections.abc import Sequence

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.arrays import GreyImage, IntArray
from tests.detection.test_cnn_layers import grey, random_network
from velfield.bench.scenes import simulated_image
from velfield.detection.cnn.canvas import (
    Canvases,
    _MaskedGraph,
    cut_into_pieces,
    fill_kernel,
    pack,
    place_kernel,
    reading_scales,
)
from velfield.detection.cnn.detector import CnnDetector
from velfield.detection.cnn.model import FULL_TTA, HALO_PX, detect_cars, predict_crops, predict_heatmap
from velfield.detection.cnn.network import (
    FORMER_TOPOLOGY,
    TOPOLOGY,
    Conv,
    DepthToSpace,
    Network,
    Residual,
    SpaceToDepth,
    Topology,
    convolutions,
)
from velfield.detection.registry import shipped_detector

SIDES = 64, 320
Rectangle = tuple[int, int, int, int]
OTHER_TOPOLOGY: Topology = (
    Conv("stem", 3, 1, 4),
    Conv("whole", 3, 4, 4),
    SpaceToDepth(),
    Conv("blocks", 3, 16, 8),
    Conv("halving", 4, 8, 8),
    Residual((SpaceToDepth(), Conv("lowest", 3, 32, 8), Conv("up", 1, 8, 32, relu=False), DepthToSpace()), relu=True),
    Conv("head", 1, 8, 12, relu=False),
    DepthToSpace(),
)
"""Kernels that reach over at all resolutions, of blocks too."""
MANY = [(0, 0, 64, 96), (0, 104, 40, 40), (64, 104, 48, 64), (304, 8, 16, 312), (128, 0, 96, 96), (240, 240, 64, 80)]
LARGE = [(0, 0, 320, 328), (0, 336, 16, 472), (32, 344, 456, 456), (496, 0, 8, 8)]


def shipped() -> Network:
    detector = shipped_detector()
    assert isinstance(detector, CnnDetector)
    return detector.network


def on_canvases(network: Network, sides_px: Sequence[int] = SIDES) -> Network:
    """The network as on a GPU, with small canvases on the processor."""
    same = Network(network.weights, network.biases, network.topology)
    same.__dict__["canvases"] = Canvases(same, "cpu", sides_px)
    return same


def as_rows(crops: list[Rectangle]) -> IntArray:
    return np.array(crops, np.int64).reshape(-1, 4)


def assert_same(found: tuple[object, object], expected: tuple[object, object]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)  # type: ignore[call-overload]


@pytest.mark.parametrize("topology", [TOPOLOGY, FORMER_TOPOLOGY, OTHER_TOPOLOGY])
@pytest.mark.parametrize("crops", [MANY, LARGE, MANY[:1], []], ids=["many", "large", "one", "none"])
def test_crops_are_predicted_as_if_each_were_alone(topology: Topology, crops: list[Rectangle]) -> None:
    """Crops of many sizes, at the image's edges, larger than a canvas; of an image that is a part of another one."""
    network = random_network(1, topology)
    image, rows = grey(5, 504, 900)[:, 50:858], as_rows(crops)
    assert_same(predict_crops(on_canvases(network), image, rows), predict_crops(network, image, rows))


def test_crops_of_any_alignment_of_an_older_network_are() -> None:
    network, image = random_network(2, FORMER_TOPOLOGY), grey(6, 200, 200)
    rows = as_rows([(4, 0, 12, 20), (60, 100, 140, 100), (20, 28, 4, 4)])
    assert network.alignment == 4
    assert_same(predict_crops(on_canvases(network), image, rows), predict_crops(network, image, rows))


@pytest.mark.parametrize("border_px", [0, 16])
@pytest.mark.parametrize("shape", [(480, 640), (333, 471), (64, 64), (40, 51), (1, 9)])
def test_an_image_is_predicted_as_in_one_piece(shape: tuple[int, int], border_px: int) -> None:
    network, image = shipped(), grey(7, *shape)
    probability, orientation = predict_heatmap(on_canvases(network), image, border_px=border_px)
    expected = predict_heatmap(network, image, border_px=border_px)
    assert probability.shape == orientation.shape[1:] == (-(-shape[0] // 2), -(-shape[1] // 2))
    rows, columns = probability.shape  # of an image in one piece the orientation is padded
    assert_same((probability, orientation), (expected[0], expected[1][:, :rows, :columns]))


@pytest.mark.parametrize("shape", [(16, 48, 48), (3, 352, 64), (1, 8, 8), (0, 48, 48)])
def test_a_batch_is_predicted_as_without_canvases(shape: tuple[int, int, int]) -> None:
    network, images = shipped(), grey(8, *shape)
    found = on_canvases(network).predict(images)
    assert_same(found, network.predict(images) if len(images) else (np.empty((0, 24, 24)), np.empty((0, 2, 24, 24))))


def test_detections_are_the_same_with_test_time_augmentation_too() -> None:
    network, image = shipped(), simulated_image(9503).image[120:320, 120:360]
    expected = detect_cars(network, image, None, FULL_TTA)
    assert len(expected)
    np.testing.assert_array_equal(detect_cars(on_canvases(network), image, None, FULL_TTA), expected)


def test_without_masks_crops_would_touch_each_other() -> None:
    network, image = random_network(3), grey(10, 64, 64)
    crops = as_rows([(0, 0, 24, 24), (0, 32, 24, 24)])
    canvases = Canvases(network, "cpu", SIDES)
    expected = predict_crops(network, image, crops)

    class Unmasked:
        def run(self, names: None, feed: dict[str, GreyImage]) -> list[object]:
            return session.run(names, feed | {"mask": np.ones_like(feed["mask"])})  # type: ignore[no-any-return]

    session = canvases.sessions[64]
    canvases.sessions[64] = Unmasked()
    assert np.abs(canvases.predict_crops(image, crops)[1] - expected[1]).max() > 1e-3


@pytest.mark.parametrize("topology", [TOPOLOGY, FORMER_TOPOLOGY, OTHER_TOPOLOGY])
def test_each_convolution_that_reaches_over_reads_zeros_between_the_images(topology: Topology) -> None:
    model = onnx.ModelProto.FromString(_MaskedGraph(random_network(0, topology)).model())
    onnx.checker.check_model(model, full_check=True)
    reaching = [layer for layer in convolutions(topology).values() if layer.kernel > 1]
    masked = [node for node in model.graph.node if node.op_type == "Mul"]
    assert len(masked) == len(reaching)  # the image is zero there, and scaled by one more
    gap = random_network(0, topology).alignment
    for name, scale in reading_scales(topology).items():
        (weights,) = (one for one in model.graph.initializer if one.name == f"{name}.weight")
        assert scale * (weights.dims[2] // 3) <= gap, "no kernel reaches over the gap"


def test_canvases_that_tiles_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="expected multiples of 8 above 128"):
        Canvases(random_network(), "cpu", (64, 128))
    with pytest.raises(ValueError, match="expected multiples of 8"):
        Canvases(random_network(), "cpu", (60, 320))


def test_a_network_crosses_processes_without_its_canvases() -> None:
    again = pickle.loads(pickle.dumps(on_canvases(random_network())))
    assert "canvases" not in vars(again)


UNITS = st.integers(1, 40).map(lambda k: 8 * k)


@given(st.lists(st.tuples(UNITS, UNITS), max_size=30))
def test_pieces_lie_on_canvases_with_a_gap_between_them(sizes: list[tuple[int, int]]) -> None:
    pieces = pieces_of([(0, 0, height, width) for height, width in sizes])
    places = pack(pieces, 320, 8)
    taken = np.zeros((places[:, 0].max(initial=0) + 1, 328, 328), int)
    for (canvas, y, x), (height, width) in zip(places, sizes, strict=True):
        assert y + height <= 320
        assert x + width <= 320
        assert y % 8 == x % 8 == 0
        taken[canvas, y : y + height + 8, x : x + width + 8] += 1
    assert taken.max(initial=0) <= 1
    assert set(places[:, 0]) == set(range(len(taken) if len(sizes) else 0))


@given(UNITS.map(lambda size: 4 * size), UNITS.map(lambda size: 4 * size), st.sampled_from([4, 8]))
def test_pieces_without_their_halos_are_the_crop_once(height: int, width: int, unit: int) -> None:
    pieces = cut_into_pieces(as_rows([(16, 24, height, width)]), 320, unit)
    assert (pieces[:, 2:4] <= 320).all()
    assert (pieces[:, :4] % unit == 0).all()
    covered = np.zeros((height, width), int)
    for top, left, rows, columns, above, before, below, after in pieces - [16, 24, 0, 0, 0, 0, 0, 0]:
        inner = top + above, left + before, top + rows - below, left + columns - after
        covered[inner[0] : inner[2], inner[1] : inner[3]] += 1
        edges = top == 0, left == 0, top + rows == height, left + columns == width
        halos = above, before, below, after
        assert all(edge or halo == HALO_PX for halo, edge in zip(halos, edges, strict=True))
        assert min(top, left) >= 0
        assert top + rows <= height
        assert left + columns <= width
    assert (covered == 1).all()


def pieces_of(crops: list[Rectangle]) -> IntArray:
    return cut_into_pieces(as_rows(crops), 320, 8)


def test_what_is_copied_is_what_slices_copy() -> None:
    image = grey(11, 480, 520)
    pieces = pieces_of([(0, 0, 448, 480), (456, 488, 24, 32), (456, 0, 16, 8)])
    places = pack(pieces, 320, 8)
    rng = np.random.default_rng(12)
    probability, orientation = np.zeros((240, 260), np.float32), np.zeros((2, 240, 260), np.float32)
    expected = np.zeros((3, 240, 260), np.float32)
    for canvas in range(places[:, 0].max() + 1):
        pixels, mask = np.zeros((320, 320), np.uint8), np.zeros((40, 40), np.uint8)
        fill_kernel(image, pieces, places, canvas, 8, pixels, mask)
        wanted, where = np.zeros_like(pixels), np.zeros_like(pixels)
        heatmap, vector = rng.random((160, 160), np.float32), rng.random((2, 160, 160), np.float32)
        place_kernel(heatmap, vector, pieces, places, canvas, probability, orientation)
        for (top, left, height, width, above, before, below, after), (number, y, x) in zip(pieces, places, strict=True):
            if number == canvas:
                wanted[y : y + height, x : x + width] = image[top : top + height, left : left + width]
                where[y : y + height, x : x + width] = 1
                of_piece = np.stack([heatmap, *vector])[:, y // 2 : (y + height) // 2, x // 2 : (x + width) // 2]
                of_inner = of_piece[:, above // 2 : (height - below) // 2, before // 2 : (width - after) // 2]
                row, column = (top + above) // 2, (left + before) // 2
                expected[:, row : row + of_inner.shape[1], column : column + of_inner.shape[2]] = of_inner
        np.testing.assert_array_equal(pixels, wanted)
        np.testing.assert_array_equal(np.kron(mask, np.ones((8, 8), np.uint8)), where)
    np.testing.assert_array_equal(np.stack([probability, *orientation]), expected)
