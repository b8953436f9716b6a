"""The plots: a signal against time, and against the retraction with the model's curve and band over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QFont
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QMenu, QToolButton, QVBoxLayout, QWidget

from rig.console.pyramid import Pyramid, polyline
from rig.console.story import Moment, Story
from rig.console.theme import Theme
from rig.live_prediction import LivePrediction

Array = NDArray[np.float64]

BLOCKS = 250
"""Least number of blocks in a plot; up to four times as many are drawn, about one to a pixel."""
WINDOW_S = 20.0
_EMPTY: Array = np.empty(0)


@dataclass(frozen=True, slots=True)
class Quantity:
    """What an axis shows: name and symbol in words and rich text, unit, and shown units per SI unit."""

    name: str
    symbol: str
    unit: str
    scale: float
    column: str


FORCE = Quantity("force", "F<sub>r</sub>", "N", 1.0, "force_N")
PRESSURE = Quantity("pressure", "P<sub>a</sub>", "kPa", 1e-3, "pressure_Pa")
TIME = Quantity("time", "t", "s", 1.0, "time_s")
RETRACTION = Quantity("retraction", "z<sub>r</sub>", "mm", 1e3, "retraction_m")


class Plot:
    """A card with one plot: title, follow and export buttons, units on both axes."""

    def __init__(self, x: Quantity, y: Quantity, export: Callable[[Plot, str], None]) -> None:
        self.x, self.y = x, y
        self.widget = QFrame()
        self.widget.setObjectName("card")
        self.widget.setAccessibleName(f"{y.name} against {x.name}")
        self.view: Any = pg.PlotWidget()
        self.item: Any = self.view.getPlotItem()
        self.item.hideButtons()
        self.item.setMenuEnabled(False)
        self.item.disableAutoRange()
        self._grid: Any = pg.PlotCurveItem(connect="pairs", skipFiniteCheck=True)
        self._grid.setZValue(-20)
        self.item.addItem(self._grid, ignoreBounds=True)
        self.item.getViewBox().sigRangeChanged.connect(lambda *_: self._rule())
        self.following = True
        self.item.getViewBox().sigRangeChangedManually.connect(self._unfollow)
        self.item.getViewBox().sigXRangeChanged.connect(lambda *_: self._zoomed())
        self.title = QLabel(f"{y.symbol} against {x.symbol}")
        self.title.setTextFormat(Qt.TextFormat.RichText)
        self.follow = self._button("follow", "Show the newest data again (F)", self.refollow)
        self.follow.setVisible(False)
        self.export = self._button("export", "Save this plot as PNG, SVG or CSV", None)
        self.export.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        menu = QMenu(self.export)
        for kind in ("PNG", "SVG", "CSV"):
            menu.addAction(kind, lambda kind=kind: export(self, kind.lower()))
        self.export.setMenu(menu)
        self._lay_out()
        self.measured: Any = pg.PlotCurveItem(connect="finite", skipFiniteCheck=True)
        self.item.addItem(self.measured)
        self._shown: tuple[Story, Moment] | None = None
        self._y_range = (0.0, 0.0)

    def _lay_out(self) -> None:
        self.bar = QHBoxLayout()
        self.bar.addWidget(self.title)
        self.bar.addStretch(1)
        self.bar.addWidget(self.follow)
        self.bar.addWidget(self.export)
        column = QVBoxLayout(self.widget)
        column.setContentsMargins(10, 4, 6, 2)
        column.setSpacing(0)
        column.addLayout(self.bar)
        column.addWidget(self.view, 1)

    def _button(self, text: str, tip: str, action: Callable[[], None] | None) -> QToolButton:
        button = QToolButton()
        button.setText(text)
        button.setToolTip(tip)
        button.setAccessibleName(f"{text} {self.y.name} against {self.x.name}")
        if action is not None:
            button.clicked.connect(action)
        return button

    def paint(self, theme: Theme) -> None:
        """Take on a theme."""
        self.view.setBackground(theme.card)
        font = QFont()
        font.setPixelSize(15)
        for side, quantity in (("bottom", self.x), ("left", self.y)):
            axis = self.item.getAxis(side)
            axis.setPen(theme.line)
            axis.setTextPen(theme.text)
            axis.setTickFont(font)
            axis.enableAutoSIPrefix(False)
            axis.setStyle(maxTickLevel=0)
            axis.setLabel(f"{quantity.symbol} ({quantity.unit})", **{"font-size": "16px", "color": theme.text})
        self.item.getAxis("left").setWidth(72)
        self.measured.setPen(pg.mkPen(theme.measured, width=2))
        self._grid.setPen(pg.mkPen(theme.line, width=1))

    def _rule(self) -> None:
        """Draw the grid as one item: the axes' own is the dearest part of a picture."""
        (left, right), (bottom, top) = self.item.getViewBox().viewRange()
        size = self.item.getViewBox().size()
        xs = self.item.getAxis("bottom").tickValues(left, right, size.width())[0][1]
        ys = self.item.getAxis("left").tickValues(bottom, top, size.height())[0][1]
        x = [*np.repeat(xs, 2), *([left, right] * len(ys))]
        y = [*([bottom, top] * len(xs)), *np.repeat(ys, 2)]
        self._grid.setData(np.array(x, np.float64), np.array(y, np.float64))

    def refollow(self) -> None:
        """Show the newest data again."""
        self.following = True
        self.follow.setVisible(False)
        self._redraw()

    def clear(self) -> None:
        """Forget the run."""
        self._shown = None
        self.measured.setData(_EMPTY, _EMPTY)

    def show(self, story: Story, moment: Moment) -> None:
        """Draw what is seen at this moment."""
        self._shown = (story, moment)
        self._redraw()

    def _unfollow(self, *_: object) -> None:
        self.following = False
        self.follow.setVisible(True)

    def _zoomed(self) -> None:
        if not self.following:
            self._redraw()

    def _redraw(self) -> None:
        raise NotImplementedError

    def table(self) -> list[tuple[str, Array, Array, Array | None, Array | None]]:
        """Return every series in view at full resolution, SI: name, x, y, low, high."""
        raise NotImplementedError

    def _range(self) -> tuple[float, float]:
        low, high = self.item.getViewBox().viewRange()[0]
        return low / self.x.scale, high / self.x.scale

    def _set_x(self, low: float, high: float) -> None:
        """Set the horizontal range if it has changed: drawing an axis anew is the dearest part of a picture."""
        shown = self.item.getViewBox().viewRange()[0]
        if abs(shown[0] - low) + abs(shown[1] - high) > 2e-3 * (high - low):
            self.item.setXRange(low, high, padding=0)

    def _fit_y(self, *series: Array) -> None:
        """Fit the vertical range to what is drawn; let it breathe only when something leaves it or a lot is empty."""
        joined = np.concatenate([part[np.isfinite(part)] for part in series]) if series else _EMPTY
        if not joined.size:
            return
        low, high = float(joined.min()), float(joined.max())
        least = 0.02 if self.y is FORCE else 0.2
        if high - low < least:
            low, high = (low + high - least) / 2, (low + high + least) / 2
        margin = 0.08 * (high - low)
        shown_low, shown_high = self._y_range
        tight = shown_high - shown_low > 1.6 * (high - low + 2 * margin)
        if low < shown_low or high > shown_high or tight:
            self._y_range = (low - margin, high + margin)
            self.item.setYRange(*self._y_range, padding=0)


