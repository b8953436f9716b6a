"""What the console says of a scene before it may be run."""

from __future__ import annotations

from rig.bench import load_bench
from rig.check import reasons
from rig.console.checks import check_scene
from rig.library import find


def test_a_scene_that_fits_is_ready_and_names_its_steps():
    checked = check_scene("sphere-60mm-low", None)
    assert checked.ready
    assert checked.plan[0] == "tare"
    assert "of 8 ml" in checked.findings[-1]  # a tenth of the syringe is left alone at either end


def test_each_refusal_is_told_once_and_whole(tmp_path):
    text, _ = find("scene", "sphere-60mm-low")
    scene = tmp_path / "a; b: c.toml"
    text = text.replace("60 mm glass sphere", "a; b: c").replace(
        "approach_speed_um_s = 100.0", "approach_speed_um_s = 900.0"
    )
    scene.write_text(text.replace("preload_N = 0.5", "preload_N = 4.0"), "utf-8")
    checked = check_scene(str(scene), None)
    assert not checked.ready
    assert checked.scene is not None
    assert checked.refusals == tuple(reasons(checked.scene, load_bench(None)[0]))
    for key in ("preload_N", "approach_speed_um_s"):
        assert any(reason.startswith(f"{key} = ") for reason in checked.refusals)
    assert all("; " in reason and "a; b" not in reason for reason in checked.refusals)


def test_a_file_that_cannot_be_read_is_the_refusal(tmp_path):
    checked = check_scene(str(tmp_path / "none.toml"), None)
    assert checked.scene is None
    assert "none.toml" in checked.refusals[0]
