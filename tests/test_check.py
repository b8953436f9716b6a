"""What a bench file may say and which scenes a bench carries out: each refusal with its figure and what it prevents."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import scene_text

import rig.emulation
from drivers.emulated.chamber import Chamber
from drivers.emulated.faults import Fault, Faults
from drivers.emulated.specimens import RigidStop, finish
from drivers.emulated.truth import Train, Truth
from rig.bench import OVERLOAD, load_bench, parse_bench
from rig.calibrate import calibrate
from rig.campaign import Campaign
from rig.check import STIFFEST_UM_PER_N, reasons
from rig.errors import FileError
from rig.instruments import sensor_converter
from rig.observe import Observer
from rig.recording import load_recording
from rig.scene import parse_scene
from rig.session import run_scene
from rig.validation import parsed

LINE = """
[pressure.calibration]
id = "deadweight tester"
certificate = "x"
date = 2024-01-01
operator = "x"
serial = "x"
relative_uncertainty = 0.001
residual = 5.0
"""


def changed(*changes, bench="emulated"):
    """Return a shipped bench's text with these changes."""
    text = load_bench(bench)[1]
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def bench_with(*changes, bench="emulated"):
    return parse_bench(changed(*changes, bench=bench), "bench")


def refused_bench(*changes):
    with pytest.raises(FileError) as caught:
        bench_with(*changes)
    return str(caught.value)


def said(bench, name, **protocol):
    """Return what the bench has against a shipped scene with other values."""
    return "; ".join(reasons(parse_scene(scene_text(name, **protocol), name), bench))


def pressure_of(bench):
    """Return what the bench makes of 0.55 of the supply, 7500 Pa by the data sheet."""
    volts = np.array([[0.0], [0.55 * 5.0], [5.0]]).repeat(200, axis=1)
    return sensor_converter(bench, True, 1000.0).convert(volts)[1]


SUPPLY = 'supply_channel = "Dev1/ai2"\n'


def test_the_pressure_calibration_is_applied_after_the_zero():
    zero = "[pressure.zero]\noffset_Pa = 100.0\nnoise_Pa = 1.0\nsamples = 1\ntime = 2024-01-01T00:00:00Z\n"
    assert pressure_of(bench_with()) == pytest.approx(7500.0)
    assert pressure_of(bench_with((SUPPLY, SUPPLY + LINE + "slope = 1.02\nintercept = 50.0\n"))) == pytest.approx(
        7700.0
    )
    both = bench_with((SUPPLY, SUPPLY + zero + LINE + "slope = 1.02\n"))
    assert pressure_of(both) == pytest.approx(1.02 * 7400)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('sensor = "HSCDANN001BAAA5"\n', "sensor = 'HSCDANN001BAAA5'"),
        (LINE + "slope = 2.0\n", "pressure.calibration.slope = 2.0"),
        (LINE + "slope = 1.0\nintercept = 5000.0\n", "pressure.calibration.intercept = 5000.0"),
        (
            LINE + "slope = 1.0\nintercept = 50.0\n[pressure.zero]\noffset_Pa = 1.0\nnoise_Pa = 1.0\nsamples = 1\n"
            "time = 2024-01-01T00:00:00Z\n",
            "remove the table [pressure.zero]",
        ),
    ],
)
def test_a_sensor_or_calibration_that_would_not_be_obeyed_is_refused(lines, words):
    assert words in refused_bench((SUPPLY, SUPPLY + lines))


def test_another_package_of_the_same_sensor_is_the_same():
    assert pressure_of(bench_with((SUPPLY, SUPPLY + 'sensor = "HSCMRNN600MDAA5"\n'))) == pytest.approx(7500.0)


