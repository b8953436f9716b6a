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


def test_one_fibre_is_not_taken_for_the_contact() -> None:
    y, x = np.mgrid[:400, :400]
    fibres = np.hypot((x % 25) - 12, (y % 25) - 12) < 9
    image = np.where(fibres & (np.hypot(x - 200, y - 200) < 125), 60.0, 200.0)
    with pytest.raises(AnalysisError, match=r"in pieces.*--fiber-spacing"):
        measure_contact(image, 4e-6)
    joined = measure_contact(image, 4e-6, fiber_spacing=100e-6)
    assert joined.area.value == pytest.approx(np.pi * 0.5e-3**2, rel=0.05)


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


def test_a_sharp_edge_is_no_peel_zone() -> None:
    for noise in (0.0, 4.0, 12.0):
        found = measure_contact(disk(0.45e-3, noise=noise), PIXEL, peel_zone=True)
        assert found.peel_zone_width is None
        assert any("no peel zone" in remark for remark in found.remarks)
        assert found.area.value == pytest.approx(np.pi * 0.45e-3**2, rel=0.01)


@pytest.mark.parametrize("light", ["plane", "corners", "shade"])
@pytest.mark.parametrize("radius", [0.15e-3, 0.45e-3])
def test_uneven_light_is_taken_off(light: str, radius: float) -> None:
    y, x = np.mgrid[-1:1:600j, -1:1:600j]
    even = disk(radius)
    image = {"plane": even + 60 * (x + 0.3 * y), "corners": even - 50 * (x**2 + y**2), "shade": even * (1 - 0.3 * x)}
    found = measure_contact(image[light], PIXEL)
    assert found.area.value == pytest.approx(np.pi * radius**2, rel=0.02)
    assert any("uneven light" in remark for remark in found.remarks)
    assert not measure_contact(even, PIXEL).remarks


def test_a_contact_at_the_border_is_remarked() -> None:
    found = measure_contact(disk(0.45e-3)[:, 150:], PIXEL)
    assert any("border" in remark for remark in found.remarks)


def test_fibres_that_the_image_resolves_are_one_contact() -> None:
    y, x = np.mgrid[:600, :600]
    distance = np.hypot(x - 300, y - 300) * PIXEL
    fibers = np.hypot(x % 25 - 12, y % 25 - 12) < 9
    image = np.where((distance < 0.45e-3) & fibers, 60.0, 200.0)
    found = measure_contact(image, PIXEL, fiber_spacing=25 * PIXEL)
    assert found.area.value == pytest.approx(np.pi * 0.45e-3**2, rel=0.08)


@pytest.mark.parametrize("scale", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_scale_that_is_none_is_refused(scale: float) -> None:
    with pytest.raises(AnalysisError, match="scale"):
        measure_contact(disk(0.4e-3), scale)


def test_an_image_with_holes_is_refused() -> None:
    image = disk(0.4e-3)
    image[3, 3] = np.nan
    with pytest.raises(AnalysisError, match="no numbers"):
        measure_contact(image, PIXEL)
    with pytest.raises(AnalysisError, match="uncertainty"):
        measure_contact(disk(0.4e-3), PIXEL, scale_uncertainty=-0.1)


@pytest.mark.parametrize(
    "image",
    [
        np.full((50, 50), 7.0),
        np.zeros((4, 4, 4, 4)),
        np.random.default_rng(0).normal(100, 5, (300, 300)),
        np.linspace(0, 255, 300) + np.random.default_rng(0).normal(0, 5, (300, 300)),
    ],
)
def test_images_without_contact_are_refused(image: Array) -> None:
    with pytest.raises(AnalysisError):
        measure_contact(image, PIXEL)
