"""The verification ladder of the membrane solver: closed forms, limits, identities, each with its order."""

import math
from itertools import pairwise

import numpy as np
import pytest

from model.membrane_branch import Counter, release_branch, release_state
from model.membrane_contact import Frozen, Line, Surface, frozen
from model.membrane_equilibrium import Annulus, Closure, Gas, residual_and_jacobian, shape, solve, strip
from model.membrane_loading import loading_contact
from model.membrane_material import energy as stored_energy
from model.membrane_sliding import Sliding, disc_tension
from model.parameters import ContactStretch

VENTED = Gas(0.0, 5.8, math.inf, 14.0)
FLAT = Surface(0.0)


def annulus(work, *, gas=VENTED, curvature=0.0, stretch=ContactStretch.PROJECTED, **options):
    return Annulus(Surface(curvature), gas, work, frozen(stretch), **options)


def boyle(pressure, volume=14.0):
    return Gas(pressure, 5.8, volume, volume)


def state_at(problem, a, order=16):
    width = np.array([-math.log(a)])
    start = release_state(problem, float(width[0]), Counter(), order)
    assert start.state is not None
    return width, start.state


@pytest.mark.parametrize("gas", [boyle(-0.057), Gas(0.1, 5.8, math.inf, 14.0)])
@pytest.mark.parametrize("closure", list(Closure))
@pytest.mark.parametrize("tension_field", [False, True])
@pytest.mark.parametrize("contact", [frozen(ContactStretch.EML), Sliding()])
def test_jacobian_is_the_derivative_of_the_residual(gas, closure, tension_field, contact):
    rng = np.random.default_rng(1)
    problem = Annulus(Surface(0.27), gas, 0.03, contact, tension_field=tension_field)
    state = strip(0.03, 6) * (1 + 0.1 * rng.random((1, 16)))
    state[0, :7] += 0.05 * rng.random(7)
    state[0, -2] = -0.05
    width, target = np.array([0.5]), np.array([0.2])
    _, jacobian = residual_and_jacobian(problem, width, state, closure, target)
    for column in range(state.size):
        step = np.zeros_like(state)
        step[0, column] = 1e-6
        ahead = residual_and_jacobian(problem, width, state + step, closure, target)[0]
        behind = residual_and_jacobian(problem, width, state - step, closure, target)[0]
        assert jacobian[0, :, column] == pytest.approx((ahead - behind)[0] / 2e-6, rel=1e-6, abs=1e-7)


def test_measured_pressure_enters_the_jacobian():
    gas = Gas(0.0, 5.8, math.inf, 14.0, measured=(np.array([-1.0, 0.0, 0.4]), np.array([0.1, 0.2, -0.3])))
    problem = annulus(0.03, gas=gas)
    state, width, target = strip(0.03, 5), np.array([0.5]), np.array([0.0])
    _, jacobian = residual_and_jacobian(problem, width, state, Closure.RELEASE, target)
    step = np.zeros_like(state)
    step[0, -1] = 1e-6
    ahead = residual_and_jacobian(problem, width, state + step, Closure.RELEASE, target)[0]
    behind = residual_and_jacobian(problem, width, state - step, Closure.RELEASE, target)[0]
    assert jacobian[0, :, -1] == pytest.approx((ahead - behind)[0] / 2e-6, rel=1e-6, abs=1e-8)


def test_strip_limit_is_reached_at_first_order():
    """a -> R_0, p = 0: w_1 (l - 1/l) - w = omega / T with l = 1 / cos(theta); E 2.1 MPa, 0.2 mm, 4 J/m^2."""
    tension = 2.1e6 * 2e-4 / 3
    work = 4.0 / tension
    limit = strip(work, 4)
    force = 2 * math.pi * limit[0, -1] * tension * 8e-3
    assert force == pytest.approx(0.696597, abs=1e-6)
    errors = []
    for gap in (1e-2, 1e-3, 1e-4):
        width, state = state_at(annulus(work), 1 - gap)
        angle = math.degrees(float(shape(annulus(work), width, state).peel_angle[0]))
        errors.append(angle - math.degrees(math.atan2(limit[0, -1], limit[0, 5])))
    assert math.degrees(math.atan2(limit[0, -1], limit[0, 5])) == pytest.approx(21.5207, abs=1e-4)
    assert np.log10(np.array(errors[:-1]) / errors[1:]) == pytest.approx([1, 1], abs=0.05)


