"""Fault scripts: what goes wrong on the emulated bench, and when, as a TOML file of ``[[fault]]`` tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from drivers.emulated.faults import Fault, Faults
from rig.library import read_text
from rig.validation import Section, parsed

Samples = Annotated[int, Field(ge=0)]


class FaultSection(Section):
    """``[[fault]]``; the keys are those of ``drivers.emulated.faults.Fault``."""

    device: str
    kind: str
    at_sample: Samples | None = None
    at_step: str | None = None
    after_samples: Samples = 0
    for_samples: Samples | None = None
    value: float = 0.0

    @model_validator(mode="after")
    def _is_known(self) -> FaultSection:
        known = known_faults()
        if self.device not in known:
            raise ValueError(f"device = {self.device!r} is none of {', '.join(known)}. Remedy: name one of them")
        if self.kind not in known[self.device]:
            kinds = ", ".join(sorted(known[self.device]))
            raise ValueError(f"kind = {self.kind!r} is no fault of {self.device!r}. Remedy: use one of {kinds}")
        if self.at_sample is not None and self.at_step is not None:
            raise ValueError("both at_sample and at_step are given. Remedy: keep one")
        return self


class FaultScript(Section):
    """The whole file."""

    fault: list[FaultSection]


def load_faults(path: Path) -> Faults:
    """Read and check a fault script.

    Raises
    ------
    FileError
        Names the file, the fault, the key, the value and what is allowed.
    """
    script = parsed(FaultScript, "fault script", read_text("fault script", path), str(path))
    return Faults(Fault(**table.model_dump()) for table in script.fault)


def known_faults() -> dict[str, dict[str, str]]:
    """Return what each emulated device can be made to do wrong, with the meaning of every kind."""
    from drivers.emulated import daq, plant, pump, stage

    known: dict[str, dict[str, str]] = {"stage": dict(stage.FAULTS), "pump": dict(pump.FAULTS)}
    for faults in (daq.FAULTS, plant.FAULTS):
        for device, kinds in faults.items():
            known[device] = {**kinds, **known.get(device, {})}
    return known
