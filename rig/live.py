"""Live prediction: before pull-off, where the model says it will be, and how sure that is.

From the moment P_0 is reached the curve for the measured P_0 is known; from then on every stretch of the retraction
tells more of the specimen, and the band narrows. Each prediction names the last frame it used. How predictions are made
beside a run is in ``rig.live_run``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rig.live_data import Evidence
from rig.live_prediction import NINETY, LivePrediction

if TYPE_CHECKING:
    from model import Parameters
    from rig.live_fit import Doubt, Estimator

UPDATES = 40
"""A new prediction is due when the stage has gone this part of the predicted D_p."""
SURPRISE = 4.0
"""Data have left the band when they lie so many standard deviations from the announced curve."""
STAYS = 4
"""Predictions for which that is said: the fit soon follows the data, the operator should still see it."""


class LivePredictor:
    """Turns evidence into predictions. Equal evidence in equal order gives equal predictions.

    Parameters
    ----------
    parameters
        The scene's, SI units.
    compliance
        Of the load train, m/N.
    doubt
        What is not known beforehand; the default is calibrated, see ``docs/console.md``.
    model
        Name of the model; the cone is mended by one solution of the exact membrane.
    """

    def __init__(
        self, parameters: Parameters, *, compliance: float = 0.0, doubt: Doubt | None = None, model: str = "cone"
    ) -> None:
        from rig.live_announcement import Draws
        from rig.live_fit import Doubt, Estimator

        self._doubt = doubt or Doubt()
        self._estimator: Estimator = Estimator(parameters, self._doubt, compliance, model)
        self._model = model
        self._nominal_work = parameters.membrane.work_of_adhesion
        self._values: Mapping[str, float] | None = None
        self._last: LivePrediction | None = None
        self._surprised = 0
        self._note = ""
        self._draws = Draws.standard()

    def predict(self, evidence: Evidence) -> LivePrediction | None:
        """Return the prediction from this evidence, or ``None`` where the model has no pull-off to offer."""
        from model import ModelError
        from rig.live_announcement import Announcement
        from rig.live_fit import mend

        began = time.perf_counter()
        try:
            if self._last is None and self._model == "cone":
                middle = {name: value for name, (value, _) in self._estimator.prior(evidence).items()}
                self._estimator.mend = mend(self._estimator.changed(middle))
            fit = self._estimator.fit(evidence, self._values)
        except (ModelError, ArithmeticError, np.linalg.LinAlgError):
            return None  # the scene has no such model, or not yet: the run goes on without
        self._values = fit.values
        self._compare(evidence)
        announcement = Announcement(
            fit,
            evidence,
            self._doubt,
            mended=self._estimator.mend.known,
            nominal_work=self._nominal_work,
            draws=self._draws,
        )
        surprised = self._surprised > 0
        self._last = replace(
            announcement.prediction(),
            inside=not surprised,
            note=self._note if surprised else "",
            runtime_s=time.perf_counter() - began,
        )
        return self._last

    def _compare(self, evidence: Evidence) -> None:
        """Hold what has come since the last announcement against it."""
        last = self._last
        if last is None:
            return
        new = np.flatnonzero(evidence.height - last.zero_height > last.progress * last.pull_off_distance.value)
        if new.size < 2:
            return
        new = new[-max(2, new.size // 3) :]
        place = evidence.height[new] - last.zero_height
        force = float((evidence.force[new] - last.force_zero.value).mean())
        if place.mean() > last.pull_off_distance.low:
            return
        low = float(np.interp(place, last.retraction, last.force_low).mean())
        high = float(np.interp(place, last.retraction, last.force_high).mean())
        sigma = (high - low) / 2 / NINETY + evidence.force_noise
        if abs(force - (low + high) / 2) <= SURPRISE * sigma:
            self._surprised = max(0, self._surprised - 1)
            return
        self._surprised = STAYS
        self._note = (
            f"F_r left the band at z_r = {place.mean() * 1e3:.3f} mm: "
            f"{force:.3f} N measured, {low:.3f} to {high:.3f} N announced"
        )
