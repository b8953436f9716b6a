"""Areas measured after the test: the file, and how they reach a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.synthetic import Profile, pull_off_run
from rig.areas import read_areas, strangers, useless, with_area
from rig.cli import main
from rig.errors import FileError


def written(folder: Path, text: str) -> Path:
    path = folder / "areas.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_each_recording_gets_its_own_area(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "recording, area_mm2, uncertainty_mm2, real_um2, projected_um2\n"
        "left.h5, 0.78, 0.02,,\nright, 0.76,,,\nmonday-left, 0.7,,,\nspl-1,,,12787.0,20687.3\nleft,0.79,,,\n",
    )
    areas = read_areas(path)
    assert areas["left"] == {"contact_area_mm2": 0.79, "contact_area_uncertainty_mm2": 0.02}
    assert areas["right"] == {"contact_area_mm2": 0.76}
    assert areas["spl-1"] == {"real_area_um2": 12787.0, "projected_area_um2": 20687.3}
    assert areas["monday-left"] == {"contact_area_mm2": 0.7}  # as the analysis names one of two of the same name
    assert strangers(areas, ["left", "monday-left", "spl-1"]) == ["right"]
    run, _ = pull_off_run(Profile.jkr(4.0, 4e-3, 2e6, 0.095))
    assert with_area(run, areas) is run
    assert with_area(run, {run.name: areas["right"]}).settings["contact_area_mm2"] == 0.76


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "recording and any of"),
        ("recording,area\nleft,1\n", "recording and any of"),
        ("recording,area_mm2\nleft,0\n", "line 2, area_mm2: '0' is no area"),
        ("recording,area_mm2\nleft,nan\n", "is no area"),
        ("recording,area_mm2\nleft,0,78\n", "decimal point"),
        ("recording,area_mm2\n,0.78\n", "names no recording"),
    ],
)
def test_what_is_no_area_is_refused_by_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(FileError, match=words):
        read_areas(written(tmp_path, text))
    with pytest.raises(FileError, match=r"nowhere\.csv"):
        read_areas(tmp_path / "nowhere.csv")


def test_an_area_that_a_test_has_no_use_for_is_told(tmp_path: Path) -> None:
    run, _ = pull_off_run(Profile.jkr(4.0, 4e-3, 2e6, 0.095))
    areas = {run.name: {"contact_area_mm2": 60.0, "real_area_um2": 1.0}}
    assert useless(areas, [run]) == [f"{run.name}: real_area_um2 is of no use to a pull_off test"]


def image(folder: Path) -> Path:
    from skimage.io import imsave

    y, x = np.mgrid[:400, :400]
    shade = np.where(np.hypot(x - 200, y - 190) < 125, 60, 200) + 40 * (x - 200) / 200
    path = folder / "left.png"
    imsave(path, shade.astype(np.uint8), check_contrast=False)
    return path


def test_an_image_becomes_a_line_that_the_analysis_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture, areas = image(tmp_path), tmp_path / "areas.csv"
    assert main(["contact-area", str(picture), "--scale", "4"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("recording,area_mm2,uncertainty_mm2\nleft,0.78")
    assert "uneven light" in printed.err
    for name in ("left", "right"):
        assert main(["contact-area", str(picture), "--scale", "4", "--recording", name, "--add", str(areas)]) == 0
    found = read_areas(areas)
    assert list(found) == ["left", "right"]
    assert found["left"]["contact_area_mm2"] == pytest.approx(np.pi * 0.5**2, rel=0.01)
    assert 0.02 < found["left"]["contact_area_uncertainty_mm2"] / 0.785 < 0.03


def test_what_is_no_image_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = tmp_path / "words.png"
    words.write_text("no image", encoding="utf-8")
    assert main(["contact-area", str(words), "--scale", "4"]) == 2
    assert main(["contact-area", str(tmp_path / "none.png"), "--scale", "4"]) == 2
    assert main(["contact-area", str(image(tmp_path)), "--scale", "-1"]) == 1
    assert "Traceback" not in capsys.readouterr().err
