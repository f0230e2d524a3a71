"""The dense response is the plain one at every second pixel (the cars it finds: `test_detection`)."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from velfield.bench.detection import plain_response, random_sums, row_response
from velfield.detection.paper.response import dense_response, sampled_response


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(65, 100),
    st.integers(65, 100),
    st.integers(1, 30),
    st.sampled_from([3, 5, 8]),
)
def test_at_every_second_pixel_it_is_the_plain_one(seed: int, height: int, width: int, rounds: int, bits: int) -> None:
    """Also where sums leave 16 bits, as most of 8-bit grey do; but for the rounding of what a round says."""
    image = np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)
    sums = random_sums(rounds, seed=seed, max_area_px=None)
    rounding = np.abs(np.diff(sums.leaves)).sum() / (32767 - rounds) * rounds / 2
    ours, plain = sampled_response(image, sums, grey_bits=bits), plain_response(image, sums, bits)
    np.testing.assert_allclose(ours, plain[::2, ::2], atol=rounding + 1e-5)
    np.testing.assert_allclose(row_response(image, sums, bits), plain, atol=1e-4)


def test_a_picture_smaller_than_the_margin() -> None:
    image = np.full((20, 31), 90, np.uint8)
    assert sampled_response(image, random_sums(5), grey_bits=5).shape == (10, 16)
    assert dense_response(image, random_sums(5)).shape == image.shape
