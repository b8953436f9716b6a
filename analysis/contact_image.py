"""Contact area and peel-zone width from a still image: threshold, largest region, scale (SI S4; EML Fig. 3f)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.errors import AnalysisError
from analysis.numerics import Array
from analysis.quantity import Quantity

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ContactImage:
    """What a still image says about the contact.

    Attributes
    ----------
    area
        Projected contact area A_pc, m^2.
    circularity
        4 pi A / perimeter^2: 1 for a circle. The papers keep the most circular contacts.
    equivalent_radius
        Radius of the circle of equal area, m.
    peel_zone_width
        Width of the zone being peeled, m, or ``None`` where the image shows two grey levels only.
    mask, threshold
        The contact region and the grey level that separates it.
    """

    area: Quantity
    circularity: float
    equivalent_radius: float
    peel_zone_width: Quantity | None
    mask: Mask
    threshold: float


def measure_contact(
    image: NDArray[Any],
    metres_per_pixel: float,
    *,
    scale_uncertainty: float = 0.0,
    dark_contact: bool = True,
    peel_zone: bool = False,
) -> ContactImage:
    """Measure the contact on a still image.

    1. Grey values, smoothed over the spacing of the microfibres (three pixels at least).
    2. Otsu's threshold separates contact from background; with ``peel_zone`` two thresholds separate three grey levels.
    3. The largest connected region, holes filled, is the contact; its pixels times the scale squared are the area.
    4. The peel zone lies between the darkest region and the edge of the middle one; its width is the difference of
       the radii of the circles of equal area.
    5. Uncertainty: the area between thresholds five per cent of the grey range apart, and the scale.

    Parameters
    ----------
    image
        (rows, columns) grey, or (rows, columns, 3 or 4) colour.
    metres_per_pixel
        Calibrated scale; ``scale_uncertainty`` is relative.
    dark_contact
        Whether contact is darker than the background, as in the papers.

    Raises
    ------
    AnalysisError
        The image has no contrast, or no region stands out.
    """
    grey = _grey(image)
    if not dark_contact:
        grey = grey.max() - grey
    if float(np.ptp(grey)) <= 0:
        raise AnalysisError("the image has no contrast; nothing to threshold. Remedy: check the exposure")
    levels = _thresholds(grey, 3 if peel_zone else 2)
    outer = levels[-1]
    mask = _largest_region(grey < outer)
    pixel = metres_per_pixel**2
    area = _area(grey, outer, pixel, scale_uncertainty, "largest region below the threshold")
    width = None
    if peel_zone:
        inner = _area(grey, levels[0], pixel, scale_uncertainty, "darkest region")
        width = _width(area, inner)
    perimeter = _perimeter(mask)
    return ContactImage(
        area=area,
        circularity=min(1.0, 4 * math.pi * float(mask.sum()) / perimeter**2),
        equivalent_radius=math.sqrt(area.value / math.pi),
        peel_zone_width=width,
        mask=mask,
        threshold=outer,
    )


def _grey(image: NDArray[Any]) -> Array:
    from scipy.ndimage import gaussian_filter

    values = np.asarray(image, dtype=np.float64)
    if values.ndim == 3:
        values = values[..., :3] @ np.array([0.2126, 0.7152, 0.0722])
    if values.ndim != 2:
        raise AnalysisError(f"an image of {values.ndim} dimensions; grey or colour is needed")
    return np.asarray(gaussian_filter(values, 1.5), dtype=np.float64)


def _thresholds(grey: Array, classes: int) -> list[float]:
    from skimage.filters import threshold_multiotsu, threshold_otsu

    if classes == 2:
        return [float(threshold_otsu(grey))]
    return [float(level) for level in threshold_multiotsu(grey, classes=classes)]


def _largest_region(mask: Mask) -> Mask:
    from scipy.ndimage import binary_fill_holes
    from skimage.measure import label

    labels = label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    if sizes.size < 2 or sizes.max() < 16:
        raise AnalysisError(
            "no region of contact stands out. Remedy: crop the image to the contact, or check the light"
        )
    return np.asarray(binary_fill_holes(labels == int(sizes.argmax())), dtype=np.bool_)


def _area(grey: Array, level: float, pixel: float, scale_uncertainty: float, explanation: str) -> Quantity:
    step = 0.05 * float(np.ptp(grey))
    value, low, high = (float(_largest_region(grey < level + shift).sum()) * pixel for shift in (0.0, -step, step))
    parts = {"threshold": abs(high - low) / 2, "scale": 2 * value * scale_uncertainty}
    return Quantity(value, math.hypot(*parts.values()), "m^2", explanation, parts)


def _width(outer: Quantity, inner: Quantity) -> Quantity:
    radii = [math.sqrt(area.value / math.pi) for area in (outer, inner)]
    spread = [area.uncertainty / (2 * math.pi * radius) for area, radius in zip((outer, inner), radii, strict=True)]
    return Quantity(radii[0] - radii[1], math.hypot(*spread), "m", "difference of the equivalent radii")


def _perimeter(mask: Mask) -> float:
    from skimage.measure import perimeter_crofton

    return float(perimeter_crofton(mask, directions=4))