def fold_of(problem, near):
    """Return radius, height and pull (over 2 pi) at the highest point of the branch, by a local series."""
    places = np.linspace(near - 0.2, near + 0.2, 41)
    guess = release_branch(problem, 0.0917, 0.0, Counter())[0].guess(places)
    solved = solve(problem, places, guess)
    assert solved.converged.all()
    height = np.polynomial.Chebyshev.fit(places, shape(problem, places, solved.state).height, 10)
    fold = next(float(x.real) for x in height.deriv().roots() if abs(x.imag) < 1e-9 and abs(x.real - near) < 0.2)
    pull = np.polynomial.Chebyshev.fit(places, solved.state[:, -1], 10)
    return np.array([math.exp(-fold), height(fold), pull(fold)])


def test_unstressed_small_strain_fold():
    """nu = 1/2, p = 0: a* = 0.19192 R_0, z* = 0.68718 (w / E h)^(1/4) R_0, F* = 1.3406 E h R_0 (w / E h)^(3/4).

    The limit is approached with the square root of the work of adhesion.
    """
    scaled = []
    for work in (4e-6, 1e-6, 2.5e-7):
        ratio = work / 3  # E h = 3 mu h
        units = np.array([1.0, ratio**0.25, 3 * ratio**0.75 / (2 * math.pi)])
        scaled.append(fold_of(annulus(work), math.log(1 / 0.192)) / units)
    first, second, third = scaled
    assert (first - second) / (second - third) == pytest.approx(2.0, rel=0.02)
    assert 2 * third - second == pytest.approx([0.19192, 0.68718, 1.3406], abs=1e-4)


def test_pretension_punch_limit():
    """Membrane prestretched to l_0: fold at a* = R_0 / e, z* = (R_0 / e) sqrt(2 w / T), T = 1 - l_0^-6."""
    prestretch, work = 1.2, 1e-8
    T = 1 - prestretch**-6

    def stretched(_: Surface, a):
        zero, one = np.zeros_like(a), np.ones_like(a)
        stored = 0.5 * (2 * prestretch**2 + prestretch**-4 - 3) * one
        return Line(prestretch * a, zero, prestretch * one, zero, stored)

    problem = Annulus(FLAT, VENTED, work, Frozen(stretched), prestretch=prestretch)
    width = np.linspace(0.8, 1.2, 17)
    order = 14
    w1 = prestretch - prestretch**-5
    R = np.exp(-width[:, None] * (1 - (1 - np.cos(np.pi * np.arange(order + 1) / order)) / 2))
    state = np.zeros((width.size, 2 * order + 4))
    state[:, : order + 1] = (prestretch - 1) * R
    state[:, order + 1 : -2] = w1 * R
    state[:, -1] = math.sqrt(2 * work / T) * T * prestretch * np.exp(-width)
    solved = solve(problem, width, state)
    assert solved.converged.all()
    height = np.polynomial.Chebyshev.fit(width, shape(problem, width, solved.state).height, 12)
    fold = next(float(x.real) for x in height.deriv().roots() if abs(x.imag) < 1e-9 and 0.8 < x.real < 1.2)
    scale = prestretch * math.sqrt(2 * work / prestretch**2 / T)  # work is per reference area
    assert math.exp(-fold) == pytest.approx(1 / math.e, rel=1e-6)
    assert height(fold) == pytest.approx(scale / math.e, rel=1e-6)


@pytest.mark.parametrize("gas", [VENTED, boyle(-0.05), boyle(0.08, volume=2.0)])
def test_force_and_release_rate_are_differences_of_the_energy(gas):
    """F = dPi/dz and G = -dPi/dA at fixed z, by central differences: second order."""
    problem = annulus(0.0286, gas=gas, curvature=8 / 30, stretch=ContactStretch.PROJECTED)
    width, state = state_at(problem, 0.7)
    s = shape(problem, width, state)
    height, a = float(s.height[0]), 0.7

    def energy(a, height):
        place = np.array([-math.log(a)])
        solved = solve(problem, place, state, closure=Closure.HEIGHT, target=height, iterations=30)
        assert solved.converged[0]
        return float(total_energy(problem, place, solved.state)[0])

    force, release = [], []
    for step in (1e-2, 1e-3):
        force.append((energy(a, height + step) - energy(a, height - step)) / (2 * step))
        area = math.pi * ((a + step) ** 2 - (a - step) ** 2)
        release.append((energy(a + step, height) - energy(a - step, height)) / area)
    for differences, exact in ((force, 2 * math.pi * float(state[0, -1])), (release, problem.work)):
        errors = np.array(differences) - exact
        assert errors[0] / errors[1] == pytest.approx(100, rel=0.1)
        assert (100 * differences[1] - differences[0]) / 99 == pytest.approx(exact, rel=1e-6)


