"""What several tests share: short scenes on the emulated bench."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from rig.bench import load_bench
from rig.library import find
from rig.scene import Scene
from rig.session import Request

settings.register_profile("same", derandomize=True)
settings.register_profile("explore", derandomize=False, print_blob=True)
settings.load_profile("same")

SHORT = {"preload_dwell_s": 1.0, "tare_s": 0.5, "retract_speed_um_s": 100.0, "preload_N": 0.3}


def scene_text(name: str, **protocol: Any) -> str:
    """Return a shipped scene's text with other protocol values."""
    text, _ = find("scene", name)
    lines = text.splitlines()
    for key, value in protocol.items():
        lines = [line for line in lines if not line.startswith(f"{key} ")]
        lines.append(f"{key} = {value}")
    return "\n".join(lines)


@pytest.fixture
def request_for(tmp_path: Path) -> Callable[..., Request]:
    """Return a maker of requests: a shipped scene, shortened, on the direct emulated bench unless told otherwise."""

    def make(name: str = "sphere-60mm-vented", *, protocol: dict[str, Any] | None = None, **options: Any) -> Request:
        text = scene_text(name, **{**SHORT, **(protocol or {})})
        bench, bench_text = load_bench(None)
        request = Request(
            Scene.model_validate(tomllib.loads(text)),
            text,
            bench,
            bench_text,
            tmp_path / "run.h5",
            wire=False,
            live=False,
        )
        return dataclasses.replace(request, **options)

    return make
