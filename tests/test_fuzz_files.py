"""Scene, bench and fault files, and recordings, as no one would write them: one clear error, never a crash."""

from __future__ import annotations

import string
import tomllib

import h5py
import pytest
from conftest import scene_text
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.bench import load_bench, parse_bench
from rig.check import check
from rig.errors import FileError, Refused
from rig.recording import load_recording
from rig.scene import parse_scene
from rig.session import run_scene

SCENE = scene_text("sphere-60mm-low")
BENCH = load_bench(None)[1]
VALUES = st.one_of(
    st.floats().map(repr),
    st.integers().map(str),
    st.booleans().map(lambda value: str(value).lower()),
    st.text(string.printable, max_size=12).map(lambda text: f'"{text}"'),
    st.sampled_from(
        ["[]", "{}", "nan", "inf", "-inf", "-0.0", "1e308", "[[]]", "2024-01-01", '"\\u0000"', '"emulated"', "''"]
    ),
)


@st.composite
def damaged(draw: st.DrawFn, text: str) -> str:
    """A file with values changed, lines lost, doubled or moved, or characters put in."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        number = draw(st.integers(0, len(lines) - 1))
        match draw(st.integers(0, 4)):
            case 0:
                lines[number] = f"{lines[number].partition('=')[0]}= {draw(VALUES)}"
            case 1:
                del lines[number]
            case 2:
                lines.insert(draw(st.integers(0, len(lines))), lines[number])
            case 3:
                lines[number] += draw(st.text(max_size=4))
            case _:
                lines.insert(
                    number, f"{draw(st.text(string.ascii_lowercase + '_.', min_size=1, max_size=9))} = {draw(VALUES)}"
                )
        lines = lines or [""]
    return "\n".join(lines)


def read(scene_text: str, bench_text: str) -> str | None:
    """Read both files and check them against each other; return the refusal."""
    try:
        check(parse_scene(scene_text, "scene.toml"), parse_bench(bench_text, "bench.toml"))
    except (FileError, Refused) as error:
        return str(error)
    return None


@settings(max_examples=300, deadline=None)
@given(text=damaged(SCENE))
def test_a_damaged_scene_is_read_or_refused_in_one_message(text):
    refusal = read(text, BENCH)
    assert refusal is None or "scene" in refusal


@settings(max_examples=300, deadline=None)
@given(text=damaged(BENCH))
def test_a_damaged_bench_is_read_or_refused_in_one_message(text):
    refusal = read(SCENE, text)
    assert refusal is None or "bench" in refusal


@settings(max_examples=200, deadline=None)
@given(text=st.text(max_size=300))
def test_any_text_is_refused(text):
    assert "scene" in (read(text, BENCH) or "")


@settings(max_examples=100, deadline=None)
@given(
    title=st.text(max_size=30),
    preload=st.floats(1e-6, 50, exclude_min=True),
    speed=st.floats(1e-3, 1000, exclude_min=True),
    pressure=st.floats(-101, 1000),
)
def test_a_scene_that_is_accepted_stays_within_what_the_cell_survives(title, preload, speed, pressure):
    del title
    bench = parse_bench(BENCH, "bench.toml")
    scene = parse_scene(
        scene_text("sphere-60mm-low", preload_N=preload, approach_speed_um_s=speed, initial_pressure_kPa=pressure), "s"
    )
    try:
        check(scene, bench)
    except Refused:
        return
    stiffness = 1 / (bench.force.compliance_um_per_N * 1e-6)
    late = (bench.daq.frame_ms * 1e-3 + bench.limits.lag_s) * speed * 1e-6
    furthest = max(late, bench.limits.look_ahead_um * 1e-6)
    assert preload + stiffness * furthest <= 1.2 * bench.force.capacity_N


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The bytes of a short recording."""
    from rig.scene import Scene
    from rig.session import Request

    bench, bench_text = load_bench(None)
    text = scene_text("sphere-60mm-vented", tare_s=0.5)
    path = tmp_path_factory.mktemp("recorded") / "run.h5"
    from rig.observe import Controls, Observer

    controls = Controls()

    class Stop(Observer):
        def frame(self, frame):
            if frame.stop > 2000:
                controls.stop()

    scene = Scene.model_validate(tomllib.loads(text))
    run_scene(
        Request(scene, text, bench, bench_text, path, wire=False, live=False, observers=[Stop()], controls=controls)
    )
    return path.read_bytes()


def try_to_read(path) -> None:
    try:
        load_recording(path)
    except FileError as error:
        assert path.name in str(error)
        assert "\n" not in str(error).strip()


@settings(max_examples=3, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_a_damaged_recording_is_read_or_refused(data, recorded, tmp_path, monkeypatch):
    monkeypatch.setattr("rig.seal.PROBE_SECONDS", 3.0)
    content = bytearray(recorded)
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path / "damaged.h5"
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    try_to_read(path)


@pytest.mark.parametrize("part", ["raw/volts", "raw/frames", "data/force", "configuration/scene", "ending", "steps"])
@pytest.mark.parametrize("change", ["missing", "kind", "shape"])
def test_a_recording_with_a_wrong_part_is_refused(part, change, recorded, tmp_path, monkeypatch):
    monkeypatch.setattr("rig.recovery.probe", lambda path: None)  # the file is sound HDF5: no process is needed
    path = tmp_path / "wrong.h5"
    path.write_bytes(recorded)
    with h5py.File(path, "r+") as file:
        entry = file["entry"]
        del entry[part]
        if change == "kind":
            entry.create_group(part)
        elif change == "shape":
            entry[part] = [[[1.0]]]
    with pytest.raises(FileError, match=r"wrong\.h5"):
        load_recording(path)


def test_a_text_of_a_recording_that_is_many_texts_is_refused(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr("rig.recovery.probe", lambda path: None)
    path = tmp_path / "wrong.h5"
    path.write_bytes(recorded)
    with h5py.File(path, "r+") as file:
        notes = file["entry/configuration"]
        del notes["place"]
        notes["place"] = ["top", "left"]
    with pytest.raises(FileError, match="place is not one text"):
        load_recording(path)