def test_a_new_zero_is_what_the_data_sheet_reads_whatever_the_calibration(request_for):
    offsets = []
    for slope in (1.0, 1.05):
        text = changed((SUPPLY, SUPPLY + LINE + f"slope = {slope}\n"))
        request = request_for(referenced=True)
        text_of_scene = scene_text("pressure-zero", rest_s=0.5)
        request = dataclasses.replace(
            request,
            scene=parse_scene(text_of_scene, "scene"),
            scene_text=text_of_scene,
            bench=parse_bench(text, "bench"),
            bench_text=text,
            out=request.out.with_name(f"{slope}.h5"),
        )
        assert run_scene(request).exit_code == 0
        offsets.append(re.search(r"offset_Pa = (\S+)", calibrate(load_recording(request.out)).toml)[1])
    assert offsets[0] == offsets[1]
    assert float(offsets[0]) > 50


UNKNOWN = ("compliance_um_per_N = 830.0", "compliance_um_per_N = 0.0")


def test_an_unknown_compliance_is_taken_for_stiff():
    bench = bench_with(UNKNOWN, bench="emulated-gso25")
    room = (OVERLOAD * bench.force.capacity_N - 0.1) * STIFFEST_UM_PER_N
    told = said(bench, "compliance", preload_N=0.1, approach_speed_um_s=20.0)
    assert (
        f"look_ahead_um = 50 would overload the load cell if this computer died at the preload (its compliance is "
        f"unknown, 1 N in 10 um is assumed; at most {room:.3g} um)" in told
    )
    assert (
        f"approach_speed_um_s = 20 can overload the load cell (its compliance is unknown, 1 N in 10 um is assumed; "
        f"at most {room / 0.57:.3g} um/s)" in told
    )
    careful = bench_with(UNKNOWN, ("look_ahead_um = 50.0", "look_ahead_um = 1.9"), bench="emulated-gso25")
    assert not said(careful, "compliance", preload_N=0.1, approach_speed_um_s=3.0)
    lazy = bench_with(
        ("compliance_um_per_N = 12.0", "compliance_um_per_N = 0.0"),
        ("look_ahead_um = 50.0", "look_ahead_um = 1000.0\nlag_s = 60.0"),
        ("frame_ms = 20.0", "frame_ms = 1000.0"),
    )
    assert "look_ahead_um = 1000" in said(lazy, "compliance")
    assert "shorten lag_s" in said(lazy, "compliance")


@pytest.mark.parametrize("after", [1, 20, 60])
def test_a_stage_unplugged_while_the_compliance_is_measured_harms_no_cell(request_for, monkeypatch, after):
    """On a load train of 12 um/N, much stiffer than such a cell should be."""
    world = Truth(RigidStop(), Chamber(vented=True), Train(stiffness=84e3, start_position=20.1e-3))
    forces, make = [], rig.emulation.emulated_bench

    def emulated(request):
        made = make(request)
        forces.append(made.plant)
        return made

    monkeypatch.setattr(rig.emulation, "truth", lambda scene, seed: world)
    monkeypatch.setattr(rig.emulation, "emulated_bench", emulated)
    text = changed(
        UNKNOWN,
        ("look_ahead_um = 50.0", "look_ahead_um = 1.9"),
        ("start_mm = 22.0", "start_mm = 20.1\nleft_on = true"),
        bench="emulated-gso25",
    )
    scene = scene_text("compliance", preload_N=0.1, approach_speed_um_s=3.0, tare_s=0.5)
    fault = Fault("stage", "unplugged", at_step="preload", after_samples=after)
    request = dataclasses.replace(
        request_for(), scene=parse_scene(scene, "scene"), scene_text=scene, bench=parse_bench(text, "bench"),
        bench_text=text, faults=Faults([fault]),
    )  # fmt: skip
    assert run_scene(request).exit_code == 6
    plant = forces[0]
    most = max(float(plant.advance(100, 1000.0)["force"].max()) for _ in range(50))
    assert not plant.axis.moving
    assert most < OVERLOAD * request.bench.force.capacity_N


def test_a_retraction_faster_than_the_tension_limit_can_stop_is_refused():
    bench = bench_with(("look_ahead_um = 50.0", "look_ahead_um = 55.0"))
    assert not said(bench, "punch", retract_speed_um_s=250.0)
    told = said(bench, "punch", retract_speed_um_s=260.0)
    assert (
        "retract_speed_um_s = 260 can overload the load cell (its force changes by 1 N in 12 um; at most 254 um/s)"
        in told
    )
    assert "lower tension_N" in told


