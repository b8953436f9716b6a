"""The cone model against printed sanity values, the energy itself, limits and the high-precision reference."""

from __future__ import annotations

import dataclasses
import math
import random

import numpy as np
import pytest

from analysis.accuracy.extremes import ordinary_scene
from model import Gas, GasAnchor, Gripper, InvalidParameter, Membrane, Parameters, Substrate, cone, predict, reference
from model.cone_branch import Branch
from model.cone_path import trace
from model.prediction import Outcome
from model.reference import Energy


def scene(
    diameter: float | None = None,
    pressure: float = 1000.0,
    anchor: GasAnchor = GasAnchor.FREE,
    *,
    membrane: Membrane | None = None,
    gripper: Gripper | None = None,
) -> Parameters:
    substrate = Substrate("flat") if diameter is None else Substrate("sphere", diameter)
    return Parameters(substrate, gripper or Gripper(), membrane or Membrane(), Gas(pressure, anchor=anchor))


PAPERS = [
    scene(None, 1000.0),
    scene(None, -1000.0),
    scene(60e-3, 1000.0),
    scene(60e-3, -3200.0),
    scene(30e-3, 2700.0),
    scene(30e-3, -4100.0),
    scene(15e-3, 2000.0),
    scene(15e-3, -700.0),
    scene(60e-3, 0.0, GasAnchor.VENTED),
    scene(30e-3, -1000.0, GasAnchor.START),
]


@pytest.mark.parametrize(
    ("parameters", "force", "detachment", "distance"),
    [
        (scene(None, 1000.0), 0.604620, 1.578392e-3, 1.430544e-3),
        (scene(None, -1000.0), 0.910939, 1.242698e-3, 1.242698e-3),
        (scene(60e-3, 1000.0), 0.340624, None, 2.155749e-3),
    ],
)
def test_agrees_with_an_independent_solution(parameters, force, detachment, distance):
    solved = predict(parameters)
    assert solved.pull_off_force == pytest.approx(force, abs=6e-7)
    assert solved.pull_off_distance == pytest.approx(distance, abs=6e-10)
    if detachment is not None:
        assert solved.detachment_position == pytest.approx(detachment, abs=6e-10)


@pytest.mark.parametrize("contact_stretch", [True, False])
@pytest.mark.parametrize("parameters", PAPERS, ids=str)
def test_features_agree_with_the_reference_within_their_own_error(parameters, contact_stretch):
    solved = cone.solve(parameters, contact_stretch=contact_stretch)
    truth = reference.solve(parameters, contact_stretch=contact_stretch, digits=24)
    for name, error in solved.numerical_error.items():
        if name == "onset_position" or (name == "adhesion_energy" and truth.jumps):
            continue
        assert abs(getattr(solved, name) - getattr(truth, name)) <= error + 1e-22, name
        assert error <= 1e-10 * max(abs(getattr(solved, name)), 1e-6), name


def test_random_ordinary_scenes_agree_with_the_reference():
    source = random.Random(5)
    for _ in range(12):
        parameters = ordinary_scene(source)
        solved = cone.solve(parameters)
        truth = reference.solve(parameters, digits=24)
        assert solved.pull_off_force == pytest.approx(float(truth.pull_off_force), rel=1e-12), parameters
        assert solved.pull_off_distance == pytest.approx(float(truth.pull_off_distance), rel=1e-12), parameters