def total_energy(problem, width, state):
    """Stretching of annulus and contact plus the work of the gas, over T* R_0^2; adhesion left out."""
    a = np.exp(-width)
    radii = a * np.sqrt((np.polynomial.legendre.leggauss(40)[0] + 1) / 2)
    quadrature = np.polynomial.legendre.leggauss(40)[1] / 2
    released = problem.contact.line(problem.surface, radii).released
    return annulus_energy(problem, width, state) + math.pi * a**2 * (quadrature * released).sum()


def annulus_energy(problem, width, state):
    """Stretching of the annulus plus the work of the gas."""
    s = shape(problem, width, state)
    order = s.R.shape[1]
    weights = np.polynomial.legendre.leggauss(order)[1] / 2
    hoop = s.r / s.R
    density = 0.5 * (s.stretch**2 + hoop**2 + (s.stretch * hoop) ** -2 - 3)
    free = 2 * math.pi * (width[:, None] * weights * s.R**2 * density).sum(axis=1)
    gas, change = problem.gas, s.volume_change
    if gas.held:
        return free - gas.pressure * change
    ratio = np.log1p(change / gas.free_volume)
    work = gas.atmosphere * change - (gas.atmosphere + gas.pressure) * gas.volume * ratio
    return free + work


@pytest.mark.parametrize("pressure", [-0.16, -0.05, 0.0, 0.05])
@pytest.mark.parametrize("a", [0.2, 0.5, 0.85])
def test_cone_energy_is_an_upper_bound_on_a_flat(pressure, a):
    problem = annulus(0.0286, gas=boyle(pressure))
    width, state = state_at(problem, a)
    height = float(shape(problem, width, state).height[0])
    stretch = math.hypot(1, height / (1 - a))
    change = math.pi * height * (1 + a + a * a) / 3
    gas = problem.gas
    work = gas.atmosphere * change - (gas.atmosphere + gas.pressure) * gas.volume * math.log1p(change / gas.volume)
    cone = math.pi * (1 - a * a) * 0.5 * (stretch - 1 / stretch) ** 2 + work
    assert float(total_energy(problem, width, state)[0]) <= cone


def test_collocation_converges_spectrally():
    problem = annulus(0.0286, gas=boyle(-0.15), curvature=8 / 30)
    _, reference = state_at(problem, 0.3, 30)
    errors = [abs(float(state_at(problem, 0.3, order)[1][0, -1] / reference[0, -1]) - 1) for order in (4, 6, 8, 10)]
    assert all(after < 0.1 * before for before, after in pairwise(errors))
    assert errors[-1] < 1e-8


def test_tension_field_only_removes_energy():
    taut = annulus(0.0286, gas=boyle(-0.05))
    slack = annulus(0.0286, gas=boyle(-0.05), tension_field=True)
    width, state = state_at(taut, 0.5)
    assert (shape(taut, width, state).hoop_tension > 0).all()
    assert state_at(slack, 0.5)[1] == pytest.approx(state, rel=1e-9, abs=1e-12)


def disc_energy(surface, a, radius):
    """Energy of a sliding disc at held edge: the work 2 pi a q along its spreading, and the frictionless optimum."""
    points, weights = np.polynomial.legendre.leggauss(12)
    free = natural_radius(surface, a)
    spread = free + (radius - free) * (points + 1) / 2
    tension, _ = disc_tension(surface, np.full(12, a), spread)
    along = 1 / surface.cosine(spread)  # the traction acts along the meridian
    return float((radius - free) / 2 * (weights * 2 * math.pi * a * tension * along).sum())


def natural_radius(surface, a):
    """Radius at which a sliding disc carries no edge tension."""
    low, high = 0.9 * a, a
    for _ in range(60):
        middle = (low + high) / 2
        value = disc_tension(surface, np.array([a]), np.array([middle]))[0][0]
        low, high = (low, middle) if value >= 0 else (middle, high)  # nan: the edge would be compressed
    return high


