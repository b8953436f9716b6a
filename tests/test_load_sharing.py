"""Load sharing: balance, limits, convergence, locking and an independent prototype's values."""

import json

import numpy as np
import pytest

from model.errors import InvalidParameter
from model.load_sharing import Discretisation, Fibres, Film, Formulation, Load, solve

FILM = Film(8e-3, 7.3e-3, 250e-6, 2.1e6)
QUICK = Discretisation(2e-6, 0.25)
SUCTION = Load(1e-4, -2900.0)


@pytest.fixture(scope="module")
def axisymmetric():
    return solve(FILM, Formulation.AXISYMMETRIC)


def test_axisymmetric_values_of_an_independent_code(axisymmetric):
    assert axisymmetric.edge_force(Load(1e-4, 0.0)) == pytest.approx(0.323, rel=2e-3)
    assert axisymmetric.edge_force(SUCTION) == pytest.approx(0.851, rel=1e-3)
    assert axisymmetric.edge_force(Load(1e-4, 1600.0)) == pytest.approx(0.031, rel=0.02)
    assert axisymmetric.edge_force(Load(1e-4, -50e3)) == pytest.approx(9.43, rel=1e-3)
    assert axisymmetric.edge_error < 1e-3


def test_pressure_goes_straight_through_the_film(axisymmetric):
    middle = (axisymmetric.position > 1e-3) & (axisymmetric.position < 5e-3)
    assert axisymmetric.traction(Load(0.0, -2900.0))[middle] == pytest.approx(2900.0, rel=1e-3)


def test_nodal_forces_and_tractions_carry_the_same_load(axisymmetric):
    radius, traction = axisymmetric.position, axisymmetric.traction(SUCTION)
    inner = radius < 7e-3
    nodal = (np.asarray(SUCTION) @ axisymmetric.nodal_force)[inner].sum()
    integrated = np.trapezoid(2 * np.pi * radius[inner] * traction[inner], radius[inner])
    assert integrated == pytest.approx(nodal, rel=2e-2)


def test_forces_balance():
    """The pull on the substrate is the pull of the rim minus the push of the gas, to rounding."""
    from model.load_sharing import _Problem

    problem = _Problem(FILM, Formulation.AXISYMMETRIC, None, QUICK)
    rim = problem.u.get_dofs("rim").all("u^2")
    residual = problem.solution @ problem.matrix.T - problem.loads
    pushed = problem.loads[:, 1 : problem.u.N : 2].sum(axis=1)
    vertical = problem.u.get_dofs("contact").all("u^2")
    total = residual[:, rim].sum(axis=1) + residual[:, vertical].sum(axis=1)
    every = problem.loads[:, : problem.u.N].sum(axis=1)
    assert pushed.shape == (2,)
    assert total == pytest.approx(-every, rel=1e-9, abs=1e-9)


def test_plane_strain_release_rate_of_an_independent_code():
    """1.2348 J/m^2 from moving the contact edge of another mesh, extrapolated."""
    plane = solve(FILM, Formulation.PLANE_STRAIN, estimate_error=False)
    assert plane.release_rate(SUCTION) == pytest.approx(1.2348, rel=1e-3)
    assert plane.edge_force(SUCTION) == pytest.approx(28.8, rel=3e-3)


def test_release_rate_is_the_loss_of_energy_when_the_edge_recedes():
    """At held lift the energy is half lift times rim force; two full solutions against the one-solution derivative."""
    step = 20e-6
    energies = []
    for radius in (FILM.contact_radius - step, FILM.contact_radius + step):
        film = Film(FILM.radius, radius, FILM.thickness, FILM.youngs_modulus)
        energies.append(0.5 * solve(film, Formulation.AXISYMMETRIC, estimate_error=False).edge_force(Load(1.0, 0.0)))
    area = np.pi * ((FILM.contact_radius + step) ** 2 - (FILM.contact_radius - step) ** 2)
    whole = solve(FILM, Formulation.AXISYMMETRIC, estimate_error=False)
    assert whole.release_rate(Load(1.0, 0.0)) == pytest.approx((energies[1] - energies[0]) / area, rel=3e-3)


def test_lift_at_peeling_solves_the_quadratic(axisymmetric):
    lift = axisymmetric.lift_at_peeling(4.0, -2900.0)
    assert axisymmetric.release_rate(Load(lift, -2900.0)) == pytest.approx(4.0, rel=1e-12)
    assert lift < axisymmetric.lift_at_peeling(4.0, 0.0)


def test_superposition_is_linear(axisymmetric):
    both = axisymmetric.traction(Load(2e-4, -1000.0))
    parts = axisymmetric.traction(Load(2e-4, 0.0)) + axisymmetric.traction(Load(0.0, -1000.0))
    assert both == pytest.approx(parts, rel=1e-12)