@dataclasses.dataclass(frozen=True)
class Bond(RigidStop):
    """A stop that never lets go once it has been touched (``radius`` of the state says so)."""

    def step(self, state, duration, around):
        touched = state.radius > 0 or around.height <= 0
        series = around.stiffness * self.stop_stiffness / (around.stiffness + self.stop_stiffness)
        force = -around.height * series if touched else 0.0
        height = around.height + force / around.stiffness
        return finish(state, duration, force, around.closed_pressure, height, float(touched), 0.0, 0.0)


@pytest.mark.parametrize("level", [-1.0, -3.0, -4.3])
def test_a_cell_outlives_a_rigid_bond_whose_stage_is_unplugged(request_for, monkeypatch, level):
    world = Truth(Bond(), Chamber(vented=True), Train(start_position=20.1e-3))
    plants, make = [], rig.emulation.emulated_bench
    faults = Faults([Fault("stage", "unplugged", at_sample=10**9)])

    def emulated(request):
        made = make(request)
        plants.append(made.plant)
        return made

    class Unplug(Observer):
        def frame(self, frame):
            if frame.force.min() < level:
                faults.add(Fault("stage", "unplugged"))

    monkeypatch.setattr(rig.emulation, "truth", lambda scene, seed: world)
    monkeypatch.setattr(rig.emulation, "emulated_bench", emulated)
    scene = scene_text("punch", preload_N=0.5, preload_dwell_s=0.2, tare_s=0.5, retract_speed_um_s=50.0)
    text = changed(("start_mm = 22.0", "start_mm = 20.1\nleft_on = true"))
    request = dataclasses.replace(
        request_for(), scene=parse_scene(scene, "scene"), scene_text=scene, bench=parse_bench(text, "bench"),
        bench_text=text, faults=faults, observers=[Unplug()],
    )  # fmt: skip
    assert run_scene(request).exit_code in (3, 6)  # the limit or the stage, whichever is found first
    least = min(float(plants[0].advance(100, 1000.0)["force"].min()) for _ in range(100))
    assert not plants[0].axis.moving
    assert level > least > -OVERLOAD * request.bench.force.capacity_N


def test_a_tare_of_few_frames_is_refused():
    bench = bench_with(("frame_ms = 20.0", "frame_ms = 250.0"))
    told = said(bench, "sphere-60mm-vented", tare_s=0.9, approach_speed_um_s=20.0)
    assert told == "tare_s = 0.9 is less than 4 frames of 250 ms; make it at least 1 s or shorten frame_ms"
    assert not said(bench, "sphere-60mm-vented", tare_s=1.0, approach_speed_um_s=20.0)


def test_a_frame_is_as_long_as_its_whole_samples():
    bench = bench_with(("rate_Hz = 1000.0", "rate_Hz = 100.0"), ("frame_ms = 20.0", "frame_ms = 1.0"))
    assert bench.daq.frame_s == 0.01
    assert said(bench, "punch", approach_speed_um_s=330.0, preload_N=0.5) == said(
        bench_with(("rate_Hz = 1000.0", "rate_Hz = 100.0"), ("frame_ms = 20.0", "frame_ms = 10.0")),
        "punch",
        approach_speed_um_s=330.0,
        preload_N=0.5,
    )


@pytest.mark.parametrize("device", ["daq", "pump", "stage"])
def test_instruments_are_emulated_all_or_none(device):
    text = changed((f'[{device}]\nconnection = "emulated"', f'[{device}]\nconnection = "socket://127.0.0.1:9"'))
    with pytest.raises(FileError, match="emulate all or none") as caught:
        parse_bench(text, "bench")
    assert device in str(caught.value)


ESCAPE = r"\u001b[2J"


@pytest.mark.parametrize(
    "line", ['cell = "GSO-500"', 'serial = "E0001"', 'channel = "Dev1/ai0"', 'connection = "emulated"']
)
@pytest.mark.parametrize("control", [ESCAPE, r"\u009b2J", r"\u007f"])
def test_no_text_of_a_bench_reaches_the_terminal_with_control_characters(line, control):
    message = refused_bench((line, line[:-1] + control + '"'))
    assert message.isprintable()
    assert line.split()[0] in message


