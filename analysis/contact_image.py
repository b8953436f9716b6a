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


UNEVEN = 0.2
"""Unevenness of the light, as a share of the contrast, from which on it is worth a remark."""

LEAST_CONTRAST = 3.5
"""Contrast over the scatter within contact and background; noise alone, split in two by a threshold, has 2.6."""

SMALLEST = 16
"""Pixels a side that an image needs."""


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
        The contact region and the grey level that separates it, after the light was evened.
    remarks
        What speaks against the area, in words; empty where nothing does.
    """

    area: Quantity
    circularity: float
    equivalent_radius: float
    peel_zone_width: Quantity | None
    mask: Mask
    threshold: float
    remarks: tuple[str, ...] = ()


def measure_contact(
    image: NDArray[Any],
    metres_per_pixel: float,
    *,
    scale_uncertainty: float = 0.0,
    dark_contact: bool = True,
    peel_zone: bool = False,
    fiber_spacing: float = 0.0,
) -> ContactImage:
    """Measure the contact on a still image.

    1. Grey values, smoothed over 1.5 pixels, or half the spacing of the microfibres where the image resolves them.
    2. The background, a surface of second degree fitted around the contact, is taken off: light is seldom even.
    3. Otsu's threshold separates contact from background.
    4. The largest connected region, holes filled, is the contact; its pixels times the scale squared are the area.
    5. With ``peel_zone`` two thresholds separate three grey levels. The peel zone lies between the darkest region and
       the edge of the middle one; its width is the difference of the radii of the circles of equal area. There is none
       where no middle level stands apart, or where it is narrower than the smoothing of a sharp edge.
    6. Uncertainty: the area between thresholds five per cent of the grey range apart, and the scale.

    Parameters
    ----------
    image
        (rows, columns) grey, or (rows, columns, 3 or 4) colour.
    metres_per_pixel
        Calibrated scale; ``scale_uncertainty`` is relative.
    dark_contact
        Whether contact is darker than the background, as in the papers.
    fiber_spacing
        Of the microfibres, m; 0: the image does not resolve them.

    Raises
    ------
    AnalysisError
        Scale or image are no numbers, the image has no contrast, no region stands out, or the contact is in pieces.
    """
    _check_scale(metres_per_pixel, scale_uncertainty, fiber_spacing)
    blur = max(1.5, fiber_spacing / metres_per_pixel / 2)
    raw = _grey(image, blur)
    if float(np.ptp(raw)) <= 0:
        raise AnalysisError("the image has no contrast; nothing to threshold. Remedy: check the exposure")
    grey, unevenness = _evened(raw if dark_contact else -raw)
    pixel = metres_per_pixel**2
    remarks = [] if unevenness < UNEVEN else [f"uneven light, {unevenness:.0%} of the contrast, was taken off"]
    level, zone = _thresholds(grey, 2)[0], None
    if peel_zone:
        zone = _zone(grey, pixel, scale_uncertainty, 4 * blur * metres_per_pixel)
        if zone is None:
            remarks.append("no peel zone: no third grey level stands apart from contact and background")
        else:
            level = zone[0]
    dark = grey < level
    mask = _largest_region(dark)
    if mask.sum() < dark.sum() / 2:
        raise AnalysisError(
            f"the largest region holds {mask.sum() / dark.sum():.1%} of the contact's pixels: it is in pieces. Remedy: "
            "--fiber-spacing where the image resolves fibres; else crop it to the contact"
        )
    if mask[[0, -1]].any() or mask[:, [0, -1]].any():
        remarks.append("the contact touches the border of the image: the area is too small. Remedy: a wider image")
    area = _area(grey, level, pixel, scale_uncertainty, "largest region below the threshold")
    perimeter = _perimeter(mask)
    return ContactImage(
        area=area,
        circularity=min(1.0, 4 * math.pi * float(mask.sum()) / perimeter**2),
        equivalent_radius=math.sqrt(area.value / math.pi),
        peel_zone_width=None if zone is None else zone[1],
        mask=mask,
        threshold=level,
        remarks=tuple(remarks),
    )


def _check_scale(metres_per_pixel: float, uncertainty: float, spacing: float) -> None:
    if not (math.isfinite(metres_per_pixel) and metres_per_pixel > 0):
        raise AnalysisError(f"a scale of {metres_per_pixel:g} m a pixel. Remedy: give a length above zero")
    if not (0 <= uncertainty < 1 and 0 <= spacing < math.inf):
        raise AnalysisError(
            f"uncertainty of the scale {uncertainty:g}, fibre spacing {spacing:g} m. Remedy: numbers from zero on, "
            "the uncertainty as a share below one"
        )


def _grey(image: NDArray[Any], blur: float) -> Array:
    from scipy.ndimage import gaussian_filter

    values = np.asarray(image, dtype=np.float64)
    if values.ndim == 3 and values.shape[2] in (3, 4):
        values = values[..., :3] @ np.array([0.2126, 0.7152, 0.0722])
    if values.ndim != 2 or min(values.shape) < SMALLEST:
        size = " x ".join(map(str, values.shape))
        raise AnalysisError(f"an image of {size}. Remedy: grey or colour, {SMALLEST} pixels a side or more")
    if not np.isfinite(values).all():
        raise AnalysisError("the image holds values that are no numbers. Remedy: save it again from the camera")
    return np.asarray(gaussian_filter(values, blur), dtype=np.float64)


def _evened(grey: Array) -> tuple[Array, float]:
    """Return the image with its background taken off, and how far that leaves being flat, as a share of the contrast.

    The background is looked for in the frame of the image first, as a plane, then everywhere outside the contact.
    """
    rows, columns = grey.shape
    frame = np.ones(grey.shape, dtype=np.bool_)
    frame[rows // 10 : -(rows // 10), columns // 10 : -(columns // 10)] = False
    background = _surface(grey, frame, degree=1)
    for _ in range(3):
        flat = grey - background
        level = _thresholds(flat, 2)[0]
        background = _surface(grey, flat > (level + float(np.median(flat[flat > level]))) / 2, degree=2)
    flat = grey - background
    level = _thresholds(flat, 2)[0]
    bright, dark = flat[flat > level], flat[flat <= level]
    contrast = float(bright.mean() - dark.mean())
    within = math.sqrt((bright.size * float(bright.var()) + dark.size * float(dark.var())) / flat.size)
    if contrast < LEAST_CONTRAST * within:
        raise AnalysisError(
            "no region of contact stands out from noise and light. Remedy: crop the image, check the light"
        )
    return flat, float(np.ptp(background)) / contrast


def _surface(grey: Array, part: Mask, degree: int) -> Array:
    """Fit a surface to a part of an image; outliers (specks, contact in the frame) are left out in a second pass."""
    rows, columns = (np.linspace(-1, 1, n) for n in grey.shape)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)
    kept = part
    for _ in range(2):
        solution, *_ = np.linalg.lstsq(terms[kept], grey[kept], rcond=None)
        surface = terms @ solution
        off = np.abs(grey - surface)
        kept = part & (off <= 3 * 1.4826 * float(np.median(off[part])) + 1e-9)
    return np.asarray(surface, dtype=np.float64)


def _zone(grey: Array, pixel: float, scale_uncertainty: float, narrowest: float) -> tuple[float, Quantity] | None:
    """Return the outer threshold and the width of the peel zone, or ``None`` where there is none."""
    inner_level, outer_level = _thresholds(grey, 3)
    darkest, middle, bright = (
        float(np.median(grey[part]))
        for part in (grey < inner_level, (grey >= inner_level) & (grey < outer_level), grey >= outer_level)
    )
    if not 0.15 < (middle - darkest) / (bright - darkest) < 0.85:
        return None
    outer = _area(grey, outer_level, pixel, scale_uncertainty, "middle and darkest region")
    inner = _area(grey, inner_level, pixel, scale_uncertainty, "darkest region")
    width = _width(outer, inner)
    return (outer_level, width) if width.value > narrowest else None


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
