"""The specimens other than the membrane: each does what its experiment found."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from emulated_pull import still
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.emulated.fibers import FewFibers, RigidPunch
from drivers.emulated.indentation import Indentation
from drivers.emulated.line import ContactLine
from drivers.emulated.plant import Plant
from drivers.emulated.soft import TABLE_S2, SoftGripper
from drivers.emulated.truth import Truth


@dataclass
class Touch:
    force: np.ndarray
    height: np.ndarray
    radius: np.ndarray
    pressure: np.ndarray
    turn: int

    @property
    def pull_off_force(self) -> float:
        return float(-self.force.min())

    @property
    def work(self) -> float:
        return float(-np.trapezoid(self.force, self.height))


def touch(
    truth: Truth, preload: float, speed: float, far: float, *, rest: int = 50, withdraw: float = 0.0, every: int = 5
) -> Touch:
    """Press until ``preload``, rest, retract ``far`` above contact."""
    plant = Plant(still(truth))
    contact = truth.train.contact_position
    rows: list[tuple[float, float, float, float]] = []

    def advance() -> float:
        force = plant.advance(every, 1000.0)["force"][-1]
        state = plant.state
        rows.append((force, state.height, state.radius, state.pressure))
        return float(force)

    if withdraw:
        plant.syringe.run(-1e-6, withdraw)
    plant.axis.move(contact + 5e-6, 5e-3, 1.0, 1.0)
    while plant.axis.moving or plant.syringe.rate:
        plant.advance(20, 1000.0)
    plant.axis.move(contact - 2e-3, speed, 0.1, 0.1)
    while advance() < preload:
        assert plant.axis.moving
    plant.axis.halt(0.1)
    for _ in range(rest):
        advance()
    turn = len(rows)
    plant.axis.move(contact + far, speed, 0.1, 0.1)
    while plant.axis.moving:
        advance()
    return Touch(*np.array(rows).T, turn=turn)


def test_indentation_recovers_the_work_of_adhesion_by_jkr():
    """PNAS SI Eq. S13, w = 2 F / (3 pi R): 75 mN for 4 J/m^2; the peeling rate adds a little."""
    line = ContactLine(receding=4.0, advancing=0.3, line_speed=1.0, rate_exponent=0.35)
    truth = Truth(Indentation(line=line))
    found = touch(truth, 0.1, 2e-5, 0.1e-3)
    assert found.pull_off_force == pytest.approx(1.5 * math.pi * 4e-3 * 4.0, rel=0.06)
    assert found.pull_off_force > 1.5 * math.pi * 4e-3 * 4.0


def test_indentation_is_stiffer_in_a_wider_contact_and_closes_its_energy():
    truth = Truth(Indentation())
    found = touch(truth, 0.1, 2e-5, 0.1e-3, every=1)
    line = truth.specimen.line  # type: ignore[attr-defined]
    area = math.pi * found.radius.max() ** 2
    assert line.receding - line.advancing < found.work / area < 1.35 * line.receding
    assert found.force[-1] == 0.0


def test_the_published_indentation_is_in_reach():
    """Table S3: 78 mN on average, contact area 0.77 mm^2 at pull-off."""
    found = touch(Truth.indentation(), 0.1, 5e-5, 0.15e-3)
    assert found.pull_off_force == pytest.approx(78e-3, rel=0.15)
    assert math.pi * found.radius[found.force.argmin()] ** 2 == pytest.approx(0.77e-6, rel=0.35)


def test_fibers_let_go_one_after_another_at_their_strength():
    strengths = (0.5e-3, 0.6e-3, 0.7e-3)
    truth = Truth.fibers()
    truth = replace(truth, specimen=FewFibers(strengths=strengths))
    found = touch(truth, 1e-3, 1e-6, 15e-6)
    assert 2 * strengths[0] < found.pull_off_force <= sum(strengths)
    held = np.round((found.radius / 37e-6) ** 2).astype(int)[found.turn :]
    assert held[0] == 3
    assert held[-1] == 0
    assert found.force[-1] == 0.0


def test_published_fibers():
    """Table S5: three fibres hold 1.7 to 2.1 mN."""
    forces = [touch(Truth.fibers(seed=seed), 1e-3, 2e-6, 15e-6).pull_off_force for seed in range(5)]
    assert np.mean(forces) == pytest.approx(1.87e-3, rel=0.15)


def test_an_aligned_punch_shares_the_load_equally():
    punch = RigidPunch(tilt=1e-6)
    found = touch(Truth(punch), 0.8, 5e-5, 0.4e-3)
    ideal = punch.strength * math.pi * punch.radius**2
    assert found.pull_off_force == pytest.approx(ideal, rel=0.01)
    assert touch(Truth(replace(punch, tilt=5e-3)), 2.0, 5e-5, 0.4e-3).pull_off_force < 0.9 * ideal


def test_a_punch_holds_several_times_harder_than_the_membrane_but_not_for_long():
    """EML 2020 Fig. 3e: about ten times the force within a short range of retraction."""
    found = touch(Truth.punch(), 0.8, 5e-5, 0.5e-3)
    gone = np.flatnonzero(found.force < 0.05 * found.force.min())[-1]
    assert found.height[gone] < 0.3e-3
    assert found.force[-1] == 0.0
    assert found.radius[-1] == 0.0


@pytest.mark.parametrize("diameter", TABLE_S2)
@pytest.mark.parametrize("row", [0, 1])
def test_the_soft_gripper_is_table_s2(diameter, row):
    pressure, force = TABLE_S2[diameter][row]
    assert SoftGripper(diameter).pull_off_force(pressure) == pytest.approx(force)


def test_the_soft_gripper_on_the_rubber_film_is_table_s2():
    highest, lowest = (SoftGripper(rubber=True).pull_off_force(pressure) for pressure in (0.3e3, -50.9e3))
    assert (highest, lowest) == pytest.approx((0.08, 0.61))


def test_the_soft_gripper_between_the_rows_and_diameters():
    gripper = SoftGripper(40e-3)
    assert SoftGripper(30e-3).pull_off_force(-30e3) < gripper.pull_off_force(-30e3)
    assert gripper.pull_off_force(-30e3) < SoftGripper(60e-3).pull_off_force(-30e3)


def test_suction_through_the_syringe_strengthens_the_soft_gripper():
    truth = Truth.soft(30e-3)
    plain = touch(truth, 0.5, 2e-4, 5e-3)
    sucked = touch(truth, 0.5, 2e-4, 5e-3, withdraw=4e-6)
    assert sucked.pressure.min() < -30e3
    assert sucked.pull_off_force > 3 * plain.pull_off_force
    assert sucked.force[-1] == 0.0


WORLDS = [Truth.indentation, Truth.fibers, Truth.punch, Truth.soft, Truth.closed]


@pytest.mark.parametrize("make", WORLDS)
def test_the_same_seed_makes_the_same_specimen(make):
    assert make(seed=3) == make(seed=3)
    assert make(seed=3) != make(seed=4)


@pytest.mark.parametrize("make", WORLDS)
@given(
    st.lists(st.tuples(st.floats(-0.2e-3, 0.5e-3), st.floats(1e-6, 1e-3), st.integers(1, 800)), min_size=1, max_size=6),
    st.lists(st.integers(1, 300), min_size=1, max_size=20),
)
@settings(max_examples=8, deadline=None)
def test_any_motion_in_any_frames(make, moves, cuts):
    """Whatever is commanded the force is a number, and frames may be cut as one likes."""

    def play(pieces: list[int]) -> np.ndarray:
        plant = Plant(make(seed=1), seed=2)
        contact = plant.truth.train.contact_position
        forces = []
        for target, speed, samples in moves:
            plant.axis.move(contact + target, speed, 0.1, 0.1)
            left = samples
            while left:
                piece = min(left, pieces[len(forces) % len(pieces)])
                forces.append(plant.advance(piece, 1000.0)["force"])
                left -= piece
        return np.concatenate(forces)

    whole = play([1000])
    assert np.all(np.isfinite(whole))
    assert np.array_equal(play(cuts), whole)
