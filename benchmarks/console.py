"""Pictures per second with a million points, delay added to the loop, and the way of an emergency stop.

    python benchmarks/console.py [--points 1000000] [--presses 100] [--json FILE]

Offscreen unless QT_QPA_PLATFORM says otherwise. Three figures:

- refresh: the whole console (four plots, pan and zoom over the history) beside one curve refreshed in PyMeasure's way,
  which reads the rows that are new in the file, joins them to the table and gives the whole of it to the plot;
- the loop: time the observers take of each frame, with a console attached that paints, and a prediction beside;
- emergency stop: from the key press, posted at a random moment, to the arrival of the stop byte at the stage's socket,
  with the console painting and the run's process publishing a thousand frames a second.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from io import StringIO
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import numpy as np
import pandas as pd
import pyqtgraph as pg
from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QApplication

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import publisher

from model import Parameters, Substrate
from rig.console.window import Console
from rig.link import Link
from rig.link_address import DIRECTORY_VARIABLE, running
from rig.link_server import LinkServer
from rig.live_run import Beside, Live
from rig.observe import Controls, StepEvent, StepPhase
from rig.wire import samples_of
from sequences.frame import Frame


def quantiles(values: list[float], scale: float = 1e3) -> dict[str, float]:
    return {name: float(np.quantile(values, q) * scale) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}


def refresh(application: QApplication, points: int) -> dict[str, Any]:
    """Console and PyMeasure's way in turns, in one run."""
    window = Console(["sphere-60mm-low"])
    window.resize(1600, 1000)
    window.show()
    window._timer.stop()
    fill(window, points)
    ours = [picture(application, window, turn) for turn in range(60)]
    theirs = [pymeasure_way(application, points) for _ in range(3)]
    ours += [picture(application, window, turn) for turn in range(60)]
    window.close()
    wall, processor = (float(np.median([took[kind] for took in ours])) for kind in (0, 1))
    their_wall, their_processor = (float(np.median([took[kind] for took in theirs])) for kind in (0, 1))
    return {
        "points": points,
        "console_wall_ms": quantiles([took[0] for took in ours]),
        "console_processor_ms": quantiles([took[1] for took in ours]),
        "console_pictures_per_wall_s": 1 / wall,
        "console_pictures_per_processor_s": 1 / processor,
        "pymeasure_way_wall_ms_per_curve": their_wall * 1e3,
        "pymeasure_way_processor_ms_per_curve": their_processor * 1e3,
        "ratio_per_curve_processor": their_processor / (processor / 4),
    }