@pytest.mark.parametrize("parameters", PAPERS, ids=str)
def test_profile_is_in_equilibrium_and_its_force_is_the_slope_of_the_energy(parameters):
    """Checked on the printed energy, with complex steps instead of our derivatives."""
    solved = cone.solve(parameters, points=60)
    energy = Energy(parameters, True, np, float)
    r, z, step = solved.contact_radius, solved.position, 1e-30
    free = r < r[0] * (1 - 1e-12)
    with np.errstate(all="ignore"):
        force = -np.imag(energy(r + 0j, z + 1j * step)) / step
        slope = np.imag(energy(r + 1j * step, z + 0j)) / step
    scale = 2 * np.pi * r * parameters.membrane.work_of_adhesion
    inside = r > 0
    assert force[inside] == pytest.approx(solved.force[inside], rel=1e-10, abs=1e-10 * solved.pull_off_force)
    assert np.abs(slope[free & inside] / scale[free & inside]).max() < 1e-8
    held = slope[: np.argmax(free) - 1] / scale[0]
    assert (held < 1e-9).all()


@pytest.mark.parametrize("parameters", PAPERS, ids=str)
def test_profile_runs_from_the_start_to_detachment(parameters):
    solved = cone.solve(parameters, points=150)
    assert solved.position.size == 150
    assert (np.diff(solved.position) >= 0).all()
    assert (np.diff(solved.contact_radius) <= 1e-18).all()
    assert solved.position[-1] == pytest.approx(solved.detachment_position)
    assert solved.force.min() == pytest.approx(-solved.pull_off_force, rel=1e-12)
    assert 0.0 in solved.retraction
    assert solved.stable.all()
    assert list(solved.frame().columns) == [
        "position_m",
        "retraction_m",
        "force_N",
        "pressure_Pa",
        "contact_radius_m",
        "stable",
    ]


@pytest.mark.parametrize("parameters", PAPERS, ids=str)
def test_adhesion_energy_is_the_area_under_the_tensile_force(parameters):
    solved = cone.solve(parameters, points=4000)
    after = solved.retraction >= 0
    area = -np.trapezoid(solved.force[after], solved.position[after])
    assert solved.adhesion_energy == pytest.approx(area, rel=2e-6)


@pytest.mark.parametrize("parameters", PAPERS, ids=str)
def test_scan_of_the_branch_does_not_move_the_features(parameters):
    coarse, fine = (cone.solve(parameters, nodes=nodes) for nodes in (16, 700))
    assert coarse.pull_off_force == pytest.approx(fine.pull_off_force, rel=1e-13)
    assert coarse.pull_off_distance == pytest.approx(fine.pull_off_distance, rel=1e-13)


def test_branch_is_stable_exactly_where_its_height_falls_with_the_radius():
    dimensionless, _ = cone.nondimensional(scene(60e-3), True)
    branch = Branch(dimensionless, 64)
    edge = dimensionless.edge(branch.radius[:-1])
    state = dimensionless.state(edge, branch.t[:-1])
    second = state.residual_radius + state.residual_t * (branch.t[:-1] + edge.slope) / edge.gap
    assert ((second > 0) == (branch.climb[:-1] < 0)).all()


@pytest.mark.parametrize("parameters", PAPERS, ids=str)
def test_the_branch_beyond_detachment_is_unstable(parameters):
    branch = cone.equilibria(parameters)
    solved = cone.solve(parameters)
    beyond = branch.contact_radius < solved.detachment_radius * (1 - 1e-9)
    assert not branch.stable[beyond].any()
    assert branch.stable[~beyond].all()
    assert branch.position.max() <= solved.detachment_position * (1 + 1e-12)


def test_a_branch_with_two_maxima_jumps_at_the_first():
    """A narrow suction-dominated contact: found by search, kept because it jumps."""
    source = random.Random(11)
    from analysis.accuracy.extremes import random_scene

    jumping = []
    while len(jumping) < 3:
        candidate = random_scene(source)
        solved = cone.solve(candidate, points=64)
        if solved.jumps:
            jumping.append((candidate, solved))
    for candidate, solved in jumping:
        for jump in solved.jumps:
            assert jump.radius_after < jump.radius_before
            assert jump.position < solved.detachment_position
        dimensionless, scales = cone.nondimensional(candidate, True)
        edge = dimensionless.start_edge
        start = (dimensionless.start_position + edge.drop) / edge.gap if edge.gap > 0 else -edge.slope
        path = trace(Branch(dimensionless, 1000), start)
        heights = [stretch.last.position for stretch in path.stretches]
        assert heights == sorted(heights)
        assert heights[-1] * scales.length == pytest.approx(solved.detachment_position, rel=1e-10, abs=1e-18)


