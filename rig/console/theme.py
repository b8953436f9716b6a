"""Colours and sizes: dark and light, told apart by the colour-blind (Okabe and Ito), readable from two metres.

Colour never carries a meaning alone: measured is a solid line, the model a dashed one, a state has its word.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Theme:
    """One set of colours, as ``#rrggbb``."""

    name: str
    window: str
    card: str
    line: str
    text: str
    quiet: str
    faint: str
    measured: str
    model: str
    active: str
    good: str
    warning: str
    fault: str
    on_fault: str


DARK = Theme(
    name="dark",
    window="#0f1318",
    card="#181e26",
    line="#323c4a",
    text="#f2f5f8",
    quiet="#a3b0bf",
    faint="#5c6979",
    measured="#56b4e9",
    model="#f0a830",
    active="#56b4e9",
    good="#2fc397",
    warning="#f0e442",
    fault="#ff6b3d",
    on_fault="#1a0800",
)
LIGHT = Theme(
    name="light",
    window="#eef1f5",
    card="#ffffff",
    line="#c3ccd6",
    text="#10161d",
    quiet="#4d5a68",
    faint="#9aa6b2",
    measured="#0072b2",
    model="#c26a00",
    active="#0072b2",
    good="#00795a",
    warning="#7a6a00",
    fault="#c23b00",
    on_fault="#ffffff",
)
THEMES = {theme.name: theme for theme in (DARK, LIGHT)}

EMERGENCY = "#c8102e"
"""The emergency stop is red in every theme, as on every machine."""


def style_sheet(theme: Theme) -> str:
    """Return the Qt style sheet of the whole window."""
    return f"""
    * {{ font-family: "DejaVu Sans", "Segoe UI", "Helvetica Neue", sans-serif; font-size: 15px; color: {theme.text}; }}
    QMainWindow, QWidget#ground, QDialog {{ background: {theme.window}; }}
    QFrame#card {{ background: {theme.card}; border: 1px solid {theme.line}; border-radius: 8px; }}
    QLabel {{ background: transparent; }}
    QLabel#caption {{ color: {theme.quiet}; font-size: 13px; }}
    QLabel#title {{ font-size: 22px; font-weight: 600; }}
    QLabel#reading {{ font-size: 40px; font-weight: 600; }}
    QLabel#unit {{ color: {theme.quiet}; font-size: 20px; }}
    QLabel#value {{ font-size: 22px; font-weight: 600; }}
    QLabel#step {{ font-size: 24px; font-weight: 600; }}
    QLabel#state {{ font-size: 18px; font-weight: 700; padding: 4px 12px; border-radius: 6px;
                    border: 2px solid {theme.line}; }}
    QLabel#state[tone="active"] {{ border-color: {theme.active}; color: {theme.active}; }}
    QLabel#state[tone="good"] {{ border-color: {theme.good}; color: {theme.good}; }}
    QLabel#state[tone="warning"] {{ border-color: {theme.warning}; color: {theme.warning}; }}
    QLabel#state[tone="fault"] {{ border-color: {theme.fault}; background: {theme.fault}; color: {theme.on_fault}; }}
    QLabel#note[tone="good"] {{ color: {theme.good}; font-weight: 600; }}
    QLabel#note[tone="warning"] {{ color: {theme.warning}; font-weight: 600; }}
    QLabel#note[tone="fault"] {{ color: {theme.fault}; font-weight: 600; }}
    QLabel#banner {{ background: {theme.fault}; color: {theme.on_fault}; font-size: 18px; font-weight: 600;
                     padding: 10px 14px; border-radius: 8px; }}
    QPushButton, QComboBox, QSpinBox, QToolButton {{
        background: {theme.card}; border: 1px solid {theme.line}; border-radius: 6px; padding: 6px 9px; }}
    QPushButton {{ font-size: 16px; font-weight: 600; min-height: 26px; }}
    QToolButton {{ padding: 2px 8px; color: {theme.quiet}; }}
    QPushButton:hover, QComboBox:hover, QToolButton:hover {{ border-color: {theme.active}; }}
    QPushButton:focus, QComboBox:focus, QSpinBox:focus, QToolButton:focus, QPlainTextEdit:focus, QTableView:focus
        {{ border: 2px solid {theme.active}; }}
    QPushButton:disabled, QComboBox:disabled, QSpinBox:disabled {{ color: {theme.faint}; }}
    QPushButton:checked {{ background: {theme.active}; color: {theme.card}; }}
    QPushButton#emergency {{ background: {EMERGENCY}; color: #ffffff; border: 3px solid #ffffff; border-radius: 10px;
        font-size: 22px; font-weight: 800; padding: 8px 22px; }}
    QPushButton#emergency:focus {{ border-color: {theme.warning}; }}
    QPushButton#emergency:disabled {{ background: {theme.card}; color: {theme.quiet}; border-color: {theme.line}; }}
    QComboBox QAbstractItemView {{ background: {theme.card}; selection-background-color: {theme.active}; }}
    QPlainTextEdit {{ background: {theme.card}; border: 1px solid {theme.line}; border-radius: 6px; font-size: 14px; }}
    QStatusBar {{ background: {theme.card}; border-top: 1px solid {theme.line}; }}
    QStatusBar QLabel {{ font-size: 14px; padding: 2px 10px; }}
    QProgressBar {{ background: {theme.window}; border: 1px solid {theme.line}; border-radius: 5px; text-align: center;
        font-size: 13px; min-height: 18px; }}
    QProgressBar::chunk {{ background: {theme.line}; border-radius: 4px; }}
    QSlider::groove:horizontal {{ height: 8px; background: {theme.line}; border-radius: 4px; }}
    QSlider::sub-page:horizontal {{ background: {theme.active}; border-radius: 4px; }}
    QSlider::handle:horizontal {{ background: {theme.text}; width: 18px; margin: -6px 0; border-radius: 9px; }}
    QScrollBar:vertical {{ background: {theme.card}; width: 12px; }}
    QScrollBar::handle:vertical {{ background: {theme.line}; border-radius: 5px; min-height: 24px; }}
    QScrollBar::add-line, QScrollBar::sub-line {{ height: 0px; }}
    QToolButton:checked {{ border-color: {theme.active}; color: {theme.active}; }}
    QToolTip {{ background: {theme.card}; color: {theme.text}; border: 1px solid {theme.line}; }}
    QMenu {{ background: {theme.card}; border: 1px solid {theme.line}; }}
    QMenu::item:selected {{ background: {theme.active}; color: {theme.card}; }}
    """