def fill(window: Console, points: int) -> None:
    window._begin(publisher.info())
    story = window.story
    assert story is not None
    signal = np.random.default_rng(0).normal(0, 2e-3, points) + np.sin(np.arange(points) * 2e-5)
    template = next(told for told in publisher.run() if isinstance(told, Frame))
    story.add(StepEvent(StepPhase.STARTED, "retract", points // 10))
    for start in range(0, points, 10_000):
        stop = min(points, start + 10_000)
        height = 20e-3 + stop * 1e-8
        stage = type(template.stage)(0, 0, height, True, False, True, False, False)
        part = signal[start:stop]
        frame = Frame(start // 10_000, start, 1000.0, template.volts, part, 1e3 * part, stage, template.pump)
        story.add(samples_of([frame]))


def picture(application: QApplication, window: Console, turn: int) -> tuple[float, float]:
    """Wall and processor time of one picture while the history is panned and zoomed."""
    began, began_processor = time.perf_counter(), time.process_time()
    story = window.story
    assert story is not None
    reach = story.end / story.rate
    for plot in (window.force_time, window.pressure_time):
        plot._unfollow()
        left = reach * 0.4 * (1 + np.sin(turn / 7)) / 2
        plot.item.setXRange(left, left + reach * (0.1 + 0.5 * (turn % 10) / 10), padding=0)
    window.refresh()
    application.processEvents()
    return time.perf_counter() - began, time.process_time() - began_processor


_theirs: dict[str, Any] = {}


def pymeasure_way(application: QApplication, points: int) -> tuple[float, float]:
    if not _theirs:
        plot = pg.PlotWidget()
        plot.resize(800, 450)
        plot.show()
        values = np.random.default_rng(0).normal(size=points)
        table = pd.DataFrame({"t": np.arange(points) / 1e3, "F": values})
        _theirs.update(plot=plot, curve=plot.plot(pen=pg.mkPen("c", width=2)), table=table)
    rows = "".join(f"{points + row},{row * 0.01}\n" for row in range(100))
    began, began_processor = time.perf_counter(), time.process_time()
    fresh = pd.read_csv(StringIO(rows), names=["t", "F"])
    _theirs["table"] = pd.concat([_theirs["table"], fresh], ignore_index=True)
    _theirs["curve"].setData(_theirs["table"]["t"].to_numpy(), _theirs["table"]["F"].to_numpy())
    _theirs["plot"].repaint()
    application.processEvents()
    return time.perf_counter() - began, time.process_time() - began_processor


def loop_delay(frames: int = 1500) -> dict[str, Any]:
    """Time that link and live prediction take of each frame on the loop's own thread, at 200 frames a second."""
    controls = Controls()
    with LinkServer(controls) as server:
        server.started(publisher.info())
        link = Link(server.address)
        live = Live(
            Beside(Parameters(Substrate("sphere", 60e-3)), 0.0), lambda prediction, _: server.prediction(prediction)
        )
        took: list[float] = []
        worked: list[float] = []
        for told in publisher.run():
            if isinstance(told, StepEvent):
                server.step(told)
                live.step(told)
            if not isinstance(told, Frame):
                continue
            began, began_thread = time.perf_counter(), time.thread_time()
            server.frame(told)
            live.frame(told)
            took.append(time.perf_counter() - began)
            worked.append(time.thread_time() - began_thread)
            time.sleep(0.005)
            list(link.take())
            if len(took) == frames:
                break
        live.finished(publisher_ending())
        link.close()
    return {"frames": len(took), "added_wall_ms": quantiles(took), "added_processor_ms": quantiles(worked)}


def publisher_ending() -> Any:
    from rig.observe import Ending

    return Ending("done", 0, 0)


SERVE = """
import socket, sys, time
sys.path.insert(0, sys.argv[2])
import publisher
from rig.link_server import LinkServer
from rig.observe import Controls
from sequences.frame import Frame
stage = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
stage.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
controls = Controls()
controls.connect(lambda: stage.send(b"\\x18"))
frames = [told for told in publisher.run() if isinstance(told, Frame)]
with LinkServer(controls) as server:
    server.started(publisher.info())
    number = 0
    while True:
        for frame in frames[:500]:
            signals = frame.volts, frame.force, frame.pressure
            server.frame(Frame(number, number * 20, 1000.0, *signals, frame.stage, frame.pump))
            number += 1
            time.sleep(0.001)
"""


def emergency(application: QApplication, presses: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        os.environ[DIRECTORY_VARIABLE] = f"{folder}/runtime"
        with socket.create_server(("127.0.0.1", 0)) as stage:
            port = str(stage.getsockname()[1])
            run = subprocess.Popen([sys.executable, "-c", SERVE, port, str(Path(publisher.__file__).parent)])
            wire, _ = stage.accept()
            while not running():
                time.sleep(0.02)
            took = press_all(application, wire, presses)
            run.kill()
            run.wait()
            wire.close()
    return {"presses": len(took), "key_to_byte_ms": quantiles(took)}


def press_all(application: QApplication, wire: socket.socket, presses: int) -> list[float]:
    window = Console(["sphere-60mm-low"])
    window.resize(1600, 1000)
    window.show()
    window.attach_newest()
    took: list[float] = []
    over = threading.Event()

    def press() -> None:
        dice = random.Random(0)
        time.sleep(2.0)
        for _ in range(presses):
            time.sleep(dice.uniform(0.03, 0.12))
            event = QKeyEvent(QEvent.Type.KeyPress, Qt.Key.Key_Escape, Qt.KeyboardModifier.NoModifier)
            began = time.perf_counter()
            application.postEvent(window, event)
            assert wire.recv(1) == b"\x18"
            took.append(time.perf_counter() - began)
        over.set()

    threading.Thread(target=press, daemon=True).start()
    while not over.is_set():
        application.processEvents()
        time.sleep(0.001)
    window.close()
    return took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--presses", type=int, default=100)
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    application = QApplication([])
    result = {
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "cores": os.cpu_count(),
        "refresh": refresh(application, told.points),
        "loop": loop_delay(),
        "emergency_stop": emergency(application, told.presses),
    }
    text = json.dumps(result, indent=1)
    print(text)
    if told.json is not None:
        told.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
