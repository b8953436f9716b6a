"""The inputs of the rig's DAQ task: an amplified voltage or a bare bridge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Terminal = Literal["default", "rse", "diff"]

NAMES = ("force", "pressure", "supply")


@dataclass(frozen=True, slots=True)
class VoltageChannel:
    """An amplified signal, recorded in V.

    Attributes
    ----------
    name
        ``"force"``, ``"pressure"`` or ``"supply"``.
    physical
        The input as NI-DAQmx knows it, e.g. ``"Dev1/ai0"``.
    minimum, maximum
        Range asked for, V; the device takes its next wider one.
    terminal
        How the input is wired: referenced single-ended, differential, or the device's default.
    """

    name: str
    physical: str
    minimum: float = -10.0
    maximum: float = 10.0
    terminal: Terminal = "default"

    def __post_init__(self) -> None:
        _check_channel(self)
        if self.terminal not in ("default", "rse", "diff"):
            raise ValueError(f"channel {self.name!r}: terminal {self.terminal!r} is none of default, rse, diff")

    @property
    def unit(self) -> str:
        """Unit of the samples."""
        return "V"

    def add_to(self, task: Any) -> None:
        """Create the DAQmx virtual channel."""
        from nidaqmx.constants import TerminalConfiguration, VoltageUnits

        terminals = {
            "default": TerminalConfiguration.DEFAULT,
            "rse": TerminalConfiguration.RSE,
            "diff": TerminalConfiguration.DIFF,
        }
        task.ai_channels.add_ai_voltage_chan(
            self.physical,
            name_to_assign_to_channel=self.name,
            terminal_config=terminals[self.terminal],
            min_val=self.minimum,
            max_val=self.maximum,
            units=VoltageUnits.VOLTS,
        )


@dataclass(frozen=True, slots=True)
class BridgeChannel:
    """A load cell wired straight to a bridge module (NI 9237), recorded in mV/V.

    DAQmx's two-point force channel is given the identity (0 mV/V is 0, 1 mV/V is 1), so that the raw stream holds
    what the bridge put out and the calibration record alone decides about newtons.

    The module's delta-sigma filter delays the signal by 40 samples (NI 9237 operating instructions): 25 ms at 1.6 kHz,
    or 0.25 um of travel at 10 um/s. The recorded force is not shifted by it.

    Attributes
    ----------
    minimum, maximum
        Range asked for, mV/V.
    excitation
        Internal bridge excitation, V. The NI 9237 delivers 150 mW in all: 5 V is the most for one 350 ohm cell.
    resistance
        Nominal bridge resistance, ohm.
    """

    name: str
    physical: str
    minimum: float = -25.0
    maximum: float = 25.0
    excitation: float = 5.0
    resistance: float = 350.0

    def __post_init__(self) -> None:
        _check_channel(self)
        if not self.excitation > 0 or not self.resistance > 0:
            raise ValueError(f"channel {self.name!r}: excitation (V) and resistance (ohm) must be positive")

    @property
    def unit(self) -> str:
        """Unit of the samples."""
        return "mV/V"

    def add_to(self, task: Any) -> None:
        """Create the DAQmx virtual channel; every argument is given, since DAQmx's defaults are pounds."""
        from nidaqmx.constants import (
            BridgeConfiguration,
            BridgeElectricalUnits,
            BridgePhysicalUnits,
            ExcitationSource,
            ForceUnits,
        )

        task.ai_channels.add_ai_force_bridge_two_point_lin_chan(
            self.physical,
            name_to_assign_to_channel=self.name,
            min_val=self.minimum,
            max_val=self.maximum,
            units=ForceUnits.NEWTONS,
            bridge_config=BridgeConfiguration.FULL_BRIDGE,
            voltage_excit_source=ExcitationSource.INTERNAL,
            voltage_excit_val=self.excitation,
            nominal_bridge_resistance=self.resistance,
            first_electrical_val=0.0,
            second_electrical_val=1.0,
            electrical_units=BridgeElectricalUnits.MILLIVOLTS_PER_VOLT,
            first_physical_val=0.0,
            second_physical_val=1.0,
            physical_units=BridgePhysicalUnits.NEWTONS,
            custom_scale_name="",
        )


Channel = VoltageChannel | BridgeChannel

_HALF_SPANS = {"force": 10.0, "pressure": 5.0, "supply": 10.0}


def signal_channel(name: str, physical: str, terminal: Terminal = "default") -> VoltageChannel:
    """Return a channel in the range its signal needs, V.

    +-5 V holds the HSC's output, and its converter noise is small enough to tell a live sensor from an open wire;
    the supply may be 5.25 V and needs the next range.
    """
    half_span = _HALF_SPANS[name]
    return VoltageChannel(name, physical, -half_span, half_span, terminal)


def _check_channel(channel: Channel) -> None:
    if channel.name not in NAMES:
        raise ValueError(f"channel {channel.name!r} is none of {', '.join(NAMES)}")
    if "/" not in channel.physical:
        raise ValueError(f"channel {channel.name!r}: {channel.physical!r} is not of the form 'Dev1/ai0'")
    if not channel.minimum < channel.maximum:
        raise ValueError(f"channel {channel.name!r}: minimum {channel.minimum} is not below maximum {channel.maximum}")
