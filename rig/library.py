"""Scenes that ship with the program, by name."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from rig.errors import FileError
from rig.scene import read_text


def find_scene(name: str) -> tuple[str, str]:
    """Return text and source of a scene: a file, or the name of one that ships.

    Raises
    ------
    FileError
        There is neither.
    """
    if Path(name).suffix or Path(name).exists():
        return read_text(Path(name), "scene"), name
    shipped = files("scenes").joinpath(f"{name}.toml")
    if "/" in name or "\\" in name or not shipped.is_file():
        raise FileError(f"scene {name}: no such file, and no scene of that name ships. Remedy: one of {_names()}.")
    return shipped.read_text("utf-8"), f"scenes/{name}.toml"


def _names() -> str:
    return ", ".join(
        sorted(item.name.removesuffix(".toml") for item in files("scenes").iterdir() if ".toml" in item.name)
    )