def test_edge_force_converges_at_first_order_on_uniform_meshes():
    """The corner's square-root singularity fixes the order, whatever the elements; grading restores accuracy."""
    best = solve(FILM, estimate_error=False, discretisation=Discretisation(0.1e-6)).edge_force(Load(1e-4, 0.0))
    errors = []
    for size in (0.5, 0.25, 0.125):
        uniform = Discretisation(largest=size, graded=False)
        force = solve(FILM, estimate_error=False, discretisation=uniform).edge_force(Load(1e-4, 0.0))
        errors.append(force / best - 1)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([1.0, 1.0], abs=0.4)
    graded = solve(FILM, estimate_error=False, discretisation=QUICK).edge_force(Load(1e-4, 0.0))
    assert abs(graded / best - 1) < 0.2 * errors[-1]


def test_stuck_peak_grows_as_one_over_root_of_the_mesh():
    """The peak of a sticking film is a number of the mesh; asking for it is refused."""
    peaks = []
    for smallest in (8e-6, 2e-6, 0.5e-6):
        stuck = solve(FILM, Formulation.PLANE_STRAIN, estimate_error=False, discretisation=Discretisation(smallest))
        peaks.append(stuck.traction(SUCTION).max())
    growth = np.log2(np.array(peaks[1:]) / peaks[:-1]) / 2
    assert growth == pytest.approx([0.5, 0.5], abs=0.08)
    with pytest.raises(InvalidParameter, match="grows without bound"):
        stuck.peak_stress(SUCTION)


def test_fibre_layer_has_a_peak_that_does_not_depend_on_the_mesh():
    fibres = Fibres.of(FILM.youngs_modulus)
    assert fibres.normal_stiffness == pytest.approx(18.7e9, rel=1e-3)
    peaks, shares = [], []
    for smallest in (20e-6, 5e-6, 1e-6):
        layer = solve(FILM, fibres=fibres, estimate_error=False, discretisation=Discretisation(smallest))
        peaks.append(layer.peak_stress(SUCTION))
        shares.append([layer.sharing(Load(1e-4, pressure)) for pressure in (0.0, -2900.0, -50e3)])
    assert peaks == pytest.approx([179.2e3] * 3, rel=2e-3)
    assert shares[-1] == pytest.approx([0.010, 0.026, 0.12], rel=0.05)


def test_locking_of_displacement_elements_and_none_of_the_mixed_one():
    def force(ratio, element):
        film = Film(8e-3, 7.3e-3, 250e-6, 2.1e6, poissons_ratio=ratio)
        mesh = Discretisation(largest=0.25, graded=False, element=element)
        return solve(film, Formulation.PLANE_STRAIN, estimate_error=False, discretisation=mesh).edge_force(
            Load(1e-4, 0.0)
        )

    mixed = force(0.49999, "mixed")
    assert force(0.49999, "P1") > 2.0 * mixed
    assert force(0.49999, "P1") > 2.0 * force(0.45, "P1")
    assert force(0.49999, "P2") < 1.2 * mixed
    assert mixed == pytest.approx(force(0.5, "mixed"), rel=1e-3)


def test_published_constants_differ_from_the_plane_strain_they_name():
    """Half the shear modulus and plane stress: 40 % less edge force, the same stress in the middle."""
    printed = solve(FILM, Formulation.PUBLISHED, estimate_error=False)
    assert printed.edge_force(Load(1e-4, 0.0)) == pytest.approx(3.98, rel=5e-3)
    middle = (printed.position > 1e-3) & (printed.position < 5e-3)
    assert printed.traction(Load(0.0, -2900.0))[middle] == pytest.approx(2900.0, rel=1e-3)


@pytest.mark.parametrize(
    ("film", "options", "message"),
    [
        (Film(8e-3, 8e-3), {}, "free rim"),
        (Film(), {"formulation": "published", "discretisation": Discretisation()}, "no pressure"),
        (Film(), {"discretisation": Discretisation(element="P2")}, "mixed element"),
        (Film(), {"discretisation": Discretisation(element="Q9")}, "choose mixed"),
    ],
)
def test_impossible_requests_are_named(film, options, message):
    with pytest.raises(InvalidParameter, match=message):
        solve(film, **options)


def test_command_prints_one_json_object(tmp_path, capsys):
    from rig.cli import main

    scene = tmp_path / "scene.toml"
    scene.write_text('[substrate]\nshape = "flat"\n[protocol]\nname = "pull_off"\ninitial_pressure_kPa = -2.9\n')
    picture = tmp_path / "sharing.png"
    assert main(["load-sharing", str(scene), "--json", "--plot", str(picture)]) == 0
    answer = json.loads(capsys.readouterr().out)
    free, suction = answer["loads"]
    assert answer["formulation"] == "axisymmetric"
    assert suction["pressure_Pa"] == pytest.approx(-2900.0)
    assert suction["adhesion_efficiency"] > free["adhesion_efficiency"] > 0
    assert suction["release_rate_J_m2"] == pytest.approx(4.0)
    assert answer["numerical_error"]["edge_force_relative"] < 1e-3
    assert picture.stat().st_size > 10_000
