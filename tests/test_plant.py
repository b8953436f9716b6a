"""The emulated world: signs, gas, load train, adhesion, and that time may be cut as one likes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from emulated_pull import RATE, pull, still
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.emulated.chamber import ATMOSPHERE, Chamber
from drivers.emulated.faults import Fault, Faults
from drivers.emulated.line import ContactLine
from drivers.emulated.membrane import AdhesiveMembrane
from drivers.emulated.plant import Plant
from drivers.emulated.specimens import ClosedChamber, DeadWeight, RigidStop, State, Surroundings
from drivers.emulated.truth import Truth
from drivers.emulated.world import World


def world(specimen: object, **chamber: float) -> Truth:
    return still(Truth(specimen, Chamber(**chamber)))  # type: ignore[arg-type]


def test_the_plant_fits_its_protocol():
    plant: World = Plant(Truth())
    assert plant.time == 0.0
    assert plant.sample == 0


# Signs and simple laws


def test_a_hung_weight_is_tension_and_negative():
    force = Plant(world(DeadWeight(0.1))).advance(100, RATE)["force"]
    assert force == pytest.approx(-0.980665)


def test_boyle():
    plant = Plant(world(ClosedChamber(), leak_time=math.inf))
    plant.syringe.run(-2e-7, 0.36e-6)
    plant.advance(4000, RATE)
    pressure = plant.advance(10, RATE)["pressure"]
    assert pressure == pytest.approx(ATMOSPHERE * (7.2 / (7.2 + 0.36) - 1), rel=1e-9)
    assert pressure[0] < 0


def test_a_leak_decays_with_its_time_constant():
    plant = Plant(world(ClosedChamber(), leak_time=20.0))
    plant.syringe.run(1e-6, 0.07e-6)
    plant.advance(1000, RATE)
    before = plant.advance(1, RATE)["pressure"][0]
    plant.advance(19_999, RATE)
    after = plant.advance(1, RATE)["pressure"][0]
    assert after / before == pytest.approx(math.exp(-1), rel=0.02)


def test_the_sensor_lags_behind_the_chamber():
    plant = Plant(world(ClosedChamber(), leak_time=math.inf, tubing_lag=0.05))
    plant.syringe.run(1e-5, 1e-7)  # 10 ms
    plant.advance(10, RATE)
    chamber = plant.state.pressure
    sensed = plant.advance(200, RATE)["pressure"]
    missing = ((chamber - sensed) / chamber)[:150]
    times = np.arange(1, 151) / RATE
    assert np.polyfit(times[5:], np.log(missing[5:]), 1)[0] == pytest.approx(-1 / 0.05, rel=0.02)


def test_a_vented_chamber_stays_at_zero():
    truth = still(Truth.pull_off(vented=True))
    plant = Plant(truth)
    plant.syringe.run(-1e-7, 1e-6)
    assert np.all(plant.advance(1000, RATE)["pressure"] == 0.0)


def test_the_load_train_is_a_spring_in_series_with_a_rigid_stop():
    plant = Plant(world(RigidStop(stop_stiffness=1e9)))
    train = plant.truth.train
    plant.axis.move(train.contact_position - 20e-6, 1e-2, 1.0, 1.0)
    plant.advance(2000, RATE)
    force = plant.advance(10, RATE)["force"]
    assert force == pytest.approx(train.stiffness * 20e-6, rel=1e-3)


def test_compression_relaxes_in_the_dwell_and_not_more_than_stated():
    truth = replace(Truth.pull_off(), disturbance=still(Truth()).disturbance)
    plant = Plant(truth)
    plant.axis.move(truth.train.contact_position - 1.1e-3, 1e-4, 1e-2, 1e-2)
    while plant.axis.moving:
        plant.advance(20, RATE)
    forces = np.concatenate([plant.advance(20, RATE)["force"] for _ in range(3000)])
    assert forces[0] > 0.3
    fall = 1 - forces[-1] / forces[0]
    assert 0.3 * truth.train.relaxing < fall < 1.2 * truth.train.relaxing


# Time


def script(plant: Plant, cuts: list[int]) -> dict[str, np.ndarray]:
    """A short, eventful test with commands at fixed samples, read in the given pieces."""
    contact = plant.truth.train.contact_position
    commands = {
        0: lambda: plant.axis.move(contact - 1.05e-3, 5e-3, 0.1, 0.1),
        600: lambda: plant.axis.move(contact - 1.1e-3, 2e-3, 0.1, 0.1),
        900: lambda: plant.syringe.run(-1e-6, 0.5e-6),
        1013: lambda: plant.axis.halt(0.05),
        1500: lambda: plant.axis.move(contact + 3e-3, 2e-3, 0.1, 0.1),
    }
    pieces = []
    stops = sorted({*np.cumsum(cuts).tolist(), *commands, 4000})
    now = 0
    for stop in stops:
        if stop > now:
            pieces.append(plant.advance(min(stop, 4000) - now, RATE))
            now = stop
        if stop in commands:
            commands[stop]()
        if now >= 4000:
            break
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


TRUTH = Truth.pull_off(seed=3)
WHOLE = script(Plant(TRUTH, seed=5), [4000])


def test_the_script_makes_and_breaks_a_contact():
    assert WHOLE["force"].max() > 0.2
    assert WHOLE["force"].min() < -0.3
    assert abs(WHOLE["force"][-100:].mean()) < 0.02


@given(st.lists(st.integers(1, 700), min_size=1, max_size=400))
@settings(max_examples=25, deadline=None)
def test_a_run_does_not_depend_on_how_it_is_cut_into_frames(cuts):
    found = script(Plant(TRUTH, seed=5), cuts)
    for name, whole in WHOLE.items():
        assert np.array_equal(found[name], whole), name


def test_one_seed_one_run():
    assert np.array_equal(script(Plant(TRUTH, seed=5), [20] * 200)["pressure"], WHOLE["pressure"])
    other = script(Plant(TRUTH, seed=6), [4000])
    assert not np.array_equal(other["force"], WHOLE["force"])
    assert np.corrcoef(other["force"], WHOLE["force"])[0, 1] > 0.999


def test_time_goes_on_when_the_rate_changes():
    plant = Plant(world(ClosedChamber()))
    plant.advance(100, 1000.0)
    plant.advance(300, 2000.0)
    plant.advance(0, 500.0)
    assert plant.time == pytest.approx(0.25)
    assert plant.sample == 400


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="rate"):
        Plant(Truth()).advance(10, 0.0)


# Adhesion


@pytest.fixture(scope="module")
def cycles():
    return {
        pressure: pull(still(Truth.pull_off("sphere", 60e-3)), pressure, speed=2e-5) for pressure in (1600.0, -3200.0)
    }


def test_suction_holds_harder_and_over_a_shorter_distance(cycles):
    pushed, sucked = cycles[1600.0], cycles[-3200.0]
    assert sucked.pull_off_force > 2 * pushed.pull_off_force
    assert sucked.pull_off_distance < 0.6 * pushed.pull_off_distance


def test_the_world_is_in_the_neighbourhood_of_the_experiment(cycles):
    """EML 2020, 60 mm sphere: 0.30 N and 2.24 mm at +1.6 kPa, 0.88 N and 1.14 mm at -3.2 kPa. Nothing is fitted."""
    assert cycles[1600.0].pull_off_force == pytest.approx(0.30, rel=0.4)
    assert cycles[1600.0].pull_off_distance == pytest.approx(2.24e-3, rel=0.4)
    assert cycles[-3200.0].pull_off_force == pytest.approx(0.88, rel=0.4)
    assert cycles[-3200.0].pull_off_distance == pytest.approx(1.14e-3, rel=0.4)


def test_nothing_pulls_after_detachment(cycles):
    for cycle in cycles.values():
        assert cycle.force[cycle.gone + 2 :] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("vented", [True, False])
@pytest.mark.parametrize(("shape", "diameter"), [("flat", None), ("sphere", 60e-3), ("sphere", 30e-3)])
def test_a_cycle_dissipates_what_the_adhesion_hysteresis_demands(shape, diameter, vented):
    """Force and energy release rate derive from one potential: the loop closes on the energy of the contact line.

    At least (receding - advancing) times the area is lost; more only where the line is fast (rate law, snap).
    """
    truth = still(Truth.pull_off(shape, diameter, vented=vented))
    truth = replace(truth, chamber=replace(truth.chamber, leak_time=math.inf))
    cycle = pull(truth, samples=10, speed=1e-4)
    specimen = truth.specimen
    assert isinstance(specimen, AdhesiveMembrane)
    line = specimen.line
    assert cycle.plant.state.radius == 0.0
    area = math.pi * widest(truth) ** 2
    assert line.receding - line.advancing < cycle.work / area < 1.35 * line.receding


def widest(truth: Truth) -> float:
    """The contact radius a preload of 0.5 N leads to."""
    plant = Plant(truth)
    plant.axis.move(truth.train.contact_position - 4e-3, 1e-4, 1e-2, 1e-2)
    plant.advance(19_000, RATE)
    while plant.advance(20, RATE)["force"].mean() < 0.5:
        pass
    plant.axis.halt(1e-2)
    plant.advance(2000, RATE)
    return plant.state.radius


def test_the_contact_line_is_pinned_between_advancing_and_receding(cycles):
    """At one height the contact is wider on the way out than on the way in."""
    truth = still(Truth.pull_off("sphere", 60e-3, vented=True))
    plant = Plant(truth)
    contact = truth.train.contact_position
    radius = []
    for target in (contact - 0.3e-3, contact - 0.8e-3, contact - 0.3e-3):
        plant.axis.move(target, 1e-4, 1e-2, 1e-2)
        while plant.axis.moving:
            plant.advance(20, RATE)
        plant.advance(2000, RATE)
        radius.append(plant.state.radius)
    assert radius[2] > 1.1 * radius[0]


def test_a_faster_pull_is_stronger():
    truth = still(Truth.pull_off("flat", None, vented=True))
    assert pull(truth, speed=5e-4, samples=5).pull_off_force > 1.03 * pull(truth, speed=2e-5).pull_off_force


def test_the_snap_takes_milliseconds():
    truth = still(Truth.pull_off("flat", None, vented=True))
    cycle = pull(truth, samples=10, speed=5e-5)
    assert cycle.force[cycle.gone - 10] < -0.05
    assert cycle.force[cycle.gone + 1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("diameter", [None, 60e-3, 30e-3])
@pytest.mark.parametrize("height", [-0.3e-3, 0.2e-3, 0.8e-3])
def test_force_and_release_rate_derive_from_one_potential(diameter, height):
    """-dF/dA at fixed height equals dG/dz at fixed area (Maxwell), bulge, gas and sphere included."""
    # With this rate law the line's speed tells the release rate: v = 1e-6 (1 - G / 1e-3).
    specimen = AdhesiveMembrane(
        substrate_diameter=diameter, line=ContactLine(1e-3, line_speed=1e-6, rate_exponent=1.0), rim_stiffness=0.0
    )
    chamber = Chamber(leak_time=math.inf)

    def at(radius: float, height: float) -> tuple[float, float]:
        state = State(pressure=-2000.0, height=height, radius=radius, stretch=0.01)
        for _ in range(6):
            state = specimen.step(state, 1e-12, Surroundings(height, -2e-7, 1.0, chamber, 1e12))._replace(
                radius=radius, speed=0.0
            )
        speed = specimen.step(state, 1e-12, Surroundings(height, -2e-7, 1.0, chamber, 1e12)).speed
        return state.force, 1e-3 - 1e3 * speed

    radius, step = 5e-3, 2e-6
    area = math.pi * ((radius + step) ** 2 - (radius - step) ** 2)
    force_by_area = (at(radius + step, height)[0] - at(radius - step, height)[0]) / area
    release_by_height = (at(radius, height + step)[1] - at(radius, height - step)[1]) / (2 * step)
    assert at(radius, height)[1] > 1e-2
    assert force_by_area == pytest.approx(-release_by_height, rel=2e-3)


@given(
    st.sampled_from(
        [("sphere", 15e-3), ("sphere", 20e-3), ("sphere", 30e-3), ("sphere", 1.0), ("flat", None), ("flat", 10e-3)]
    ),
    st.lists(
        st.tuples(st.floats(-3e-3, 4e-3), st.floats(1e-5, 5e-3), st.floats(-1.5e-6, 1.5e-6), st.integers(1, 1500)),
        min_size=1,
        max_size=8,
    ),
    st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_whatever_is_commanded_the_world_goes_on(substrate, commands, seed):
    truth = Truth.pull_off(*substrate, seed=seed)
    plant = Plant(truth, seed=seed)
    for target, speed, volume, samples in commands:
        plant.axis.move(truth.train.contact_position + target, speed, 0.1, 0.1)
        plant.syringe.run(math.copysign(5e-7, volume), abs(volume))
        for signal in plant.advance(samples, RATE).values():
            assert np.all(np.isfinite(signal))


@given(
    st.sampled_from(["sphere", "flat"]),
    st.floats(-4, 1),
    st.floats(-4, -1),
    st.floats(0.2, 1.0),
    st.floats(-9, -3),
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-5, -2), st.floats(-0.9, 0.9)), min_size=1, max_size=4),
)
@settings(max_examples=40, deadline=None)
def test_absurd_geometries_are_worlds_too(shape, diameter, radius, share, volume, commands):
    """Diameters from 0.1 mm to 10 m, grippers from 0.1 mm to 0.1 m, chambers from a microlitre to a litre."""
    truth = Truth.pull_off(
        shape,
        10**diameter,
        radius=10**radius,
        effective_radius=share * 10**radius,
        chamber_volume=10**volume,
    )
    plant = Plant(truth)
    for depth, speed, stroke in commands:
        target = truth.train.contact_position + depth * min(3 * 10**radius, 18e-3)
        plant.axis.move(target, 10**speed, 0.1, 0.1)
        plant.syringe.run(math.copysign(10**volume, stroke), abs(stroke) * 10**volume)
        for signal in plant.advance(500, RATE).values():
            assert np.all(np.isfinite(signal))


# Faults and hands


def test_a_blocked_carriage_keeps_its_place():
    faults = Faults([Fault("stage", "blocked", at_sample=100, for_samples=200)])
    plant = Plant(still(Truth()), faults=faults)
    plant.axis.move(25e-3, 5e-3, 0.1, 0.1)
    places = [plant.axis.position for _ in range(40) if plant.advance(10, RATE)]
    assert len(set(places[11:29])) == 1
    assert places[-1] > places[20]


def test_a_leak_can_be_scripted():
    faults = Faults()
    plant = Plant(world(ClosedChamber(), leak_time=math.inf), faults=faults)
    plant.syringe.run(1e-6, 0.07e-6)
    tight = plant.advance(2000, RATE)["pressure"]
    faults.add(Fault("pressure", "leak", value=5.0))
    leaking = plant.advance(5000, RATE)["pressure"]
    assert tight[-1] == pytest.approx(tight[-1000])
    assert leaking[-1] / tight[-1] == pytest.approx(math.exp(-1), rel=0.05)


def test_hands_can_change_the_weight():
    plant = Plant(world(DeadWeight(0.0)))
    assert plant.advance(20, RATE)["force"] == pytest.approx(0.0)
    plant.mount(DeadWeight(0.05))
    assert plant.advance(20, RATE)["force"][-1] == pytest.approx(-0.05 * 9.80665)
