"""The run in a terminal: one line per step, the value of its condition while it lasts, warnings in full."""

from __future__ import annotations

from rig.observe import Ending, Event, Observer, RunInfo, StepEvent, StepPhase
from rig.voice import Voice

_SCALES = {"N": ("N", 1.0), "Pa": ("kPa", 1e-3), "s": ("s", 1.0), "m": ("mm", 1e3)}
_SHOWN = {"warning", "fault", "interlock", "operator", "prompt"}


class Terminal(Observer):
    """Writes to standard error; on a terminal the running step's line is rewritten in place."""

    def __init__(self, voice: Voice | None = None) -> None:
        self._voice = Voice() if voice is None else voice
        self._live = self._voice.live
        self._conditions: dict[str, str] = {}
        self._rate = 1.0

    def started(self, info: RunInfo) -> None:
        """Say what is run and where it is recorded."""
        self._conditions = {step.name: step.condition for step in info.plan}
        self._rate = info.rate
        again = f" ({info.repeat} of {info.repeats})" if info.repeats > 1 else ""
        self._line(f"{info.title}{again}, recording {info.recording or 'nothing'}")

    def step(self, event: StepEvent) -> None:
        """Show the step's condition and how far it is."""
        when = f"{event.sample / self._rate:8.1f} s  {event.name:<11}"
        if event.phase is StepPhase.STARTED:
            self._line(f"{when}until {self._conditions.get(event.name, 'done')}", stay=self._live)
        elif event.phase is StepPhase.PROGRESS and self._live:
            unit, scale = _SCALES.get(event.unit, (event.unit, 1.0))
            self._line(f"{when}{event.value * scale:+.4f} of {event.target * scale:+.4f} {unit}", stay=True)
        elif event.phase is StepPhase.ENDED and (self._live or event.outcome != "done"):
            self._line(f"{when}{event.outcome}")

    def event(self, event: Event) -> None:
        """Show what the operator must know."""
        if event.kind in _SHOWN:
            self._line(f"{event.sample / self._rate:8.1f} s  {event.kind}: {event.text}")

    def finished(self, ending: Ending) -> None:
        """Say how it ended."""
        self._line(f"{ending.samples / self._rate:8.1f} s  ended: {ending.reason}")
        self._voice.finish()

    def _line(self, text: str, *, stay: bool = False) -> None:
        lead, end = ("\r\x1b[K", "") if self._live else ("", "\n")
        self._voice.say(f"{lead}{text}{end if stay or not self._live else chr(10)}")
