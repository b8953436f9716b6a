"""The physics of a pressurised adhesive membrane: ``predict`` is the one entry point.

The package imports nothing of the project; each solver is imported when it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.errors import InvalidParameter, ModelError, NotConverged, UnsupportedScene
from model.parameters import ContactStretch, Gas, GasAnchor, Gripper, Membrane, Parameters, Substrate

if TYPE_CHECKING:
    from model.prediction import Prediction

__all__ = [
    "MODELS",
    "ContactStretch",
    "Gas",
    "GasAnchor",
    "Gripper",
    "InvalidParameter",
    "Membrane",
    "ModelError",
    "NotConverged",
    "Parameters",
    "Substrate",
    "UnsupportedScene",
    "predict",
]

MODELS = ("cone", "cone-2017", "membrane")
"""Names of the adhesion models, as the command line takes them."""

_FIXED_STRETCH = (
    "model {!r} has no choice of contact stretch: the cone stores W_2 of EML Eq. 5 in contact, cone-2017 nothing; "
    "choose the model 'membrane' for another assumption"
)


def predict(
    parameters: Parameters, model: str = "cone", *, points: int = 200, contact_stretch: str | None = None
) -> Prediction:
    """Predict one pull-off test.

    Parameters
    ----------
    parameters
        The scene, SI units.
    model
        One of ``MODELS``.
    points
        Number of points of the returned profile; the features do not depend on it.
    contact_stretch
        How the membrane is stretched in contact, for ``membrane`` only: see ``ContactStretch`` (default: ``eml``).

    Raises
    ------
    InvalidParameter
        A parameter lies outside its physical range, the model is unknown or leaves no choice of contact stretch.
    NotConverged
        The solver could not bound its error.
    """
    if model in ("cone", "cone-2017"):
        if contact_stretch is not None:
            raise InvalidParameter(_FIXED_STRETCH.format(model))
        from model import cone

        return cone.solve(parameters, contact_stretch=model == "cone", points=points)
    if model == "membrane":
        from model import membrane

        return membrane.solve(parameters, points=points, contact_stretch=contact_stretch or "eml")
    raise InvalidParameter(f"unknown model {model!r}; choose one of {', '.join(MODELS)}")
