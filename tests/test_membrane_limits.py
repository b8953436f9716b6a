"""Limits, invariances and extreme scenes of the membrane model."""

import math
from dataclasses import replace

import numpy as np
import pytest

from analysis.accuracy.membrane_reference import Problem, highest, shoot
from analysis.accuracy.membrane_study import random_scene
from model import (
    Gas,
    GasAnchor,
    Gripper,
    InvalidParameter,
    Membrane,
    ModelError,
    NotConverged,
    Parameters,
    Substrate,
    membrane,
    predict,
)
from model.membrane_path import Memory
from model.prediction import Outcome

SPHERE = Parameters(Substrate("sphere", 60e-3), gas=Gas(-3200.0))
FLAT = Parameters(Substrate("flat"), gas=Gas(-1000.0))


def close(first, second, tolerance):
    assert first.outcome is second.outcome is Outcome.PULL_OFF
    assert first.pull_off_force == pytest.approx(second.pull_off_force, rel=tolerance)
    assert first.pull_off_distance == pytest.approx(second.pull_off_distance, rel=tolerance)


def test_features_equal_shooting():
    """Peak force and detachment against Brent's method over an independent shooting code."""
    problem = Problem.of(SPHERE)
    force = highest(problem, lambda shot: shot.pull, (0.84, 0.90), (0.6, -0.2))
    height = highest(problem, lambda shot: shot.height, (0.40, 0.46), (0.6, -0.2))
    prediction = membrane.solve(SPHERE, contact_stretch="projected", points=16)
    assert prediction.pull_off_force == pytest.approx(force * problem.force_unit, rel=1e-9)
    assert prediction.detachment_position == pytest.approx(height * problem.length, rel=1e-8)


def test_error_estimate_bounds_the_error():
    truth = membrane.solve(SPHERE, tolerance=1e-11, points=16)
    for tolerance in (1e-2, 1e-4, 1e-6):
        rough = membrane.solve(SPHERE, tolerance=tolerance, points=16)
        allowed = rough.numerical_error
        assert abs(rough.pull_off_force - truth.pull_off_force) <= allowed["pull_off_force"] + 1e-12
        assert abs(rough.pull_off_distance - truth.pull_off_distance) <= 3 * allowed["pull_off_distance"] + 1e-14
        assert abs(rough.pull_off_force / truth.pull_off_force - 1) < tolerance


def test_pressure_of_the_profile_obeys_the_gas_law():
    """A chamber without end is one held at P_0."""
    endless = replace(FLAT, gripper=Gripper(chamber_volume=1e3))
    held = replace(FLAT, gas=Gas(-1000.0, anchor=GasAnchor.VENTED))
    close(membrane.solve(endless), membrane.solve(held), 1e-6)
    assert membrane.solve(held).pressure == pytest.approx(-1000.0)


def test_measured_pressure_reproduces_the_gas_law_it_was_taken_from():
    """Up to the peak force; close to detachment P_a(z) has a vertical slope and does not determine the state."""
    free = membrane.solve(FLAT, points=100)
    before = free.position < 0.6e-3
    table = tuple(free.position[before].tolist()), tuple(free.pressure[before].tolist())
    replayed = membrane.solve(replace(FLAT, gas=Gas(-1000.0, anchor=GasAnchor.MEASURED, measured=table)))
    assert replayed.pull_off_force == pytest.approx(free.pull_off_force, rel=1e-4)
    assert replayed.pressure == pytest.approx(np.interp(replayed.position, *table), abs=2.0)


def test_anchor_at_the_start_holds_there():
    scene = replace(SPHERE, gas=Gas(-3200.0, anchor=GasAnchor.START))
    prediction = membrane.solve(scene)
    assert prediction.pressure[0] == pytest.approx(-3200.0, abs=0.5)
    assert prediction.assumptions["gas anchor"] == "start"


@pytest.mark.parametrize("contact", ["eml", "projected", "frictionless", "loading"])
def test_a_huge_sphere_is_a_flat(contact):
    wide = Parameters(Substrate("sphere", 2e5), gas=Gas(-1000.0))
    close(membrane.solve(wide, contact_stretch=contact), membrane.solve(FLAT, contact_stretch=contact), 1e-5)