@pytest.mark.parametrize("key", ["title", "prompt", "name", "scene"])
def test_no_text_of_a_campaign_reaches_the_terminal_with_control_characters(key):
    lines = {"title": '"t"', "prompt": '"p"', "name": '"n"', "scene": '"flat-low"', key: f'"{ESCAPE}"'}
    tests = "".join(f"{name} = {lines[name]}\n" for name in ("prompt", "name", "scene"))
    text = f"title = {lines['title']}\n[[test]]\n{tests}"
    with pytest.raises(FileError, match=key) as caught:
        parsed(Campaign, "campaign", text, "campaign.toml")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("name", "line", "words"),
    [
        ("indentation", f'positions = ["{ESCAPE}"]', "protocol.positions.0"),
        ("fiber", f'positions = ["{ESCAPE}"]', "protocol.positions.0"),
        ("volume", "strokes_ml = [0.0, 0.1]", "every stroke must move"),
        ("volume", "strokes_ml = [0.1, 1e-9]", "every stroke must move"),
        ("dead-weights", "masses_g = [0.0, -20.0, 50.0]", "protocol.masses_g.1 = -20.0"),
        ("punch", "approach_speed_um_s = 9000.0", "protocol.approach_speed_um_s = 9000.0"),
        (
            "punch",
            "aproach_speed_um_s = 9.0",
            "unknown key protocol.aproach_speed_um_s (did you mean approach_speed_um_s?",
        ),
    ],
)
def test_a_scene_that_cannot_be_meant_is_refused_by_its_own_keys(name, line, words):
    key = line.split()[0]
    text = "\n".join(old for old in scene_text(name).splitlines() if not old.startswith(key)) + f"\n{line}\n"
    with pytest.raises(FileError) as caught:
        parse_scene(text, "scene.toml")
    assert words in str(caught.value)


def test_a_place_in_a_list_is_its_number():
    with pytest.raises(FileError, match=r"test\.0\.repeats = 0"):
        parsed(Campaign, "campaign", 'title = "t"\n[[test]]\nscene = "flat-low"\nrepeats = 0\n', "c.toml")


def test_the_pump_is_stopped_before_anybody_waits_for_a_silent_stage(request_for):
    text = scene_text("volume")
    fault = Fault("stage", "silent", at_step="stroke 1", after_samples=280)
    request = request_for(referenced=True, faults=Faults([fault]))
    request = dataclasses.replace(request, scene=parse_scene(text, "scene"), scene_text=text)
    assert run_scene(request).exit_code == 6
    commands = [row["text"].decode() for row in load_recording(request.out).events if row["kind"] == b"command"]
    after = commands[max(i for i, command in enumerate(commands) if "dispense" in command) + 1 :]
    assert after[0] == "pump: stop"


def test_the_shipped_paper_rig_measures_its_compliance_as_it_is():
    text = (Path(__file__).parents[1] / "benches" / "paper-rig.toml").read_text("utf-8")
    text = re.sub(r"^(slope|relative_uncertainty|residual) = 0\.0", r"\1 = 0.01", text, flags=re.MULTILINE)
    bench = parse_bench(text.replace("FILL-IN", "a", 1).replace("FILL-IN", "b").replace("FILL IN", "a"), "paper-rig")
    assert bench.force.compliance_um_per_N == 0.0
    assert not said(bench, "compliance")


def test_the_return_is_no_faster_than_the_force_limits_can_stop(request_for):
    """(overload - larger limit) c / (t_f + t_r): (5.884 - 4.4) N * 12 um/N / 70 ms."""
    request = request_for()
    assert run_scene(request).exit_code == 0
    events = load_recording(request.out).events
    begun = next(row["sample"] for row in load_recording(request.out).steps if row["name"] == b"return")
    speeds = [row["text"].decode() for row in events if row["sample"] >= begun and b"speed" in row["text"]]
    assert len(speeds) == 1
    assert float(speeds[0].split()[2]) == pytest.approx(254.4, abs=0.1)