class TimePlot(Plot):
    """A signal against time: the whole run, or the last seconds of it."""

    def __init__(self, y: Quantity, export: Callable[[Plot, str], None]) -> None:
        super().__init__(TIME, y, export)
        self.window = self._button(f"last {WINDOW_S:g} s", "Show the last seconds only", self._redraw)
        self.window.setCheckable(True)
        self.bar.insertWidget(2, self.window)
        self._marks: list[Any] = []
        self._marked: list[tuple[float, str]] = []
        self._theme: Theme | None = None

    def paint(self, theme: Theme) -> None:
        """Take on a theme."""
        super().paint(theme)
        self._theme = theme
        for mark in self._marks:
            self._colour(mark)

    def clear(self) -> None:
        """Forget the run."""
        super().clear()
        self._mark([])

    def _signal(self, story: Story) -> Pyramid:
        signal = story.force if self.y is FORCE else story.pressure
        return story.force if signal is None else signal

    def _offset(self, moment: Moment) -> float:
        return moment.force_zero if self.y is FORCE else 0.0

    def _redraw(self) -> None:
        if self._shown is None:
            return
        story, moment = self._shown
        if self.following:
            self._set_x(*self._followed(moment.time))
        start, stop = self._stretch(story, moment)
        index, least, greatest = self._signal(story).view(start, stop, BLOCKS)
        x, y = polyline((index + 1) / story.rate, least, greatest)
        y = (y - self._offset(moment)) * self.y.scale
        self.measured.setData(x, y)
        self._fit_y(y)
        self._mark([(sample / story.rate, name) for sample, name in story.boundaries(moment)])

    def _followed(self, time: float) -> tuple[float, float]:
        """Whole run: the axis grows by a quarter at a time, so that it need not be drawn anew with every picture."""
        if self.window.isChecked():
            end = max(WINDOW_S, np.ceil(time))
            return end - WINDOW_S, end
        end = 10.0
        while end < time:
            end *= 1.25
        return 0.0, end

    def _stretch(self, story: Story, moment: Moment) -> tuple[int, int]:
        low, high = self._range()
        return max(0, int(low * story.rate)), max(0, min(moment.sample, int(high * story.rate) + 2))

    def _mark(self, boundaries: list[tuple[float, str]]) -> None:
        low, high = self.item.getViewBox().viewRange()[0]
        near = 0.03 * (high - low)
        later = [*(time for time, _ in boundaries[1:]), np.inf][: len(boundaries)]
        boundaries = [
            (time, "" if after - time < near else name) for (time, name), after in zip(boundaries, later, strict=True)
        ]
        if boundaries == self._marked:
            return
        self._marked = boundaries
        while len(self._marks) > len(boundaries):
            self.item.removeItem(self._marks.pop())
        for place, (time, name) in enumerate(boundaries):
            if place == len(self._marks):
                options = {"position": 0.97, "rotateAxis": (1, 0), "anchors": [(1, 0), (1, 0)], "fill": None}
                mark = pg.InfiniteLine(time, label=name, labelOpts=options)
                self._colour(mark)
                self.item.addItem(mark, ignoreBounds=True)
                self._marks.append(mark)
            else:
                self._marks[place].setValue(time)
                self._marks[place].label.setFormat(name)

    def _colour(self, mark: Any) -> None:
        if self._theme is not None:
            mark.setPen(pg.mkPen(self._theme.quiet, width=1, style=Qt.PenStyle.DotLine))
            mark.label.setColor(self._theme.quiet)

    def table(self) -> list[tuple[str, Array, Array, Array | None, Array | None]]:
        """See ``Plot``."""
        if self._shown is None:
            return []
        story, moment = self._shown
        start, stop = self._stretch(story, moment)
        signal = self._signal(story).values[start:stop] - self._offset(moment)
        return [("measured", np.arange(start + 1, start + 1 + signal.size) / story.rate, signal, None, None)]


