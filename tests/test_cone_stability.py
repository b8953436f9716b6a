"""Random extreme scenes: no number that is not finite, no unsound refusal, invariance, smoothness."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.accuracy.extremes import closed_at_start
from analysis.accuracy.stability_study import is_sound
from model import Gas, GasAnchor, Gripper, Membrane, Parameters, Substrate, cone
from model.prediction import Outcome

MANY = settings(max_examples=400)
SOME = settings(max_examples=150)
FEATURES = ("pull_off_force", "pull_off_distance", "zero_force_position", "detachment_position", "detachment_radius")


def decades(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log(low), math.log(high)).map(math.exp)


@st.composite
def extreme_scenes(draw: st.DrawFn) -> Parameters:
    R_0 = draw(st.one_of(st.just(8e-3), decades(1e-3, 50e-3)))
    r_e = R_0 * draw(st.one_of(st.sampled_from((1.0, 1 - 1e-9, 1 - 1e-15, 0.9125)), st.floats(1e-3, 1.0)))
    near = st.sampled_from((1.0, 1 + 1e-9, 1 - 1e-9)).map(lambda factor: 2 * R_0 * factor)
    spheres = st.one_of(near, decades(1e-3, 1e3)).map(lambda d: Substrate("sphere", d))
    flats = st.one_of(st.none(), decades(1e-3, 1.0)).map(lambda d: Substrate("flat", d))
    return Parameters(
        draw(st.one_of(spheres, flats)),
        Gripper(R_0, r_e, draw(decades(1e-8, 1.0))),
        Membrane(draw(decades(1e3, 1e9)), draw(decades(1e-6, 5e-3)), draw(st.one_of(st.just(0.0), decades(1e-6, 100)))),
        Gas(
            draw(st.one_of(st.just(0.0), st.floats(-101e3, 200e3))),
            anchor=draw(st.sampled_from((GasAnchor.FREE, GasAnchor.START, GasAnchor.VENTED))),
        ),
    )


@st.composite
def plain_scenes(draw: st.DrawFn) -> Parameters:
    substrate = draw(st.one_of(st.just(Substrate("flat")), decades(18e-3, 1.0).map(lambda d: Substrate("sphere", d))))
    return Parameters(
        substrate,
        Gripper(8e-3, draw(st.floats(3e-3, 7.9e-3)), draw(decades(2e-6, 1e-4))),
        Membrane(draw(decades(2e5, 2e7)), draw(decades(2e-5, 1e-3)), draw(decades(0.4, 40.0))),
        Gas(draw(st.floats(-8e3, 8e3)), anchor=draw(st.sampled_from((GasAnchor.FREE, GasAnchor.START)))),
    )


@MANY
@given(extreme_scenes(), st.booleans())
def test_extreme_scenes_end_soundly(parameters, contact_stretch):
    solved = cone.solve(parameters, contact_stretch=contact_stretch, points=24)
    assert is_sound(parameters, solved)
    if solved.outcome is Outcome.PULL_OFF:
        assert solved.pull_off_force > 0
        assert solved.pull_off_distance >= -solved.numerical_error["pull_off_distance"] - 1e-30
        assert 0 <= solved.detachment_radius <= cone.start_radius(parameters.substrate, parameters.gripper)
        assert all(error >= 0 and math.isfinite(error) for error in solved.numerical_error.values())
        # Zero and peak of the force are marked on the path, each where it is known to be.
        marked = solved.numerical_error["zero_force_position"] + solved.numerical_error["retraction_at_pull_off"]
        assert (np.diff(solved.position) >= -1e-15 * np.abs(solved.position).max() - 1e-30 - marked).all()


NOTHING_TO_PULL = Parameters(
    Substrate("sphere", 0.016),
    Gripper(0.008, 0.008, 1.0),
    Membrane(math.exp(7.0), math.exp(-6.0), 0.0),
    Gas(-1.790337893666624e-295),
)


def test_a_force_that_is_less_than_its_rounding_error_says_so():
    solved = cone.solve(NOTHING_TO_PULL, contact_stretch=False)
    assert solved.numerical_error["pull_off_force"] > solved.pull_off_force
    assert any("rounding error" in warning for warning in solved.warnings)


@MANY
@given(extreme_scenes())
def test_a_closed_chamber_is_reported_exactly_when_the_printed_volume_says_so(parameters):
    if parameters.gas.anchor is GasAnchor.VENTED:
        parameters = dataclasses.replace(parameters, gas=Gas(parameters.gas.initial_pressure))
    outcome = cone.solve(parameters, points=16).outcome
    assert (outcome is Outcome.CHAMBER_CLOSED) == closed_at_start(parameters)


@SOME
@given(extreme_scenes())
def test_residual_on_the_profile_is_at_rounding(parameters):
    solved = cone.solve(parameters, points=24)
    if (
        solved.outcome is not Outcome.PULL_OFF
        or parameters.gripper.effective_radius > 0.999 * parameters.gripper.radius
    ):
        return
    from model.cone_error import rounding

    dimensionless, scales = cone.nondimensional(parameters, True)
    free = (solved.contact_radius < solved.contact_radius[0]) & (solved.contact_radius > 0)
    edge = dimensionless.edge(solved.contact_radius[free] / scales.length)
    t = (solved.position[free] / scales.length + edge.drop) / edge.gap
    residual = np.abs(dimensionless.residual(edge, t)[0])
    terms, _, position = rounding(dimensionless, edge, t)
    steepness = np.abs(dimensionless.residual(edge, t)[1])
    allowed = 1e-11 * terms + 1e-13 * steepness * position / edge.gap
    assert (residual <= allowed).all()


@SOME
@given(plain_scenes(), st.floats(0.05, 20.0), st.floats(0.05, 20.0))
def test_invariant_under_scaling_of_length_and_stress(parameters, length, stress):
    """Lengths times a, pressures and moduli times b, work of adhesion times a b: forces times a^2 b."""
    substrate, gripper, membrane, gas = parameters.substrate, parameters.gripper, parameters.membrane, parameters.gas
    scaled = Parameters(
        Substrate(substrate.shape, None if substrate.diameter is None else substrate.diameter * length),
        Gripper(gripper.radius * length, gripper.effective_radius * length, gripper.chamber_volume * length**3),
        Membrane(
            membrane.youngs_modulus * stress, membrane.thickness * length, membrane.work_of_adhesion * length * stress
        ),
        Gas(gas.initial_pressure * stress, gas.atmospheric_pressure * stress, gas.anchor),
    )
    one, other = cone.solve(parameters, points=16), cone.solve(scaled, points=16)
    assert other.outcome is one.outcome
    if one.outcome is Outcome.PULL_OFF:
        assert other.pull_off_force == pytest.approx(one.pull_off_force * length**2 * stress, rel=1e-11)
        assert other.pull_off_distance == pytest.approx(one.pull_off_distance * length, rel=1e-11)
        assert other.adhesion_energy == pytest.approx(one.adhesion_energy * length**3 * stress, rel=1e-9)


@SOME
@given(plain_scenes(), st.sampled_from(("thickness", "work_of_adhesion", "youngs_modulus")), st.sampled_from((-1, 1)))
def test_smooth_under_perturbations_of_1e_12(parameters, quantity, sign):
    value = getattr(parameters.membrane, quantity)
    nudged = parameters.with_changes(**{quantity: value * (1 + sign * 1e-12)})
    one, other = cone.solve(parameters, points=16), cone.solve(nudged, points=16)
    assert other.outcome is one.outcome
    if one.outcome is Outcome.PULL_OFF:
        for name in FEATURES[:2]:
            assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-10), name


@SOME
@given(plain_scenes())
def test_more_adhesion_never_weakens_the_pull(parameters):
    stronger = parameters.with_changes(work_of_adhesion=1.5 * parameters.membrane.work_of_adhesion)
    one, other = cone.solve(parameters, points=16), cone.solve(stronger, points=16)
    if one.outcome is Outcome.PULL_OFF:
        assert other.pull_off_force >= one.pull_off_force * (1 - 1e-12)
        assert other.detachment_position >= one.detachment_position - 1e-15


def order(x: list[float], deviations: list[float]) -> float:
    return float(np.polyfit(np.log(x), np.log(deviations), 1)[0])


def test_a_growing_sphere_becomes_flat_with_first_order():
    flat = cone.solve(Parameters(Substrate("flat"), gas=Gas(1000.0)))
    diameters = [1.0, 10.0, 100.0, 1000.0]
    forces = [cone.solve(Parameters(Substrate("sphere", d), gas=Gas(1000.0))).pull_off_force for d in diameters]
    deviations = [abs(force / flat.pull_off_force - 1) for force in forces]
    assert order(diameters, deviations) == pytest.approx(-1, abs=0.02)
    assert deviations[-1] < 1e-4


def test_a_growing_chamber_becomes_vented_with_first_order():
    vented = cone.solve(Parameters(Substrate("flat"), gas=Gas(1000.0, anchor=GasAnchor.VENTED)))
    volumes = [1e-3, 1e-1, 10.0, 1000.0]
    deviations = [
        abs(
            cone.solve(Parameters(Substrate("flat"), Gripper(chamber_volume=V), gas=Gas(1000.0))).pull_off_force
            / vented.pull_off_force
            - 1
        )
        for V in volumes
    ]
    assert order(volumes, deviations) == pytest.approx(-1, abs=0.02)


@pytest.mark.parametrize("step", [1e-3, 1e-6, 1e-9, 1e-12])
def test_nothing_jumps_where_the_sphere_is_as_wide_as_the_gripper(step):
    inside, outside = (
        cone.solve(Parameters(Substrate("sphere", 16e-3 * (1 + sign * step)), gas=Gas(1000.0))) for sign in (-1, 1)
    )
    assert outside.pull_off_force == pytest.approx(inside.pull_off_force, rel=4 * step)
    assert outside.pull_off_distance == pytest.approx(inside.pull_off_distance, rel=4 * step)


@pytest.mark.soak
@settings(max_examples=20_000)
@given(extreme_scenes(), st.booleans())
def test_twenty_thousand_extreme_scenes_end_soundly(parameters, contact_stretch):
    assert is_sound(parameters, cone.solve(parameters, contact_stretch=contact_stretch, points=24))
