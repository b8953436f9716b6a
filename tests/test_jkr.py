import math

import numpy as np
import pytest

from model import jkr
from model.errors import InvalidParameter

WORK, RADIUS, MODULUS = 4.0, 4e-3, 2.8e6


def test_work_of_adhesion_of_table_s3():
    assert jkr.work_of_adhesion_jkr(78.04e-3, 4e-3) == pytest.approx(4.140, abs=5e-4)
    bounds = jkr.thin_layer_bounds(78.04e-3, 4e-3)
    assert bounds.incompressible_layer == pytest.approx(bounds.half_space / 2)
    assert bounds.incompressible_layer < bounds.winkler_layer < bounds.half_space


def test_jkr_force_control_pull_off_is_exact():
    curve = jkr.jkr_curve(WORK, RADIUS, MODULUS, largest_contact=3e-3, points=20001)
    assert curve.pull_off_force == pytest.approx(1.5 * math.pi * RADIUS * WORK, rel=1e-7)
    assert curve.pull_off_force == pytest.approx(jkr.pull_off_force_jkr(WORK, RADIUS), rel=1e-7)


def test_jkr_curve_ends_at_its_fold_and_equals_the_inverse():
    curve = jkr.jkr_curve(WORK, RADIUS, MODULUS, largest_contact=3e-3)
    fold_force = 5 / 6 * math.pi * RADIUS * WORK  # fixed-grips instability of JKR
    assert curve.force[-1] == pytest.approx(-fold_force, rel=1e-12)
    assert np.all(np.diff(curve.indentation) < 0)
    assert jkr.jkr_force(curve.indentation[:-1], WORK, RADIUS, MODULUS) == pytest.approx(curve.force[:-1], rel=1e-6)
    assert np.isnan(jkr.jkr_force(1.001 * curve.indentation[-1], WORK, RADIUS, MODULUS))


def test_jkr_force_is_the_derivative_of_its_energy():
    """Virtual work: the energy of the contact at given depth and radius has the force as its slope."""

    def energy(depth, contact):
        elastic = MODULUS * (depth**2 * contact - 2 * depth * contact**3 / (3 * RADIUS) + contact**5 / (5 * RADIUS**2))
        return elastic - math.pi * contact**2 * WORK

    depth = 2e-4
    curve = jkr.jkr_curve(WORK, RADIUS, MODULUS, largest_contact=3e-3, points=200001)
    contact = np.interp(-depth, -curve.indentation, curve.contact_radius)
    step = 1e-8
    slope = (energy(depth + step, contact) - energy(depth - step, contact)) / (2 * step)
    assert float(jkr.jkr_force(depth, WORK, RADIUS, MODULUS)) == pytest.approx(slope, rel=1e-6)
    radial = (energy(depth, contact + step) - energy(depth, contact - step)) / (2 * step)
    assert abs(radial) < 1e-4 * 2 * math.pi * contact * WORK


def test_maugis_lies_between_dmt_and_jkr_and_reaches_both():
    unit = math.pi * RADIUS * WORK
    ratios = [
        jkr.pull_off_force_maugis(WORK, RADIUS, MODULUS, strength) / unit for strength in np.geomspace(1, 1e12, 13)
    ]
    assert ratios[0] == pytest.approx(2.0, abs=1e-3)
    assert ratios[-1] == pytest.approx(1.5, abs=1e-3)
    assert np.all(np.diff(ratios) <= 1e-9)


def test_maugis_curve_tends_to_jkr():
    stiff = jkr.maugis_curve(WORK, RADIUS, MODULUS, 1e10, largest_contact=3e-3)
    assert stiff.force == pytest.approx(jkr.jkr_force(stiff.indentation + 1e-12, WORK, RADIUS, MODULUS), rel=2e-3)
    soft = jkr.maugis_curve(WORK, RADIUS, MODULUS, 10.0, largest_contact=3e-3)
    hertz = 4 * MODULUS * soft.contact_radius**3 / (3 * RADIUS) - 2 * math.pi * RADIUS * WORK
    assert soft.force == pytest.approx(hertz, rel=1e-2, abs=1e-2 * 2 * math.pi * RADIUS * WORK)


def test_dmt_curve_ends_at_two_pi_r_w():
    curve = jkr.dmt_curve(WORK, RADIUS, MODULUS, largest_contact=1e-3)
    assert curve.pull_off_force == pytest.approx(2 * math.pi * RADIUS * WORK)
    assert float(curve.force_at(-1e-6)) == 0.0


@pytest.mark.parametrize("layer", ["winkler", "incompressible"])
def test_thin_layer_pull_off_from_its_own_equations(layer):
    """Re-derive 2 pi R w and 3 pi R w by maximising the tension over the contact radius."""
    contact = np.geomspace(1e-5, 1e-1, 400001)
    if layer == "winkler":
        stiffness = 1e11
        depth = contact**2 / (2 * RADIUS) - math.sqrt(2 * WORK / stiffness)
        force = 2 * math.pi * stiffness * (depth * contact**2 / 2 - contact**4 / (8 * RADIUS))
        expected = jkr.thin_layer_bounds(1.0, RADIUS).winkler_layer
    else:
        compliance = 1e-20  # energy per area over squared pressure gradient, h^3 / (6 mu)
        depth = contact**2 / (4 * RADIUS) - 4 * math.sqrt(WORK * compliance) / contact
        force = math.pi / (2 * compliance) * (depth * contact**4 / 8 - contact**6 / (48 * RADIUS))
        expected = jkr.thin_layer_bounds(1.0, RADIUS).incompressible_layer
    assert WORK / -force.min() == pytest.approx(expected, rel=1e-6)


def test_tabor_and_maugis_parameters_are_proportional():
    separation = 1e-6
    mu = jkr.tabor_parameter(WORK, RADIUS, MODULUS, separation)
    assert mu == pytest.approx((RADIUS * WORK**2 / (MODULUS**2 * separation**3)) ** (1 / 3))
    strength = jkr.LENNARD_JONES_STRENGTH * WORK / separation
    assert jkr.maugis_parameter(WORK, RADIUS, MODULUS, strength) == pytest.approx(1.157 * mu, rel=1e-3)


def test_impossible_values_are_named():
    with pytest.raises(InvalidParameter, match="radius"):
        jkr.work_of_adhesion_jkr(1.0, 0.0)
    with pytest.raises(InvalidParameter, match="largest_contact"):
        jkr.jkr_curve(WORK, RADIUS, MODULUS, largest_contact=1e-6)
