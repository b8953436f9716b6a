import numpy as np
import pytest

from model import Gas, Membrane, Parameters, Substrate, membrane
from model.prediction import Outcome


def scene(diameter, pressure, modulus=2.0e6, **membrane_values):
    substrate = Substrate("flat") if diameter is None else Substrate("sphere", diameter)
    return Parameters(
        substrate, membrane=Membrane(youngs_modulus=modulus, **membrane_values), gas=Gas(initial_pressure=pressure)
    )


@pytest.mark.parametrize(
    ("pressure", "force", "fold"),
    [(1600, 0.5305, 1.737), (1000, 0.6079, 1.611), (0, 0.7533, 1.346), (-1000, 0.9157, 1.051), (-2900, 1.2272, 0.688)],
)
def test_flat_equals_an_independent_shooting_code(pressure, force, fold):
    """Values of a separate prototype (40-point scan: folds good to a few um), E_m = 2.1 MPa."""
    prediction = membrane.solve(scene(None, pressure, 2.1e6), points=60)
    assert prediction.outcome is Outcome.PULL_OFF
    assert prediction.pull_off_force == pytest.approx(force, abs=4e-4)
    assert prediction.detachment_position * 1e3 == pytest.approx(fold, abs=1e-3)


def test_sphere_under_suction_equals_the_experiment_without_fitting():
    prediction = membrane.solve(scene(60e-3, -3200), contact_stretch="projected")
    assert prediction.pull_off_distance == pytest.approx(1.14e-3, rel=0.05)
    assert prediction.pull_off_distance == pytest.approx(1.15e-3, abs=1e-5)
    assert prediction.pull_off_force == pytest.approx(0.808, abs=1e-3)
    assert prediction.detachment_position == pytest.approx(0.058e-3, abs=1e-6)


def test_profile_is_what_the_features_say():
    prediction = membrane.solve(scene(60e-3, 1600), points=400)
    assert prediction.position.size == 400
    assert np.all(np.diff(prediction.position) >= -1e-12)
    assert prediction.force.min() == pytest.approx(-prediction.pull_off_force, rel=1e-4)
    assert prediction.position[-1] == pytest.approx(prediction.detachment_position, abs=1e-12)
    assert np.interp(0.0, prediction.retraction, prediction.force) == pytest.approx(0.0, abs=1e-3)
    tension = np.maximum(-prediction.force, 0)
    rise = np.diff(prediction.position)
    assert np.sum((tension[1:] + tension[:-1]) / 2 * rise) == pytest.approx(prediction.adhesion_energy, rel=1e-3)
