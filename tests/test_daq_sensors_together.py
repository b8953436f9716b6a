"""Plant, electronics, wire, driver and sensors in one line: what a run sees of a sound and of a broken rig."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from daq_world import RATE

from drivers.daq import NIDaq, signal_channel
from drivers.emulated.daq import EmulatedDaq
from drivers.emulated.electronics import Cell, usb_6211
from drivers.emulated.faults import Fault
from drivers.emulated.plant import Plant
from drivers.emulated.truth import Truth
from drivers.flags import Reading, SensorFlags
from drivers.force import LoadCell
from drivers.pressure import HoneywellHSC

CHANNELS = [signal_channel(name, f"Dev1/ai{i}") for i, name in enumerate(("force", "pressure", "supply"))]


class Rig:
    """A plant, its DAQ on the wire, and the sensors' conversions."""

    def __init__(self) -> None:
        self.plant = Plant(Truth(), seed=5)
        self.server = EmulatedDaq(self.plant, usb_6211(), seed=5).start()
        self.daq = NIDaq(CHANNELS, rate=RATE, connection=self.server.connection)
        self.daq.start()
        self.cell = LoadCell("GSO-1K", Cell().capacity, Cell().calibration())
        self.sensor = HoneywellHSC(rate=RATE)

    def frames(self, count: int, samples: int = 20) -> tuple[Reading, Reading]:
        """Force and pressure of so many frames, and everything seen in them."""
        force, pressure = [], []
        for _ in range(count):
            volts = self.daq.read(samples)
            force.append(self.cell.convert(volts[0]))
            pressure.append(self.sensor.convert(volts[1], volts[2]))
        return joined(force), joined(pressure)

    def close(self) -> None:
        self.daq.close()
        self.server.stop()


def joined(readings: list[Reading]) -> Reading:
    flags = SensorFlags.NONE
    for reading in readings:
        flags |= reading.flags
    return Reading(np.concatenate([reading.values for reading in readings]), flags)


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.close()


def test_a_sound_rig_reads_zero_within_its_errors_and_flags_nothing(rig: Rig) -> None:
    force, pressure = rig.frames(100)
    assert force.flags == pressure.flags == SensorFlags.NONE
    assert abs(force.values.mean()) < 0.01 * rig.cell.capacity  # the cell's zero balance
    assert abs(pressure.values.mean()) < 300.0  # the sensor's accuracy
    assert 1e-4 < force.values.std() < 2e-3
    assert 1.0 < pressure.values.std() < 30.0


def test_pressing_raises_the_force(rig: Rig) -> None:
    before, _ = rig.frames(20)
    rig.plant.axis.move(rig.plant.truth.train.contact_position - 1e-3, 5e-3, 1.0, 1.0)
    rig.frames(400)
    after, _ = rig.frames(20)
    assert after.values.mean() > before.values.mean() + 0.1


def test_withdrawing_the_syringe_lowers_the_pressure(rig: Rig) -> None:
    _, before = rig.frames(20)
    rig.plant.syringe.run(-1e-7, 4e-7)
    rig.frames(400)
    _, after = rig.frames(20)
    assert after.values.mean() < before.values.mean() - 500.0


def test_an_open_pressure_wire_is_found_within_a_quarter_of_a_second(rig: Rig) -> None:
    rig.frames(20)
    rig.plant.faults.add(Fault("pressure", "open_wire"))
    _, first = rig.frames(1)
    assert first.values.mean() == pytest.approx(-33e3, abs=300)  # a believable vacuum, at first
    _, later = rig.frames(12)
    assert SensorFlags.OPEN_WIRE in later.flags
    assert np.isnan(later.values[-100:]).any()


def test_an_open_wire_at_the_beginning_does_not_pass_for_a_zero(rig: Rig) -> None:
    rig.plant.faults.add(Fault("pressure", "open_wire"))
    _, pressure = rig.frames(50)
    assert pressure.flags.faulty


@pytest.mark.parametrize(
    ("fault", "flag"),
    [
        (Fault("pressure", "clipped"), SensorFlags.CLIPPED),
        (Fault("pressure", "supply_lost"), SensorFlags.WIRING),
        (Fault("supply", "lost"), SensorFlags.SUPPLY_LOST),
        (Fault("supply", "open_wire"), SensorFlags.SUPPLY_LOST),
        (Fault("supply", "sag", value=4.5), SensorFlags.SUPPLY_RANGE),
    ],
)
def test_faults_of_the_pressure_sensor_are_seen_in_the_next_frame(rig: Rig, fault: Fault, flag: SensorFlags) -> None:
    rig.frames(20)
    rig.plant.faults.add(fault)
    force, pressure = rig.frames(1)
    assert flag in pressure.flags
    assert pressure.flags.faulty
    assert force.flags == SensorFlags.NONE


@pytest.mark.parametrize(
    ("fault", "flag"),
    [
        (Fault("force", "over_range", value=8.5), SensorFlags.HIGH_LOAD),
        (Fault("force", "over_range", value=-10.5), SensorFlags.OVER_RANGE),
        (Fault("force", "over_range", value=-12.1), SensorFlags.OVERLOAD),
        (Fault("force", "open_wire"), SensorFlags.CLIPPED),
    ],
)
def test_faults_of_the_load_cell_are_seen_in_the_next_frame(rig: Rig, fault: Fault, flag: SensorFlags) -> None:
    rig.frames(5)
    rig.plant.faults.add(fault)
    force, pressure = rig.frames(1)
    assert flag in force.flags
    assert pressure.flags == SensorFlags.NONE
    if fault.kind == "over_range":
        assert force.values.mean() == pytest.approx(fault.value, rel=0.01)


def test_one_seed_is_one_run_on_the_wire() -> None:
    runs = []
    for _ in range(2):
        rig = Rig()
        rig.plant.axis.move(rig.plant.truth.train.contact_position - 50e-6, 5e-3, 1.0, 1.0)
        runs.append(np.concatenate([rig.daq.read(20) for _ in range(100)], axis=1))
        rig.close()
    np.testing.assert_array_equal(*runs)
