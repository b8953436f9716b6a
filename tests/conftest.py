"""What several tests share: short scenes on the emulated bench."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from rig.bench import load_bench
from rig.library import find
from rig.link_address import DIRECTORY_VARIABLE
from rig.scene import Scene
from rig.session import Request

# How long an input takes is the computer's affair.
ANY_SPEED: dict[str, Any] = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **ANY_SPEED)
settings.register_profile("explore", derandomize=False, print_blob=True, **ANY_SPEED)
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


@pytest.fixture(scope="session", autouse=True)
def own_runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep locks and addresses of the tests' runs, and of the processes they start, apart from all others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(DIRECTORY_VARIABLE, str(tmp_path_factory.mktemp("runs")))
        yield


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


@pytest.fixture
def tell_bench(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any], None]], None]:
    """Return a function that takes who is to be told the emulated bench of every run."""
    from rig import emulation

    def tell(to: Callable[[Any], None]) -> None:
        make = emulation.emulated_bench

        def made(request: Request) -> Any:
            bench = make(request)
            to(bench)
            return bench

        monkeypatch.setattr(emulation, "emulated_bench", made)

    return tell