class RetractionPlot(Plot):
    """A signal against z_r, with the model's curve, its band and where it says pull-off will be."""

    def __init__(self, y: Quantity, export: Callable[[Plot, str], None]) -> None:
        super().__init__(RETRACTION, y, export)
        self.model: Any = pg.PlotCurveItem(connect="finite")
        self._low: Any = pg.PlotCurveItem(connect="finite")
        self._high: Any = pg.PlotCurveItem(connect="finite")
        self.band: Any = pg.FillBetweenItem(self._low, self._high)
        self.announced: Any = pg.PlotCurveItem(connect="finite")
        self.point: Any = pg.ScatterPlotItem(symbol="d", size=15)
        self.bars: Any = pg.ErrorBarItem(x=_EMPTY, y=_EMPTY, beam=0.0)
        self.legend = QLabel()
        self.legend.setTextFormat(Qt.TextFormat.RichText)
        self.bar.insertWidget(1, self.legend)
        self.bar.insertSpacing(1, 18)
        layers = (
            (-4, self.announced),
            (-3, self.band),
            (-2, self._low),
            (-2, self._high),
            (-1, self.model),
            (1, self.bars),
        )
        for depth, item in layers:
            item.setZValue(depth)
            self.item.addItem(item)
        self.point.setZValue(2)
        self.item.addItem(self.point)
        self._expected: tuple[Array, Array] | None = None
        self._drawn: LivePrediction | None = None
        self.item.setXRange(-0.2, 2.0, padding=0)

    def paint(self, theme: Theme) -> None:
        """Take on a theme."""
        super().paint(theme)
        colour = QColor(theme.model)
        self.model.setPen(pg.mkPen(colour, width=2.5, style=Qt.PenStyle.DashLine))
        self.announced.setPen(pg.mkPen(colour, width=1.5, style=Qt.PenStyle.DotLine))
        self.point.setBrush(colour)
        self.point.setPen(pg.mkPen(theme.card, width=1))
        self.bars.setData(pen=pg.mkPen(colour, width=2))
        for edge in (self._low, self._high):
            colour.setAlpha(110)
            edge.setPen(pg.mkPen(colour, width=1))
        colour.setAlpha(55)
        self.band.setBrush(colour)
        self.legend.setText(
            f"<span style='color:{theme.measured}'>\u2501\u2501 measured</span>&nbsp;&nbsp; "
            f"<span style='color:{theme.model}'>\u2578\u2578 model, 90 % band</span>&nbsp;&nbsp; "
            f"<span style='color:{theme.model}'>\u00b7\u00b7\u00b7 at P<sub>0</sub></span>"
        )

    def expect(self, retraction: Array, values: Array) -> None:
        """Show what the model says of the chosen scene before anything has been measured."""
        self._expected = (retraction, values)
        if self._shown is None:
            self.clear()

    def clear(self) -> None:
        """Forget the run; what the model expects of the chosen scene stays."""
        super().clear()
        self._forget_model()
        if self._expected is not None:
            x, y = self._expected[0] * self.x.scale, self._expected[1] * self.y.scale
            self.model.setData(x, y)
            self.item.setXRange(float(x.min()), float(x.max()) * 1.08, padding=0)
            self._fit_y(y)

    def _forget_model(self) -> None:
        self._drawn = None
        for item in (self.model, self._low, self._high, self.announced):
            item.setData(_EMPTY, _EMPTY)
        self.point.setData(_EMPTY, _EMPTY)
        self.bars.setData(x=_EMPTY, y=_EMPTY)

    def _redraw(self) -> None:
        if self._shown is None:
            return
        story, moment = self._shown
        if moment.prediction is not self._drawn:
            self._draw_model(moment.prediction)
        x, y = self._path(story, moment)
        self.measured.setData(x, y)
        if self.following:
            self._follow(x, y)

    def _path(self, story: Story, moment: Moment) -> tuple[Array, Array]:
        start, stop = self._stretch(story, moment)
        signal = story.force if self.y is FORCE else story.pressure
        if signal is None or stop <= start:
            return _EMPTY, _EMPTY
        index, least, greatest = signal.view(start, stop, BLOCKS)
        place = np.minimum(index.astype(np.intp), len(story.height) - 1)
        height = story.height.values[place] - moment.zero_height
        x, y = polyline(height, least, greatest)
        offset = moment.force_zero if self.y is FORCE else 0.0
        return x * self.x.scale, (y - offset) * self.y.scale

    def _stretch(self, story: Story, moment: Moment) -> tuple[int, int]:
        """Return the samples of the retraction that are in view; on the way up the height rises with the sample."""
        start, stop = story.retraction(moment)
        if self.following or stop <= start:
            return start, stop
        low, high = self._range()
        begin = _first_above(story.height.values, start, stop, low + moment.zero_height)
        return max(start, begin - 1), _first_above(story.height.values, begin, stop, high + moment.zero_height) + 1

    def _follow(self, x: Array, y: Array) -> None:
        curve = self._drawn
        if curve is None:
            if x.size:
                self._set_x(float(np.nanmin(x)), 0.25 * np.ceil(4 * float(np.nanmax(x)) + 0.4))
                self._fit_y(y)
            return
        first = self._shown[0].predictions[0] if self._shown is not None else curve
        reach = max(curve.pull_off_distance.high, first.pull_off_distance.high) * self.x.scale
        low, high = min(-0.1 * reach, float(curve.retraction[0]) * self.x.scale), 0.1 * np.ceil(10.3 * reach)
        self._set_x(low, high)
        model = (*self._series(curve), self._series(first)[0])
        inside = y[(x > low) & (x < high)]
        self._fit_y(inside, *(part * self.y.scale for part in model if part is not None))

    def _series(self, prediction: LivePrediction) -> tuple[Array | None, Array | None, Array | None]:
        if self.y is FORCE:
            return prediction.force, prediction.force_low, prediction.force_high
        ends = prediction.retraction > prediction.pull_off_distance.value  # what comes after pull-off is no model's
        return tuple(
            None if part is None else np.where(ends, np.nan, part)
            for part in (prediction.pressure, prediction.pressure_low, prediction.pressure_high)
        )  # type: ignore[return-value]  # three in, three out

    def _draw_model(self, prediction: LivePrediction | None) -> None:
        self._forget_model()
        self._drawn = prediction
        if prediction is None:
            return
        middle, low, high = self._series(prediction)
        x = prediction.retraction * self.x.scale
        if middle is not None:
            self.model.setData(x, middle * self.y.scale)
        if low is not None and high is not None:
            known = np.isfinite(low)
            self._low.setData(x[known], low[known] * self.y.scale)
            self._high.setData(x[known], high[known] * self.y.scale)
        if self.y is FORCE and middle is not None:
            self._draw_pull_off(prediction)
        if self._shown is not None and self._shown[0].predictions[0] is not prediction:
            first = self._shown[0].predictions[0]
            values = self._series(first)[0]
            if values is not None:
                shift = first.zero_height - prediction.zero_height
                self.announced.setData((first.retraction + shift) * self.x.scale, values * self.y.scale)

    def _draw_pull_off(self, prediction: LivePrediction) -> None:
        """A cross at (D_p, -F_p): its arms are the 90 % intervals."""
        distance, force = prediction.pull_off_distance, prediction.pull_off_force
        x, y = np.array([distance.value * self.x.scale]), np.array([-force.value])
        self.point.setData(x, y)
        self.bars.setData(
            x=x,
            y=y,
            left=x - distance.low * self.x.scale,
            right=distance.high * self.x.scale - x,
            top=np.array([force.value - force.low]),
            bottom=np.array([force.high - force.value]),
        )

    def table(self) -> list[tuple[str, Array, Array, Array | None, Array | None]]:
        """See ``Plot``."""
        series: list[tuple[str, Array, Array, Array | None, Array | None]] = []
        if self._shown is None:
            return series
        story, moment = self._shown
        start, stop = self._stretch(story, moment)
        signal = story.force if self.y is FORCE else story.pressure
        if signal is not None and stop > start:
            offset = moment.force_zero if self.y is FORCE else 0.0
            height = story.height.values[start:stop] - moment.zero_height
            series.append(("measured", height, signal.values[start:stop] - offset, None, None))
        if moment.prediction is not None:
            middle, low, high = self._series(moment.prediction)
            if middle is not None:
                series.append((f"model {moment.prediction.model}", moment.prediction.retraction, middle, low, high))
        return series


def _first_above(values: Array, start: int, stop: int, level: float) -> int:
    """Return the first index in a rising stretch whose value reaches ``level``."""
    return start + int(np.searchsorted(values[start:stop], level))


def grid(*rows: list[Plot]) -> QWidget:
    """Lay plots out in rows."""
    widget = QWidget()
    column = QVBoxLayout(widget)
    column.setContentsMargins(0, 0, 0, 0)
    column.setSpacing(8)
    for plots in rows:
        row = QHBoxLayout()
        row.setSpacing(8)
        for plot in plots:
            row.addWidget(plot.widget, 1)
        column.addLayout(row, 1)
    return widget