def test_continuous_where_the_sphere_is_as_wide_as_the_rim():
    below, above = (Parameters(Substrate("sphere", 16e-3 * (1 + side * 1e-9)), gas=Gas(500.0)) for side in (-1, 1))
    first, second = membrane.solve(below), membrane.solve(above)
    assert first.pull_off_force == pytest.approx(second.pull_off_force, rel=1e-6)
    assert first.detachment_position == pytest.approx(second.detachment_position, rel=1e-6)


def test_contact_up_to_the_rim_is_the_limit_of_contacts_close_to_it():
    full = membrane.solve(replace(FLAT, gripper=Gripper(effective_radius=8e-3)))
    nearly = membrane.solve(replace(FLAT, gripper=Gripper(effective_radius=8e-3 * (1 - 1e-5))))
    close(full, nearly, 1e-4)


@pytest.mark.parametrize("factor", [0.1, 7.0])
def test_similar_scenes_scale(factor):
    """All lengths and omega_a by one factor: forces by its square, distances by itself."""
    gripper, film = SPHERE.gripper, SPHERE.membrane
    scaled = Parameters(
        Substrate("sphere", 60e-3 * factor),
        Gripper(gripper.radius * factor, gripper.effective_radius * factor, gripper.chamber_volume * factor**3),
        Membrane(film.youngs_modulus, film.thickness * factor, film.work_of_adhesion * factor),
        SPHERE.gas,
    )
    small, large = membrane.solve(SPHERE), membrane.solve(scaled)
    assert large.pull_off_force == pytest.approx(factor**2 * small.pull_off_force, rel=1e-8)
    assert large.pull_off_distance == pytest.approx(factor * small.pull_off_distance, rel=1e-8)


def test_features_are_smooth_in_the_input():
    first = membrane.solve(SPHERE)
    second = membrane.solve(SPHERE.with_changes(initial_pressure=-3200.0 * (1 + 1e-9)))
    assert second.pull_off_force == pytest.approx(first.pull_off_force, rel=1e-7)
    assert second.pull_off_distance == pytest.approx(first.pull_off_distance, rel=1e-7)


def test_memory_changes_the_cost_and_not_the_answer():
    memory = Memory()
    membrane.solve(SPHERE, memory=memory)
    near = SPHERE.with_changes(initial_pressure=-3150.0)
    warm, cold = membrane.solve(near, memory=memory), membrane.solve(near)
    close(warm, cold, 1e-9)
    assert warm.evaluations["membrane states"] < cold.evaluations["membrane states"]
    other = replace(FLAT, gripper=Gripper(effective_radius=7e-3))
    close(membrane.solve(other, memory=memory), membrane.solve(other), 1e-9)


def test_suction_beyond_the_critical_pressure_is_a_typed_outcome():
    """At a = 6 mm a flat bears no -20 kPa: the membrane is drawn off at once."""
    for pressure in (-20e3, -50e3):
        scene = replace(FLAT, gripper=Gripper(effective_radius=6e-3), gas=Gas(pressure))
        prediction = membrane.solve(scene)
        assert prediction.outcome is Outcome.NO_EQUILIBRIUM
        assert math.isnan(prediction.pull_off_force)
    mild = replace(FLAT, gripper=Gripper(effective_radius=6e-3), gas=Gas(-5e3))
    assert membrane.solve(mild).outcome is Outcome.PULL_OFF


def test_tension_of_an_inflated_membrane_peels_by_itself():
    """An unstretched contact inside a dome under tension T peels where T^2 / 2 E'h exceeds omega_a."""
    weak = Membrane(work_of_adhesion=1e-4)
    dome = replace(FLAT, membrane=weak, gripper=Gripper(effective_radius=3e-3), gas=Gas(2e3, anchor=GasAnchor.VENTED))
    assert membrane.solve(dome).outcome is Outcome.BLOWN_OFF
    assert membrane.solve(replace(dome, membrane=Membrane())).outcome is Outcome.PULL_OFF


