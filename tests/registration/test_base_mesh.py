"""The mesh between two base images follows what one polyprojective cannot, and says where nothing supports it."""

import cv2
import numpy as np
import pytest

from schemas.arrays import FloatArray, GreyImage
from schemas.flight import BaseConfig
from tests.scenes import city, frame_grid
from velfield.registration.intersensor.base_mesh import BaseMesh, fit_base_mesh
from velfield.registration.transforms import MeshedTransform, PolyprojectiveTransform

SIDE = 700
NORMALISATION = np.array([SIDE / 2, SIDE / 2, 2 / SIDE])
IDENTITY = PolyprojectiveTransform.from_homography(np.eye(3), NORMALISATION, NORMALISATION)


def bend(xy: FloatArray) -> FloatArray:
    """Displacement of up to 3 px, as of a hill."""
    return 3.0 * np.sin(xy / SIDE * 2 * np.pi)[:, ::-1] * (xy[:, :1] / SIDE)


@pytest.fixture(scope="module")
def images() -> tuple[GreyImage, GreyImage]:
    """The given image, brighter and noisy, shows at ``xy + bend(xy)`` what the own one shows at ``xy``."""
    given = city(7, SIDE)
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    at = (xy + bend(xy)).reshape(SIDE, SIDE, 2).astype(np.float32)
    own = cv2.remap(given, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(1).normal(0, 3, given.shape)
    return own, np.clip(40 + 0.7 * given + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def fit(images: tuple[GreyImage, GreyImage]) -> BaseMesh:
    own, given = images
    given = given.copy()
    given[450:, 450:] = 90  # the given image shows nothing here
    return fit_base_mesh(own, np.ones(own.shape, bool), given, IDENTITY, BaseConfig())


def test_the_mesh_follows_a_bend_and_the_answered_rest_is_right(fit: BaseMesh) -> None:
    xy = frame_grid((SIDE, SIDE), 20)
    error = np.hypot(*(fit.transform(xy) - xy - bend(xy)).T)
    answered = np.isfinite(fit.support.at(xy))
    assert np.hypot(*bend(xy).T).max() > 2.5
    assert np.percentile(error[answered], 95) < 0.8
    assert fit.heldout_px < 0.5


def test_where_the_given_image_shows_nothing_there_is_no_answer(fit: BaseMesh) -> None:
    inside = np.array([[600.0, 600.0], [680.0, 680.0]])
    assert np.isnan(fit.support.at(inside)).all()
    assert np.isfinite(fit.support.at(frame_grid((360, 360)))).all()


def test_the_negative_of_an_image_is_matched_too(images: tuple[GreyImage, GreyImage]) -> None:
    own, given = images
    fit = fit_base_mesh(own, np.ones(own.shape, bool), 255 - given, IDENTITY, BaseConfig())
    xy = frame_grid((SIDE, SIDE), 20)
    error = np.hypot(*(fit.transform(xy) - xy - bend(xy)).T)
    assert np.median(error[np.isfinite(fit.support.at(xy))]) < 0.3


def test_a_meshed_transform_inverts() -> None:
    mesh = np.random.default_rng(3).uniform(-2, 2, (5, 5, 2))
    transform = MeshedTransform(IDENTITY, mesh, 140)
    xy = frame_grid((SIDE, SIDE), 37)
    np.testing.assert_allclose(transform.inverse(transform(xy)), xy, atol=1e-3)
    step = np.array([0.01, 0.0])
    middle = np.array([[233.0, 301.0]])
    np.testing.assert_allclose(
        (transform(middle + step) - transform(middle))[0] / 0.01, transform.jacobian(middle)[0, :, 0], atol=1e-3
    )
