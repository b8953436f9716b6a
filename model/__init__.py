"""The physics of a pressurised adhesive membrane: ``predict`` is the one entry point.

The package imports nothing of the project; each solver is imported when it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from model.errors import InvalidParameter, ModelError, NotConverged, UnsupportedScene
from model.parameters import Gas, GasAnchor, Gripper, Membrane, Parameters, Substrate

if TYPE_CHECKING:
    from model.prediction import Prediction

__all__ = [
    "MODELS",
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
        How the membrane is stretched in contact, for ``membrane`` only: see ``model.membrane_contact``.

    Raises
    ------
    InvalidParameter
        A parameter lies outside its physical range, or the model is unknown.
    NotConverged
        The solver could not bound its error.
    """
    if model in ("cone", "cone-2017"):
        from model import cone

        return cone.solve(parameters, contact_stretch=model == "cone", points=points)
    if model == "membrane":
        from model import membrane

        return membrane.solve(parameters, points=points, contact_stretch=contact_stretch or "eml")
    raise InvalidParameter(f"unknown model {model!r}; choose one of {', '.join(MODELS)}")