def test_sliding_disc_at_small_strain_is_the_frictionless_plate_on_a_sphere():
    """Any Poisson's ratio: hoop strain -a^2 / (8 r_b^2) at the free edge, energy E h a^4 / (384 r_b^4) per area."""
    a = 0.5
    strains, energies = [], []
    for curvature in (0.2, 0.1):
        surface, slope = Surface(curvature), curvature * a
        strains.append((natural_radius(surface, a) / a - 1) / slope**2)
        energies.append(free_disc_energy(surface, a) / (math.pi * a**2) / (3 * slope**4))
    assert strains == pytest.approx([-1 / 8, -1 / 8], rel=2e-3)
    assert abs(strains[1] + 1 / 8) < 0.3 * abs(strains[0] + 1 / 8)
    assert energies == pytest.approx([1 / 384, 1 / 384], rel=2e-2)
    assert abs(energies[1] - 1 / 384) < 0.3 * abs(energies[0] - 1 / 384)


def test_flat_sliding_disc_is_uniformly_stretched():
    tension, rate = disc_tension(Surface(0.0), np.array([0.5]), np.array([0.55]))
    nearly, nearly_rate = disc_tension(Surface(1e-3), np.array([0.5]), np.array([0.55]))
    assert tension == pytest.approx(1.1 - 1.1**-5)
    assert nearly == pytest.approx(tension, rel=1e-6)
    assert nearly_rate == pytest.approx(rate, rel=1e-5)


@pytest.mark.parametrize("curvature", [0.0, 8 / 30])
def test_sliding_release_rate_is_the_difference_of_the_energy(curvature):
    """The jump of Eshelby's energy against d Pi / d A with the disc's own energy, extrapolated."""
    surface, a, work = Surface(curvature), 0.5, 0.0286
    problem = Annulus(surface, boyle(-0.03), work, Sliding())
    start = release_state(problem, -math.log(a), Counter(), 16)
    assert start.state is not None
    height = float(shape(problem, np.array([-math.log(a)]), start.state).height[0])

    def energy(radius):
        width = np.array([-math.log(radius)])
        solved = solve(problem, width, start.state, closure=Closure.HEIGHT, target=height, iterations=30)
        assert solved.converged[0]
        edge = radius + float(solved.state[0, 0])
        stretched = disc_energy(surface, radius, edge) + free_disc_energy(surface, radius)
        return float(annulus_energy(problem, width, solved.state)[0]) + stretched

    differences = []
    for step in (2e-2, 1e-2):
        area = math.pi * ((a + step) ** 2 - (a - step) ** 2)
        differences.append((energy(a + step) - energy(a - step)) / area)
    extrapolated = (4 * differences[1] - differences[0]) / 3
    assert extrapolated == pytest.approx(work, rel=2e-4)


def free_disc_energy(surface, a):
    """Energy of a disc with a free edge, from the rate at which cutting it smaller sets energy free."""
    if surface.curvature == 0:
        return 0.0
    points, weights = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for point, weight in zip(points, weights, strict=True):
        inner = a * math.sqrt((point + 1) / 2)
        hoop = np.array([natural_radius(surface, inner) / inner])
        total += weight / 2 * float(stored_energy(hoop**-0.5, hoop)[0])
    return math.pi * a**2 * total


def test_loading_freezes_nearly_the_projected_stretch():
    """Vented loading leaves every point within half a per cent of where vertical projection puts it."""
    surface = Surface(8 / 30)
    line = loading_contact(surface, -math.log(0.9)).line(surface, np.linspace(0.1, 0.9, 9))
    assert line.radius == pytest.approx(np.linspace(0.1, 0.9, 9), rel=5e-3)
    assert line.released == pytest.approx(
        frozen(ContactStretch.PROJECTED).line(surface, np.linspace(0.1, 0.9, 9)).released, rel=0.7
    )


def test_loading_rate_is_the_stretch_of_the_ring_touched_next():
    """The frozen map satisfies its own differential equation at a radius that was no collocation point."""
    surface, a = Surface(8 / 30), np.array([0.613])
    contact = loading_contact(surface, -math.log(0.9))
    problem = Annulus(surface, Gas(0.0, 1.0, math.inf, 1.0), 0.0, contact)
    guess = strip(0.002, 16)
    guess[:, -1] *= -1
    solved = solve(problem, -np.log(a), guess, closure=Closure.TANGENT, iterations=40)
    assert solved.converged[0]
    s = shape(problem, -np.log(a), solved.state)
    line = contact.line(surface, a)
    assert float(s.peel_angle[0]) == pytest.approx(0.0, abs=1e-9)
    Q = solved.state[0, 17]
    lam = line.radius_rate / surface.cosine(line.radius)
    tension = float(np.hypot(Q, solved.state[0, -1]) / a[0])
    assert float((lam - lam**-3 * (line.radius / a) ** -2)[0]) == pytest.approx(tension, rel=1e-4)