@pytest.mark.parametrize(
    ("diameter", "expected_position", "expected_radius"),
    [
        (15e-3, -7.5e-3, 7.5e-3**2 / 8e-3),
        (15.6e-3, -7.8e-3, 7.3e-3),
        (16e-3, -8e-3, 7.3e-3),
        (60e-3, -30e-3 + math.sqrt(30e-3**2 - 8e-3**2), 7.3e-3),
    ],
)
def test_start_follows_the_regimes_of_the_paper(diameter, expected_position, expected_radius):
    solved = cone.solve(scene(diameter))
    assert solved.position[0] == pytest.approx(expected_position, rel=1e-12)
    assert solved.contact_radius[0] == pytest.approx(expected_radius, rel=1e-12)


def test_a_disk_narrower_than_the_contact_sets_its_radius():
    solved = cone.solve(dataclasses.replace(scene(), substrate=Substrate("flat", 10e-3)))
    assert solved.contact_radius[0] == pytest.approx(5e-3)


@pytest.mark.parametrize("diameter", [None, 60e-3, 15e-3])
def test_start_anchor_holds_the_pressure_at_the_start(diameter):
    solved = cone.solve(scene(diameter, -900.0, GasAnchor.START))
    assert solved.pressure[0] == pytest.approx(-900.0, rel=1e-9)


def test_free_anchor_compresses_the_gas_at_the_start():
    """Known for 60 mm: V(z_0, r_i) / V_0 = 0.985, so P starts 1.6 kPa above P_0."""
    assert cone.solve(scene(60e-3, 0.0)).pressure[0] == pytest.approx(1.6e3, rel=0.05)


def test_vented_chamber_keeps_its_pressure():
    pressure = cone.solve(scene(60e-3, -500.0, GasAnchor.VENTED)).pressure
    assert pressure == pytest.approx(np.full(pressure.size, -500.0))


@pytest.mark.parametrize("diameter", [None, 60e-3, 20e-3])
def test_constant_measured_pressure_is_a_vented_chamber(diameter):
    vented = cone.solve(scene(diameter, -800.0, GasAnchor.VENTED))
    gas = Gas(anchor=GasAnchor.MEASURED, measured=((-0.05, 0.0, 0.05), (-800.0, -800.0, -800.0)))
    driven = cone.solve(dataclasses.replace(scene(diameter), gas=gas))
    assert driven.pull_off_force == pytest.approx(vented.pull_off_force, rel=1e-12)
    assert driven.pull_off_distance == pytest.approx(vented.pull_off_distance, rel=1e-12)


def test_pressure_measured_on_a_path_gives_back_its_force():
    free = cone.solve(scene(60e-3), points=4000)
    rising = np.concatenate(([True], np.diff(free.position) > 0))
    gas = Gas(anchor=GasAnchor.MEASURED, measured=(tuple(free.position[rising]), tuple(free.pressure[rising])))
    driven = cone.solve(dataclasses.replace(scene(60e-3), gas=gas))
    assert driven.pull_off_force == pytest.approx(free.pull_off_force, rel=1e-6)
    assert driven.zero_force_position == pytest.approx(free.zero_force_position, rel=1e-5)


