"""The house rules: style, types, direction of imports, and what is imported when."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BIN = Path(sys.executable).parent


def run(*command: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "command",
    [
        ("-m", "ruff", "check", "."),
        ("-m", "ruff", "format", "--check", "."),
        ("-m", "mypy"),
        ("-c", "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports())"),
    ],
    ids=["ruff", "format", "mypy", "imports"],
)
def test_the_tree_is_clean(command):
    done = run(sys.executable, *command)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


RUN = """
import sys
from rig.cli import main
code = main(["run", "{scene}", "--out", r"{out}", "--no-live", "--no-picture"])
print(code, *sorted(sys.modules))
"""


def modules_after(scene: str, tmp_path: Path) -> set[str]:
    done = run(sys.executable, "-c", RUN.format(scene=scene, out=tmp_path / "run.h5"))
    code, *modules = done.stdout.split()
    assert code == "0", done.stderr
    return set(modules)


def test_a_scene_imports_what_it_needs_and_no_more(tmp_path):
    scene = tmp_path / "quick.toml"
    text = (ROOT / "scenes" / "sphere-60mm-vented.toml").read_text()
    scene.write_text(text.replace("retract_speed_um_s = 10.0", "retract_speed_um_s = 100.0"))
    modules = modules_after(str(scene), tmp_path)
    assert {"pipython", "nidaqmx", "grpc"} <= modules
    unwanted = {"drivers.pump", "drivers.pressure", "drivers.emulated.pump", "serial"}
    assert not modules & {*unwanted, "PySide6", "matplotlib", "pandas", "analysis.pipeline", "model.cone", "skfem"}


def test_help_and_predict_import_little():
    code = "import sys; from rig.cli import main\ntry: main({words})\nfinally: print('MODULES', *sorted(sys.modules))"
    for words, unwanted in (
        (["--help"], {"numpy", "pydantic", "h5py"}),
        (
            ["predict", "scenes/flat-low.toml", "--json"],
            {"scipy", "h5py", "pandas", "matplotlib", "nidaqmx", "PySide6"},
        ),
    ):
        done = run(sys.executable, "-c", code.format(words=words))
        modules = set(done.stdout.split("MODULES", 1)[1].split())
        assert not modules & unwanted, (words, modules & unwanted)


def test_the_readme_commands_are_where_ci_looks_for_them():
    lines = (ROOT / "README.md").read_text().splitlines()
    for heading in ("Pass the tests:", "Debian packages for the console:"):
        place = lines.index(heading)
        assert lines[place + 2].startswith("    ")


def test_every_link_of_the_documentation_leads_somewhere():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    broken = [
        f"{page.name}: {target}"
        for page in pages
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text("utf-8"))
        if "://" not in target and not (page.parent / target).exists()
    ]
    assert not broken
