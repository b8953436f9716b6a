"""Contact area and peel zone from still images with known geometry."""

from __future__ import annotations

import numpy as np
import pytest

from analysis import AnalysisError
from analysis.contact_image import measure_contact
from analysis.numerics import Array

PIXEL = 2e-6


def disk(radius: float, *, inner: float = 0.0, size: int = 600, noise: float = 4.0) -> Array:
    """A dark contact (60) of ``radius`` on a bright ground (200); a peel zone (120) outside ``inner`` (m)."""
    y, x = np.mgrid[:size, :size]
    distance = np.hypot(x - size / 2, y - size / 2 - 10) * PIXEL
    image = np.where(distance < radius, 120.0 if inner else 60.0, 200.0)
    if inner:
        image = np.where(distance < inner, 60.0, image)
    return image + np.random.default_rng(0).normal(0, noise, image.shape)


def test_area_of_a_disk() -> None:
    found = measure_contact(disk(0.45e-3), PIXEL, scale_uncertainty=0.005)
    assert found.area.value == pytest.approx(np.pi * 0.45e-3**2, abs=3 * found.area.uncertainty)
    assert found.area.uncertainty >= 2 * 0.005 * found.area.value
    assert found.circularity > 0.95
    assert found.equivalent_radius == pytest.approx(0.45e-3, rel=0.01)


def test_the_largest_region_counts_and_holes_are_filled() -> None:
    image = disk(0.4e-3)
    image[40:80, 40:80] = 60.0
    image[300:306, 300:306] = 200.0
    found = measure_contact(image, PIXEL)
    assert found.area.value == pytest.approx(np.pi * 0.4e-3**2, rel=0.01)
    assert not found.mask[60, 60]


def test_colour_and_bright_contacts() -> None:
    grey = disk(0.4e-3)
    colour = np.repeat(grey[..., None], 3, axis=2)
    bright = measure_contact(255 - grey, PIXEL, dark_contact=False)
    assert bright.area.value == pytest.approx(measure_contact(colour, PIXEL).area.value, rel=1e-3)


def test_an_ellipse_is_less_circular() -> None:
    y, x = np.mgrid[:600, :600]
    image = np.where(((x - 300) / 250) ** 2 + ((y - 300) / 90) ** 2 < 1, 50.0, 200.0)
    assert measure_contact(image, PIXEL).circularity < 0.8


def test_peel_zone_width() -> None:
    found = measure_contact(disk(0.5e-3, inner=0.42e-3), PIXEL, peel_zone=True)
    assert found.peel_zone_width is not None
    assert found.peel_zone_width.value == pytest.approx(0.08e-3, abs=6e-6)
    assert found.area.value == pytest.approx(np.pi * 0.5e-3**2, rel=0.02)


@pytest.mark.parametrize("image", [np.full((50, 50), 7.0), np.zeros((4, 4, 4, 4))])
def test_images_without_contact_are_refused(image: Array) -> None:
    with pytest.raises(AnalysisError):
        measure_contact(image, PIXEL)