@pytest.mark.parametrize("anchor", [GasAnchor.FREE, GasAnchor.START])
@pytest.mark.parametrize("diameter", [3e-3, 15e-3, 0.06, 60.0])
def test_without_pressure_every_sphere_pulls_off(anchor, diameter):
    """A small enough contact stores no stretch and feels no curvature; an endless chamber keeps its pressure."""
    for work in (1e-4, 1e-2, 4.0):
        scene = Parameters(
            Substrate("sphere", diameter),
            Gripper(chamber_volume=1e3),
            Membrane(work_of_adhesion=work),
            Gas(0.0, anchor=anchor),
        )
        assert membrane.solve(scene, points=16, tolerance=1e-4).outcome is Outcome.PULL_OFF


def test_a_chamber_almost_without_volume():
    """The gas admits hardly any change of volume, and no state below vacuum."""
    tiny = replace(FLAT, gripper=Gripper(chamber_volume=1e-10), gas=Gas(8e4))
    prediction = membrane.solve(tiny)
    assert prediction.outcome is Outcome.PULL_OFF
    assert (prediction.pressure > -101_300).all()
    work = np.trapezoid(-prediction.force, prediction.position)
    assert prediction.adhesion_energy == pytest.approx(work, rel=0.02)


def test_a_membrane_that_folds_back_ends_as_self_contact():
    soft = Parameters(Substrate("flat"), Gripper(8e-3, 8e-3, 6e-10), Membrane(1e3, 10e-6, 5.7), Gas(-250.0))
    assert membrane.solve(soft).outcome is Outcome.SELF_CONTACT


def test_no_work_of_adhesion_means_no_adhesion():
    assert membrane.solve(SPHERE.with_changes(work_of_adhesion=0.0)).outcome is Outcome.NO_ADHESION


def test_tension_field_changes_only_wrinkled_membranes():
    taut = membrane.solve(SPHERE)
    close(membrane.solve(SPHERE, tension_field=True), taut, 1e-9)
    assert not any("wrinkle" in warning for warning in taut.warnings)


def test_pressed_membrane_is_flagged():
    pressed = membrane.solve(Parameters(Substrate("flat"), gas=Gas(1600.0)))
    assert any("touches the substrate" in warning for warning in pressed.warnings)


def test_contact_assumption_is_named_and_unknown_ones_refused():
    assert predict(SPHERE, "membrane", contact_stretch="projected").assumptions["contact stretch"] == "projected"
    with pytest.raises(InvalidParameter, match="contact_stretch"):
        membrane.solve(SPHERE, contact_stretch="glued")


def outcome_of(seed):
    scene = random_scene(np.random.default_rng(seed))
    try:
        prediction = membrane.solve(scene, points=40)
    except NotConverged as error:
        assert "membrane" in str(error)
        return "not converged"
    if prediction.outcome is Outcome.PULL_OFF:
        assert prediction.pull_off_force > 0
        assert np.isfinite(prediction.force).all()
        assert np.isfinite(prediction.position).all()
        assert prediction.numerical_error["pull_off_force"] <= 2e-3 * prediction.pull_off_force
    return prediction.outcome.value


@pytest.mark.parametrize("seed", range(6))
def test_extreme_scenes_end_in_a_typed_way(seed):
    assert outcome_of(seed) != "not converged"


@pytest.mark.soak
@pytest.mark.timeout(7200)
def test_a_thousand_extreme_scenes():
    """Every scene ends in a pull-off or in a typed physical outcome."""
    ends = [outcome_of(seed) for seed in range(1000)]
    assert ends.count("not converged") <= 1
    assert ends.count(Outcome.PULL_OFF.value) >= 550


def test_state_of_the_reference_meets_its_own_conditions():
    problem = Problem.of(FLAT)
    shot = shoot(problem, 0.75, (0.45, -0.06))
    assert shoot(problem, 0.75, (0.5, -0.1)).height == pytest.approx(shot.height, rel=1e-10)
    assert issubclass(NotConverged, ModelError)