def test_contact_up_to_the_rim_starts_regularly():
    """The differences of SI Fig. S8 oscillate at r_e = R_0; the slope of the cone stays finite there."""
    solved = cone.solve(scene(None, 1000.0, gripper=Gripper(effective_radius=8e-3)))
    near = cone.solve(scene(None, 1000.0, gripper=Gripper(effective_radius=8e-3 * (1 - 1e-10))))
    assert solved.onset_position == 0.0
    assert np.isfinite(solved.force).all()
    onset, near_onset = (np.argmax(one.contact_radius < one.contact_radius[0]) - 1 for one in (solved, near))
    assert solved.force[onset] == pytest.approx(near.force[near_onset], rel=1e-8)
    assert solved.pull_off_force == pytest.approx(near.pull_off_force, rel=1e-9)


@pytest.mark.parametrize(
    ("parameters", "outcome"),
    [
        (scene(membrane=Membrane(work_of_adhesion=0.0), pressure=-1000.0), Outcome.NO_EQUILIBRIUM),
        (scene(membrane=Membrane(work_of_adhesion=0.0), pressure=0.0), Outcome.NO_ADHESION),
        (scene(15e-3, 0.0, GasAnchor.VENTED, membrane=Membrane(work_of_adhesion=0.0)), Outcome.NO_ADHESION),
        (scene(15e-3, gripper=Gripper(chamber_volume=5e-7)), Outcome.CHAMBER_CLOSED),
    ],
)
def test_other_endings_are_typed_and_carry_no_numbers(parameters, outcome):
    solved = cone.solve(parameters)
    assert solved.outcome is outcome
    assert math.isnan(solved.pull_off_force)
    assert solved.position.size == 0


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        (scene(pressure=-101_300.0), "P_0"),
        (scene(pressure=math.nan), "P_0"),
        (scene(gripper=Gripper(effective_radius=9e-3)), "r_e"),
        (scene(gripper=Gripper(chamber_volume=0.0)), "V_0"),
        (scene(membrane=Membrane(thickness=-1e-4)), "h_0"),
        (scene(membrane=Membrane(youngs_modulus=math.inf)), "E_m"),
        (scene(membrane=Membrane(work_of_adhesion=-1.0)), "omega_a"),
        (scene(0.0), "d_b"),
        (Parameters(Substrate("sphere")), "d_b"),
        (dataclasses.replace(scene(), gas=Gas(anchor=GasAnchor.MEASURED)), "measured"),
        (dataclasses.replace(scene(), gas=Gas(anchor=GasAnchor.MEASURED, measured=((1.0, 0.0), (0.0, 0.0)))), "rise"),
    ],
)
def test_impossible_parameters_are_refused_by_name(parameters, words):
    with pytest.raises(InvalidParameter, match=words):
        cone.solve(parameters)


def test_a_scene_pays_only_for_its_terms():
    vented_flat = cone.solve(scene(None, 0.0, GasAnchor.VENTED)).evaluations
    closed_flat = cone.solve(scene(None, 1000.0)).evaluations
    older_sphere = cone.solve(scene(60e-3, 0.0, GasAnchor.VENTED), contact_stretch=False).evaluations
    sphere = cone.solve(scene(60e-3, 1000.0)).evaluations
    assert set(vented_flat) == {"elastic energy"}
    assert set(closed_flat) == {"elastic energy", "chamber gas"}
    assert set(older_sphere) == {"elastic energy", "spherical cap"}
    assert set(sphere) == {"elastic energy", "chamber gas", "spherical cap", "contact stretch"}


def test_warns_where_the_cone_would_cut_into_the_sphere():
    assert any("cut into the sphere" in warning for warning in cone.solve(scene(16e-3)).warnings)
    assert cone.solve(scene(60e-3)).warnings == ()


def test_warns_where_digits_are_lost():
    hard = scene(
        2.25e-3,
        2644.5,
        membrane=Membrane(343e6, 2.1e-6, 6e-6),
        gripper=Gripper(9.5e-3, 3.4e-3, 1.68e-7),
    )
    solved = cone.solve(hard)
    assert any("small difference" in warning for warning in solved.warnings)
    assert solved.numerical_error["pull_off_force"] > 1e-10 * solved.pull_off_force