def inflated(gas, guess, width=6.0):
    """Free inflation: a facet of e^-6 R_0 that slides and is left at no angle stands for the pole."""
    problem = Annulus(FLAT, gas, 1.0, Sliding())
    places = np.array([width])
    solved = solve(problem, places, guess, closure=Closure.TANGENT, iterations=60)
    assert solved.converged[0]
    height = -float(shape(problem, places, solved.state).height[0])  # the dome hangs below its rim
    return solved.state, 1 + float(solved.state[0, 0]) * math.exp(width), height


def held(pressure):
    return Gas(pressure, 5.8, math.inf, 14.0)


def dome(order=24, width=6.0):
    """A guess: the dome of a pole stretch 1.1, its radii and tensions as on a sphere."""
    R = np.exp(-width * (1 - (1 - np.cos(np.pi * np.arange(order + 1) / order)) / 2))
    state = np.zeros((1, 2 * order + 4))
    state[0, : order + 1] = 0.1 * R * (1 - R**2)
    state[0, order + 1 : -2] = 0.45 * R * np.sqrt(1 - 0.35 * R**2)
    state[0, -2] = 0.5
    return state


@pytest.fixture(scope="module")
def first_dome():
    return inflated(held(0.527782), dome())


def test_free_inflation_equals_two_independent_codes(first_dome):
    """Pole stretch, p R_0 / mu h_0, w_0 / R_0: 1.1 .527782 .38347; 1.2 .999252 .53098; 1.5 1.643582 .79879."""
    state, stretch, height = first_dome
    assert (stretch, -height) == pytest.approx((1.1, 0.38347), abs=6e-5)
    for pressure, expected, dome_height in ((0.999252, 1.2, 0.53098), (1.643582, 1.5, 0.79879)):
        for step in np.linspace(float(state[0, -2]), pressure, 6)[1:]:
            state, stretch, height = inflated(held(step), state)
        assert (stretch, -height) == pytest.approx((expected, dome_height), abs=1.5e-4)


def test_inflation_limit_point(first_dome):
    """The chamber's volume leads through the limit point p = 1.87917347 at lambda_0 = 2.195945."""
    state = first_dome[0]
    volume = 0.3
    pressures, stretches = [], []
    for pressure in np.linspace(13.2, 110.0, 60):
        state, stretch, _ = inflated(Gas(pressure, 5.8, volume, volume), state)
        pressures.append(float(state[0, -2]))
        stretches.append(stretch)
    top = int(np.argmax(pressures))
    assert 5 < top < 54
    near = slice(top - 4, top + 5)
    curve = np.polynomial.Polynomial.fit(stretches[near], pressures[near], 8)
    limit = next(
        float(x.real) for x in curve.deriv().roots() if abs(x.imag) < 1e-9 and abs(x.real - stretches[top]) < 0.1
    )
    assert limit == pytest.approx(2.195945, abs=4e-4)
    assert curve(limit) == pytest.approx(1.87917347, abs=5e-5)


def test_small_inflation_has_the_corrected_hencky_constant(first_dome):
    """w_0 = C R_0 (p R_0 / E h)^(1/3), C = 0.59488 at nu = 1/2; approached at first order in the strain."""
    state = first_dome[0]
    constants = []
    for pressure in np.geomspace(0.5, 5e-4, 16):
        guess = state.copy()
        ratio = pressure / float(state[0, -2])
        guess[0, :-2] *= ratio ** (2 / 3)
        guess[0, -2:] *= ratio
        state, _, height = inflated(held(pressure), guess)
        constants.append((pressure ** (2 / 3), -height / (pressure / 3) ** (1 / 3)))
    (first, coarse), (second, fine) = constants[-2:]
    assert fine == pytest.approx(0.59488, abs=1e-3)
    assert fine - (coarse - fine) * second / (first - second) == pytest.approx(0.59488, abs=6e-5)


def test_point_load_limit():
    """z = k R_0 (F / E h R_0)^(1/3): k = .8937, .9283, .9357 at a = 1e-2, 1e-3, 1e-4 R_0, nu = 1/2."""
    problem = annulus(1e-9)
    factors = []
    for a in (1e-2, 1e-3, 1e-4):
        width, state = state_at(problem, a, 40)
        height = float(shape(problem, width, state).height[0])
        factors.append(height / (2 * math.pi * float(state[0, -1]) / 3) ** (1 / 3))
    assert factors == pytest.approx([0.8937, 0.9283, 0.9357], abs=2e-4)
