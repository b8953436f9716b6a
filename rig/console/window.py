"""The console's window: one run at a time, live or replayed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QCloseEvent, QKeySequence, QShortcut
from PySide6.QtWidgets import (
    QFileDialog,
    QHBoxLayout,
    QLabel,
    QMainWindow,
    QProgressBar,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from rig.console.checks import Checked, check_scene
from rig.console.controls import RunControls, Transport, button
from rig.console.emergency import EmergencyKey
from rig.console.export import save
from rig.console.log import EventLog
from rig.console.panels import (
    PredictionCard,
    PumpCard,
    Readings,
    RecordingCard,
    StageCard,
    StepStrip,
    label,
    set_tone,
    step_words,
)
from rig.console.playhead import Playhead
from rig.console.plots import FORCE, PRESSURE, Plot, RetractionPlot, TimePlot, grid
from rig.console.runner import Child, replay_arguments, run_arguments
from rig.console.story import Moment, Story
from rig.console.theme import THEMES, Theme, style_sheet
from rig.console.timing import durations, time_left, time_to_pull_off
from rig.console.words import duration
from rig.errors import RigError
from rig.link import OVER, Answer, Link
from rig.link_address import Address, LinkError, running
from rig.observe import RunInfo

REFRESH_MS = 33
PICTURES_PER_TEXT = 3
MESSAGES_PER_REFRESH = 400
"""A console that attaches late catches up over several refreshes and stays usable meanwhile."""


class Console(QMainWindow):
    """The operator's console.

    Parameters
    ----------
    scenes
        Names or paths offered in the scene picker.
    theme
        ``"dark"`` or ``"light"``.
    """

    def __init__(self, scenes: list[str], theme: str = "dark") -> None:
        super().__init__()
        self.setWindowTitle("rig console")
        self.theme: Theme = THEMES[theme]
        self.link: Link | None = None
        self.child: Child | None = None
        self.story: Story | None = None
        self.playhead = Playhead(live=True)
        self.checked: Checked | None = None
        self.holding = False
        self.frames_painted = 0
        self._replaying = False
        self._known: dict[str, float] = {}
        self._answers: deque[Callable[[], None]] = deque()
        self._commands = ThreadPoolExecutor(1, thread_name_prefix="console command")
        self._emergencies = ThreadPoolExecutor(2, thread_name_prefix="console emergency stop")
        self._last_tick = time.monotonic()
        self._refresh_s = REFRESH_MS * 1e-3
        self._build(scenes)
        self.repaint_theme()
        self._filter = EmergencyKey(self)
        self._timer = QTimer(self)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self.refresh)
        self._timer.start(REFRESH_MS)
        self.check()
        self.controls.run.setFocus()

    # ------------------------------------------------------------ construction

    def _build(self, scenes: list[str]) -> None:
        actions = {
            "check": self.check, "run": self.run, "hold": self.hold, "resume": self.resume, "stop": self.stop,
            "attach": self.attach_newest, "open": self.open_recording,
        }  # fmt: skip
        self.controls = RunControls(actions, scenes)
        self.controls.scene.currentIndexChanged.connect(lambda _: self.check())
        self.controls.bench.currentIndexChanged.connect(lambda _: self.check())
        moves = {
            "play": self.play_or_pause, "back": lambda: self._step(-1), "forward": lambda: self._step(1),
            "previous": lambda: self._to_step(-1), "next": lambda: self._to_step(1), "leave": self.leave,
        }  # fmt: skip
        self.transport = Transport(moves, self.jump)
        self.transport.speed.currentIndexChanged.connect(self._set_speed)
        self.transport.setVisible(False)
        ground = QWidget()
        ground.setObjectName("ground")
        column = QVBoxLayout(ground)
        column.setContentsMargins(12, 10, 12, 8)
        column.setSpacing(8)
        column.addLayout(self._header())
        self.strip = StepStrip()
        column.addWidget(self.strip)
        self.banner = label("banner")
        self.banner.setWordWrap(True)
        self.banner.setVisible(False)
        self.banner.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        column.addWidget(self.banner)
        column.addLayout(self._middle(), 1)
        column.addWidget(self.controls)
        column.addWidget(self.transport)
        self.setCentralWidget(ground)
        self._status_line()
        for key, action in (("F", self.refollow), ("Ctrl+T", self.switch_theme), ("Ctrl+Q", self.close)):
            QShortcut(QKeySequence(key), self).activated.connect(action)

    def _header(self) -> QHBoxLayout:
        self.title, self.state = label("title", "no run"), label("state", "idle")
        self.words, self.clock = label("step"), label("value")
        self.left = label("small")
        self.progress = QProgressBar()
        self.progress.setFixedWidth(150)
        self.progress.setVisible(False)
        self.theme_button = button("light", "", "Dark or light (Ctrl+T)", self.switch_theme)
        self.emergency = QPushButton("EMERGENCY STOP  Esc")
        self.emergency.setObjectName("emergency")
        self.emergency.setAccessibleName("emergency stop")
        self.emergency.setToolTip("Halts the stage at once, then ends the run. Key: Esc, everywhere in this program")
        self.emergency.setMinimumHeight(64)
        self.emergency.pressed.connect(self.emergency_stop)  # on the way down, not on release
        names = QVBoxLayout()
        names.setSpacing(2)
        top = QHBoxLayout()
        top.addWidget(self.title)
        top.addSpacing(10)
        top.addWidget(self.state)
        top.addStretch(1)
        names.addLayout(top)
        names.addWidget(self.words)
        times = QVBoxLayout()
        times.setSpacing(2)
        for widget in (self.clock, self.left):
            widget.setAlignment(Qt.AlignmentFlag.AlignRight)
            times.addWidget(widget)
        row = QHBoxLayout()
        row.setSpacing(14)
        row.addLayout(names, 1)
        row.addWidget(self.progress)
        row.addLayout(times)
        row.addWidget(self.theme_button)
        row.addWidget(self.emergency)
        return row

    def _middle(self) -> QHBoxLayout:
        self.force_time, self.force_path = TimePlot(FORCE, self.export), RetractionPlot(FORCE, self.export)
        self.pressure_time, self.pressure_path = TimePlot(PRESSURE, self.export), RetractionPlot(PRESSURE, self.export)
        self.plots: list[Plot] = [self.force_time, self.force_path, self.pressure_time, self.pressure_path]
        self.readings, self.prediction = Readings(), PredictionCard()
        self.stage, self.pump, self.recording = StageCard(), PumpCard(), RecordingCard()
        self.log = EventLog()
        left = QVBoxLayout()
        left.setSpacing(8)
        left.addWidget(grid([self.force_path, self.force_time], [self.pressure_path, self.pressure_time]), 1)
        left.addWidget(self.log)
        side = QWidget()
        side.setFixedWidth(344)
        right = QVBoxLayout(side)
        right.setContentsMargins(0, 0, 0, 0)
        right.setSpacing(8)
        for card in (self.readings, self.prediction, self.stage, self.pump, self.recording):
            right.addWidget(card)
        right.addStretch(1)
        row = QHBoxLayout()
        row.setSpacing(8)
        row.addLayout(left, 1)
        row.addWidget(side)
        return row

    def _status_line(self) -> None:
        self.status_model, self.status_link, self.status_rate = QLabel(), QLabel(), QLabel()
        bar = self.statusBar()
        bar.setSizeGripEnabled(False)
        bar.addWidget(self.status_model, 1)
        bar.addPermanentWidget(self.status_link)
        bar.addPermanentWidget(self.status_rate)

    # ------------------------------------------------------------ looks

    def repaint_theme(self) -> None:
        """Put the theme on everything."""
        self.setStyleSheet(style_sheet(self.theme))
        self.strip.paint_theme(self.theme)
        for plot in self.plots:
            plot.paint(self.theme)
        self.theme_button.setText("light" if self.theme.name == "dark" else "dark")

    def switch_theme(self) -> None:
        """Dark to light and back."""
        self.theme = THEMES["light" if self.theme.name == "dark" else "dark"]
        self.repaint_theme()

    def refollow(self) -> None:
        """Let every plot show the newest data again."""
        for plot in self.plots:
            plot.refollow()

    def _use(self, *, pressure: bool, protocol: str, steps: list[str]) -> None:
        """Show nothing the scene does not use."""
        retracts = "retract" in steps
        self.force_path.widget.setVisible(retracts)
        self.pressure_time.widget.setVisible(pressure)
        self.pressure_path.widget.setVisible(pressure and retracts)
        self.pump.setVisible(pressure)
        self.readings.prepare(uses_pressure=pressure, retracts=retracts)
        self.prediction.setVisible(protocol == "pull_off")
        self.strip.plan(steps)

    # ------------------------------------------------------------ before a run

    def check(self) -> None:
        """Hold the chosen scene against the bench and say what was found; nothing is opened and nothing moves."""
        if self.link is not None:
            return
        self.forget_run()
        self.checked = checked = check_scene(self.controls.scene.currentText(), self.controls.bench_path)
        self.log.clear()
        for finding in checked.findings:
            self.log.appendPlainText(f"\u2713  {finding}")
        for refusal in checked.refusals:
            self.log.appendPlainText(f"\u2715  {refusal}")
        self._say_fault("\n".join(checked.refusals))
        if checked.scene is not None:
            self.title.setText(checked.scene.title)
            name = checked.scene.protocol.name
            self._use(pressure=checked.scene.uses_pressure, protocol=name, steps=list(checked.plan))
            if name == "pull_off" and checked.scene.gripper.kind == "rigid":  # the papers model no other
                self._expect(checked)
        self._set_state("checked: ready" if checked.ready else "refused", "good" if checked.ready else "fault")
        self._offer()

    def _expect(self, checked: Checked) -> None:
        """Draw what the model says of the scene's own values."""
        from model import ModelError, predict

        if checked.scene is None:
            return
        try:
            expected = predict(checked.scene.parameters())
        except ModelError as error:
            self.status_model.setText(f"model: {error}")
            return
        self.force_path.expect(expected.retraction, expected.force)
        self.pressure_path.expect(expected.retraction, expected.pressure)
        self.prediction.expect(expected.pull_off_force, expected.pull_off_distance, expected.model)
        self._say_cost(expected.model, dict(expected.numerical_error), expected.runtime_s, "")

    def run(self) -> None:
        """Start the chosen scene in a process of its own and attach to it."""
        self.check()
        if self.checked is None or not self.checked.ready:
            return
        controls = self.controls
        speed = controls.speed.currentData() if self.checked.emulated else None
        scene, repeats = controls.scene.currentText(), controls.repeats.value()
        arguments = run_arguments(scene, controls.bench_path, speed, repeats)
        self._known = {}
        self.start(Child(arguments), replaying=False)

    def start(self, child: Child, *, replaying: bool) -> None:
        """Follow a run or replay that has been started."""
        self.child = child
        self._replaying = replaying
        self._set_state("starting", "active")
        self._offer()

    # ------------------------------------------------------------ attachment

    def attach(self, address: Address, *, replaying: bool = False) -> None:
        """Watch a run.

        Raises
        ------
        LinkError
            The run is not there.
        """
        self.link = Link(address)
        self._replaying = replaying
        self._offer()

    def attach_newest(self) -> None:
        """Watch the run that was started last."""
        for address in running():
            try:
                self.attach(address)
            except LinkError:
                continue
            return
        self._say_fault("No run to attach to. Remedy: start one here, or with `rig run SCENE --link`.")

    def open_recording(self) -> None:
        """Ask for a recording and replay it."""
        name, _ = QFileDialog.getOpenFileName(self, "Recording", "", "Recordings (*.h5 *.nxs);;All files (*)")
        if name:
            self.replay(Path(name))

    def replay(self, recording: Path, model: str | None = None, changes: tuple[str, ...] = ()) -> None:
        """Replay a recording through the loop; ``model`` and ``changes`` ask what would have been predicted."""
        self.forget_run()
        self.title.setText(recording.name)
        self.start(Child(replay_arguments(recording, model, changes)), replaying=True)

    def leave(self) -> None:
        """Leave a replay."""
        self._detach()
        self._end_replay()
        self.check()

    def forget_run(self) -> None:
        """Clear the window of a run that is over."""
        self.story = None
        self.holding = False
        self._say_fault("")
        self.strip.plan([])
        self.prediction.clear()
        for plot in self.plots:
            plot.clear()
        self.log.clear()
        self.log.forget()
        for widget in (self.words, self.clock, self.left):
            widget.setText("")

    def _detach(self) -> None:
        if self.link is not None:
            self.link.close()
            self.link = None

    def _end_replay(self) -> None:
        """A replay belongs to this console alone: it may be ended with it. A run never is."""
        if self._replaying and self.child is not None and self.child.alive:
            self.child.process.terminate()
        self._replaying = False
        self.child = None
        self.playhead = Playhead(live=True)

    # ------------------------------------------------------------ commands

    def hold(self) -> None:
        """Stop the motion and wait. The run's own word, not this command, shows that it holds."""
        self._command("hold", lambda: None)

    def resume(self) -> None:
        """Go on after a hold."""
        self._command("resume", lambda: None)

    def stop(self) -> None:
        """End the run in good order; a run that does not answer is killed."""
        self._command("stop", lambda: self._set_state("stopping", "warning"))

    def _command(self, command: str, done: Callable[[], None]) -> None:
        link = self.link
        if link is None or self._replaying:
            return

        def ask() -> None:
            answer = link.command(command)
            self._answers.append(lambda: self._answered(command, answer, done))

        self._commands.submit(ask)

    def emergency_stop(self) -> None:
        """Put the stop on the wire now, from this very call; a run that does not answer in time is killed."""
        link = self.link
        if self._replaying:
            return
        if link is None:
            self._end_child()
            self._set_state("EMERGENCY STOP", "fault")
            return
        asked = link.send_emergency_stop()

        def confirm() -> None:
            answer = link.confirm_emergency_stop(asked)
            self._answers.append(lambda: self._answered("emergency stop", answer, lambda: None))

        self._emergencies.submit(confirm)
        self._set_state("EMERGENCY STOP", "fault")

    def _end_child(self) -> None:
        """Let no further test begin: the run is starting or between two tests, and there is no link to ask it by."""
        if self.child is not None and self.child.alive:
            self.child.process.terminate()

    def _answered(self, command: str, answer: Answer, done: Callable[[], None]) -> None:
        if answer.text == OVER and command.endswith("stop"):
            self._end_child()
        if answer.done:
            done()
            words = f"{command}: acknowledged after {answer.delay_s * 1e3:.1f} ms"
        else:
            words = f"{command}: {answer.text}"
            self._say_fault(f"{words[0].upper()}{words[1:]}.")
        self.statusBar().showMessage(words, 6000)

    # ------------------------------------------------------------ replay

    def play_or_pause(self) -> None:
        """Play or pause; at the end, play from the start."""
        story = self.story
        if story is not None and not self.playhead.playing and self.playhead.sample >= story.end:
            self.playhead.jump(0, story.end)
        self.playhead.playing = not self.playhead.playing

    def jump(self, fraction: float) -> None:
        """Go to a place in the recording, 0 to 1."""
        if self.story is not None:
            self.playhead.jump(fraction * self.story.end, self.story.end)

    def _set_speed(self, _: int) -> None:
        self.playhead.speed = float(self.transport.speed.currentData())

    def _step(self, frames: int) -> None:
        if self.story is not None:
            self.playhead.step(frames * self.story.info.frame_samples, self.story.end)

    def _to_step(self, direction: int) -> None:
        if self.story is None:
            return
        here = self.playhead.sample
        starts = [sample for sample, _ in self.story.boundaries(self.story.at(self.story.end))]
        wanted = [s for s in starts if s > here] if direction > 0 else [s for s in starts if s < here - 500][::-1]
        self.playhead.jump(wanted[0] if wanted else (self.story.end if direction > 0 else 0), self.story.end)

    # ------------------------------------------------------------ refresh

    def refresh(self) -> None:
        """Take what has come and paint. Called by the timer."""
        now = time.monotonic()
        elapsed, self._last_tick = now - self._last_tick, now
        while self._answers:
            self._answers.popleft()()
        self._look_for_run()
        link = self.link
        if link is not None:
            for message in link.take(MESSAGES_PER_REFRESH):
                if isinstance(message, RunInfo):
                    self._begin(message)
                elif self.story is not None:
                    self.story.add(message)
        if self.story is not None:
            self._show(self.story, elapsed)
        if link is not None and link.over:
            self._ended()
        self._refresh_s += 0.05 * (elapsed - self._refresh_s)
        self.frames_painted += 1

    def _look_for_run(self) -> None:
        """Attach to the run this console has started as soon as it serves; say why when it never does."""
        child = self.child
        if child is None or self.link is not None:
            return
        over = not child.alive
        address = child.address()
        if address is not None:
            try:
                self.attach(address, replaying=self._replaying)
            except LinkError:
                return
        elif over:
            if child.exit_code and (self.story is None or self.story.ending is None):
                self._say_fault(child.output() or f"the run ended with exit code {child.exit_code}")
                self._set_state("failed", "fault")
            child.forget()
            if not self._replaying:
                self.child = None
            self._offer()

    def _begin(self, info: RunInfo) -> None:
        """A run has told what it is."""
        if self.story is not None and self.story.ending is not None:
            self._known = durations(self.story)
        self.forget_run()
        self.story = Story(info)
        self.playhead = Playhead(live=not self._replaying)
        self._set_speed(0)
        self.title.setText(info.title)
        steps = [plan.name for plan in info.plan]
        self._use(pressure=info.uses_pressure, protocol=info.protocol, steps=steps)
        self.stage.prepare(info)
        self.recording.prepare(info, replay=self._replaying)
        self.progress.setVisible(info.repeats > 1)
        self._offer()

    def _show(self, story: Story, elapsed: float) -> None:
        sample = self.playhead.advance(elapsed, story.rate, story.end)
        moment = story.at(sample)
        for plot in self.plots:
            if plot.widget.isVisible():
                plot.show(story, moment)
        self.strip.show_moment(moment)
        if self._replaying:
            self.transport.show_place(sample, story.end, story.rate, playing=self.playhead.playing)
        if self.frames_painted % PICTURES_PER_TEXT == 0 or moment.ending is not None:
            self._show_texts(story, moment)

    def _show_texts(self, story: Story, moment: Moment) -> None:
        """Numbers change ten times a second: faster, nobody reads them, and each change lays the window out anew."""
        waiting = story.waiting(moment) if moment.ending is None else ""
        if bool(waiting) != self.holding:
            self.holding = bool(waiting)
            self._offer()
        prompt = "" if waiting in ("", "hold") else f"\u270b {waiting}  \u2192  Resume F7"
        self.words.setText(prompt or step_words(moment))
        self.readings.show_moment(moment)
        first = story.predictions[0] if story.predictions else None
        self.prediction.show_moment(moment, first, story.measured(moment))
        self.stage.show_moment(moment)
        self.pump.show_moment(moment)
        self.recording.show_moment(moment, story)
        self._show_times(story, moment)
        self.log.show_moment(moment, story)
        self._show_status(story, moment)
        self._show_state(story, moment)

    def _show_times(self, story: Story, moment: Moment) -> None:
        self.clock.setText(duration(moment.time))
        pull_off = time_to_pull_off(moment)
        left = time_left(story, moment, self._known)
        soon = f"pull-off in {duration(pull_off)}" if pull_off == pull_off else f"about {duration(left)} left"  # noqa: PLR0124
        self.left.setText("" if moment.ending is not None else soon)
        repeat, repeats = story.info.repeat, story.info.repeats
        if repeats > 1:
            total = left + moment.time
            part = moment.time / total if total > 0 else 1.0
            self.progress.setRange(0, 1000)
            self.progress.setValue(int(1000 * (repeat - 1 + min(1.0, part)) / repeats))
            self.progress.setFormat(f"test {repeat} of {repeats}")

    def _show_status(self, story: Story, moment: Moment) -> None:
        prediction = moment.prediction
        if prediction is not None:
            errors, frame = dict(prediction.numerical_error), f", frame {prediction.frame}"
            self._say_cost(prediction.model, errors, prediction.runtime_s, frame)
        place = "replay" if self._replaying else "live" if self.link is not None else "detached"
        self.status_link.setText(f"{place}: process {story.info.pid}, {story.missed} missed")
        self.status_rate.setText(f"{1 / max(self._refresh_s, 1e-3):.0f} pictures/s")

    def _show_state(self, story: Story, moment: Moment) -> None:
        ending = moment.ending
        fault = next((e for e in reversed(story.events[: moment.events]) if e.kind in ("fault", "interlock")), None)
        if ending is not None:
            done = ending.exit_code == 0
            by_operator = ending.exit_code == 130
            words = "done" if done else "stopped" if by_operator else "failed"
            self._set_state(words, "good" if done else "warning" if by_operator else "fault")
            self._say_fault("" if done else _sentence(ending.reason))
        elif fault is not None:
            self._set_state("fault", "fault")
            self._say_fault(_sentence(fault.text))
        elif self.state.text() in ("stopping", "EMERGENCY STOP") and self.link is not None:
            return
        else:
            self._say_fault("")
            if self._replaying:
                self._set_state("replay" if self.playhead.playing else "replay: paused", "active")
            elif self.link is None:
                self._set_state("link lost", "fault")
            else:
                words = {"": "running", "hold": "holding"}.get(story.waiting(moment), "waiting for you")
                self._set_state(words, "warning" if self.holding else "active")

    def _say_cost(self, model: str, errors: dict[str, float], runtime_s: float, frame: str) -> None:
        units = {"pull_off_force": ("F_p", "N"), "pull_off_distance": ("D_p", "m")}
        shown = [
            f"{units[name][0]} \u00b1 {value:.1e} {units[name][1]}" for name, value in errors.items() if name in units
        ]
        error = f"numerical error {', '.join(shown)}; " if shown else ""
        self.status_model.setText(f"{model} model: {error}{runtime_s * 1e3:.1f} ms{frame}")

    def _ended(self) -> None:
        """The run has hung up. A replay stays; of a repeated run the next test may come."""
        self._detach()
        story = self.story
        if story is None or story.ending is None:
            remedy = "open it again" if self._replaying else "read its output, then `rig recover` the file"
            what = "replay" if self._replaying else "run"
            self._say_fault(f"The {what} has hung up without saying why. Remedy: {remedy}.")
            self._set_state("link lost", "fault")
        self._offer()

    def _offer(self) -> None:
        going = self.link is not None or (self.child is not None and self.child.alive)
        self.controls.setVisible(not self._replaying)
        self.transport.setVisible(self._replaying)
        self.emergency.setEnabled(going and not self._replaying)
        ready = self.checked is not None and self.checked.ready
        self.controls.speed.setVisible(self.checked is None or self.checked.emulated)
        self.controls.enable(ready=ready, running=going, commands=self.link is not None, holding=self.holding)

    def _set_state(self, words: str, tone: str) -> None:
        if self.state.text() != words:
            self.state.setText(words)
        set_tone(self.state, tone)

    def _say_fault(self, text: str) -> None:
        self.banner.setVisible(bool(text))
        if self.banner.text() != text:
            self.banner.setText(text)

    # ------------------------------------------------------------ leaving

    def export(self, plot: Plot, kind: str) -> None:
        """Ask where to, and save a plot."""
        suggestion = f"{plot.y.name}-against-{plot.x.name}.{kind}"
        name, _ = QFileDialog.getSaveFileName(self, "Save plot", suggestion, f"{kind.upper()} (*.{kind})")
        if name:
            self.save_plot(plot, Path(name))

    def save_plot(self, plot: Plot, path: Path) -> None:
        """Save a plot; a failure is said in the banner."""
        try:
            save(plot, path)
        except RigError as error:
            self._say_fault(str(error))
            return
        self.statusBar().showMessage(f"saved {path}", 6000)

    def closeEvent(self, event: QCloseEvent) -> None:
        """Detach. A run goes on; a replay ends with its console."""
        self._timer.stop()
        self._filter.remove()
        for pool in (self._commands, self._emergencies):
            pool.shutdown()  # a stop asked for last is still sent, and the run killed if it does not answer
        self._detach()
        self._end_replay()
        event.accept()


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
