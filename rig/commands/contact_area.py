"""``rig contact-area``: a still image to the line of an areas file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("image", type=Path, help="still image of the contact (.png, .tif, .jpg)")
    parser.add_argument("--scale", type=float, required=True, metavar="UM", help="micrometres a pixel")
    parser.add_argument(
        "--scale-uncertainty", type=float, default=1.0, metavar="PERCENT", help="of the scale (default: 1 %%)"
    )
    parser.add_argument("--recording", metavar="NAME", help="recording it belongs to (default: the image's name)")
    parser.add_argument("--peel-zone", action="store_true", help="three grey levels: contact, peel zone, background")
    parser.add_argument("--bright", action="store_true", help="the contact is brighter than the background")
    parser.add_argument(
        "--fiber-spacing", type=float, default=0.0, metavar="UM", help="of the microfibres, where the image shows them"
    )
    parser.add_argument("--add", type=Path, metavar="CSV", help="add the line to this areas file (rig analyze --areas)")


def run(arguments: argparse.Namespace) -> int:
    """Measure the image; print or add the line; what else the image says goes to standard error."""
    from analysis.contact_image import measure_contact
    from rig.areas import HEADER, add_area, area_line

    found = measure_contact(
        _read(arguments.image),
        arguments.scale * 1e-6,
        scale_uncertainty=arguments.scale_uncertainty * 1e-2,
        dark_contact=not arguments.bright,
        peel_zone=arguments.peel_zone,
        fiber_spacing=arguments.fiber_spacing * 1e-6,
    )
    recording = arguments.recording or arguments.image.stem
    if arguments.add is None:
        print(HEADER, area_line(recording, found.area), sep="\n")
    else:
        add_area(arguments.add, recording, found.area)
        print(f"{arguments.add}: {area_line(recording, found.area)}")
    radius = found.equivalent_radius * 1e3
    print(f"circularity {found.circularity:.2f}, equivalent radius {radius:.4g} mm", file=sys.stderr)
    if found.peel_zone_width is not None:
        print(f"peel zone {found.peel_zone_width}", file=sys.stderr)
    for remark in found.remarks:
        print(f"rig contact-area: {arguments.image}: {remark}", file=sys.stderr)
    return 0


def _read(path: Path) -> NDArray[Any]:
    import numpy as np

    from rig.errors import FileError

    try:
        import skimage  # noqa: F401
        from PIL import Image
    except ModuleNotFoundError as error:
        raise FileError(
            f"{path}: images need scikit-image. Remedy: pip install 'membrane-adhesion-rig[images]'"
        ) from error
    try:
        with Image.open(path) as picture:
            return np.asarray(picture if picture.mode in ("L", "I;16", "I", "F", "RGB") else picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as error:
        raise FileError(f"{path}: {error}. Remedy: name an image file") from error
