"""From the zero of force to detachment: z_r, F_p, D_p, jumps, snap, energies, pressure."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from analysis.derived import area_of, full_contact_area, full_contact_radius
from analysis.errors import FeatureMissing
from analysis.extraction import CONTACT_TESTS, SMOOTHING, Details, Extraction, extraction_step
from analysis.numerics import RECTANGULAR, Array, ForceJump, LocalFit, find_jumps, fit_around, fit_window, running_mean
from analysis.preparation import require_adhesion

RUN_AWAY = 0.1
"""Before detachment the pressure falls faster than its sensor tells, s."""

SETTLING = 0.5
"""After it the membrane comes to rest, s."""


@extraction_step(
    "zero crossing",
    title="Zero of force and of z_r",
    protocols=CONTACT_TESTS,
    after=("compliance",),
    gives={
        "zero_force_height_m": "separation where F_r passes from compression to tension: z_r = 0",
        "stiffness_at_zero_N_m": "-dF_r/dz there",
    },
)
def zero_crossing(work: Extraction) -> Details:
    """Find the last crossing from compression to tension before the largest tension.

    1. A running mean of 20 ms brackets the crossing.
    2. A cubic is fitted around it, up to a tenth of the retraction either way, in the widest window whose residuals
       are noise; its root is the zero.
    3. Force that is tensile from the start (suction on a flat) has its zero of z_r at the start of the retraction.
    """
    require_adhesion(work)
    start, stop = work.retraction()
    width = work.samples(SMOOTHING)
    smooth = running_mean(work.force[start:stop], width)
    lowest = int(np.argmin(smooth))
    compressed = np.flatnonzero(smooth[: lowest + 1] > 0)
    if compressed.size == 0 or float(smooth[: width + 1].max()) < 2 * work.noise.of_mean(width):
        work.zero = float(start)
        decision = "tensile from the start: z_r = 0 at the start of the retraction"
        slope = np.nan
        work.missing["stiffness_at_zero_N_m"] = "the force does not cross zero"
    else:
        index = start + int(compressed[-1])
        reach = max(16, (stop - start) // 10)
        fit = fit_around(work.force, index, max(start, index - reach), min(start + lowest, index + reach), work.noise)
        root = fit.root(index)
        work.zero = float(index) if root is None else root
        climb = _slope(work.separation, index, reach)
        slope = -fit.slope(work.zero) / climb if climb > 0 else np.nan
        decision = f"root of a cubic over {(fit.stop - fit.start) / work.run.rate:.2g} s"
        work.set(stiffness_at_zero_N_m=slope)
    work.zero_separation = work.at(work.run.height, work.zero) + work.run.sensors.compliance * _force_at_zero(
        work, start
    )
    work.set(zero_force_height_m=work.zero_separation)
    return {"decision": decision, "index": work.zero}


def _force_at_zero(work: Extraction, start: int) -> float:
    """Zero by definition, unless the force is tensile from the start."""
    if work.zero > start:
        return 0.0
    width = work.samples(SMOOTHING)
    return float(work.force[start : start + width].mean())


def _slope(signal: Array, index: int, reach: int) -> float:
    left, right = max(0, index - reach), min(signal.size, index + reach)
    return float((signal[right - 1] - signal[left]) / (right - 1 - left))


@extraction_step(
    "jumps",
    title="Jumps",
    protocols=CONTACT_TESTS,
    after=("zero crossing",),
    gives={
        "jumps_count": "sudden changes of force in the retraction, detachment included",
        "largest_jump_N": "change of force in the largest of them",
    },
)
def jumps(work: Extraction) -> Details:
    """Find where means over 20 ms before and after differ by six standard deviations and one per cent of the tension.

    A line fitted on either side of each candidate must confirm it, so that steep but smooth stretches do not count.
    """
    start, stop = work.retraction()
    width = work.samples(SMOOTHING, least=4)
    tension = -float(running_mean(work.force[start:stop], width).min())
    reach = min(work.windows.end, stop + 8 * width)
    found = find_jumps(work.force[start:reach], work.noise, width, 0.01 * tension)
    work.jumps = [replace(jump, start=jump.start + start, stop=jump.stop + start) for jump in found]
    work.set(jumps_count=float(len(work.jumps)))
    if work.jumps:
        work.set(largest_jump_N=max((jump.size for jump in work.jumps), key=abs))
    else:
        work.missing["largest_jump_N"] = "the force changes without a jump"
    return {"decision": f"{len(work.jumps)} found", "jumps": tuple(work.jumps)}


@extraction_step(
    "detachment",
    title="Detachment and D_p",
    protocols=CONTACT_TESTS,
    after=("jumps",),
    gives={
        "pull_off_distance_m": "D_p: separation at the last contact minus that at the zero of force",
        "snap_force_N": "tension just before the final jump",
        "snap_duration_s": "duration of the final jump",
    },
)
def detachment(work: Extraction) -> Details:
    """Detachment is the last jump that leaves less than a quarter of the tension to what is left in the end.

    1. The contact is lost after the last sample of the jump that still stands out of the force after it.
    2. The separation is the stage's height half a sample later, less the load train's stretch, compliance times force:
       the train springs back only when the contact is lost. Contacts run away before that: within the sample that is
       not seen the force is taken to fall by twice as much as in the one before, and by that much uncertain. A JKR
       contact loses its force with its area: none is left.
    3. Without such a jump, or where tension is left after it: where that falls below four standard deviations of a
       20 ms mean and of the creep put back. The mean comes late by half its width, and below that limit the tension
       may go on: by as far again as it took to fall there from the limit of a single sample, if it fades no slower
       than the square of the distance left. Both are half-widths of rectangular distributions.
    """
    if work.detached is None:
        raise FeatureMissing("still attached at the end of the recording")
    tail = float(np.median(work.force[work.detached + (work.windows.end - work.detached) // 2 :]))
    releases = [j for j in work.jumps if j.size > 0 and tail - j.after < 0.25 * (tail - j.before)]
    if releases:
        jump = releases[-1]
        last = _last_tense(work, jump)
        fade = _fade(work, last + work.samples(SMOOTHING, least=4) // 2 + 1)
        work.set(snap_force_N=-jump.before, snap_duration_s=(jump.stop - jump.start) / work.run.rate)
        decision = f"jump of {jump.size * 1e3:.1f} mN within {(jump.stop - jump.start) / work.run.rate * 1e3:.3g} ms"
    else:
        last, fade = work.detached, _fade(work, work.detached)
        work.missing.update(dict.fromkeys(("snap_force_N", "snap_duration_s"), "the tension fades without a jump"))
        decision = ""
    if releases and fade is None:
        work.release = last + 0.5
        held, uncertain = _held(work, last)
        work.release_uncertainty = work.run.sensors.compliance * uncertain
    else:
        faint, end = fade or (last, last)
        held, work.release = float(work.force[end]), float(end)
        unseen = end - faint, work.samples(SMOOTHING) / 2
        work.release_uncertainty = math.hypot(*unseen) * _slope(work.run.height, end, work.samples(0.1)) / RECTANGULAR
        decision += (", then " if decision else "") + "the tension fades into the noise"
    work.release_separation = work.at(work.run.height, work.release) + work.run.sensors.compliance * held
    work.set(pull_off_distance_m=work.release_separation - work.zero_separation)
    return {"decision": decision, "index": work.release}


def _fade(work: Extraction, begin: int) -> tuple[int, int] | None:
    """Return where 20 ms means no longer reach what single samples, and what means show; ``None``: no tension is left.

    Noise does not end a fade before it has made a mean positive.
    """
    width = work.samples(SMOOTHING, least=4)
    single, mean = work.noise.sigma, work.noise.of_mean(width)
    creep = 0.0 if work.creep is None else work.creep.uncertainty * work.creep.response[begin:]
    limit = -4 * np.hypot(mean, creep)
    smooth = running_mean(work.force, width)[begin:]
    gone = np.flatnonzero(smooth > 0)
    tense = np.flatnonzero((smooth < limit)[: int(gone[0]) if gone.size else None])
    if tense.size == 0 or tense[0] > 0:
        return None
    faint = np.flatnonzero((smooth > limit * max(single / mean, 1.0))[: int(tense[-1])])
    return begin + int(faint[0] if faint.size else tense[-1]), begin + int(tense[-1])


def _held(work: Extraction, last: int) -> tuple[float, float]:
    """Return the force at the end of the contact, after the last sample in tension, and its standard uncertainty, N."""
    if work.run.protocol == "indentation":
        return 0.0, 0.0
    seen, fall = float(work.force[last]), float(work.force[last] - work.force[last - 1])
    left = min(seen + 2 * fall, 0.0)
    return left, abs(left - seen) / RECTANGULAR


def _last_tense(work: Extraction, jump: ForceJump) -> int:
    """Return the last sample that noise, and three per cent of the jump, do not explain as being after it."""
    first = jump.stop - 1
    lacking = jump.after - work.force[first : 2 * jump.stop - jump.start + 2]
    tense = np.flatnonzero(lacking > max(4 * work.noise.sigma, 0.03 * jump.size))
    return first + (int(tense[-1]) if tense.size else 0)


@extraction_step(
    "pull-off",
    title="Pull-off force",
    protocols=CONTACT_TESTS,
    after=("jumps",),
    gives={
        "pull_off_force_N": "F_p: largest tension, a magnitude",
        "retraction_at_pull_off_m": "z_r at F_p",
        "sampling_bias_N": "how much of the peak the finite sample rate misses",
    },
)
def pull_off(work: Extraction) -> Details:
    """Fit a cubic around the largest tension, in the widest window whose residuals are noise, but never across a jump.

    Where the peak lies at a jump, the force was still growing when the contact let go: on average half a sample's
    growth is missed. A smooth peak misses curvature dt^2 / 24.
    """
    start, stop = work.retraction()
    left, right = max(start, int(np.floor(work.zero))), min(stop, work.windows.end)
    width = work.samples(0.005)
    index = left + int(np.argmin(running_mean(work.force[left:right], width)))
    index, left, right = _side_of_jump(work, index, left, right)
    fit = fit_around(work.force, index, left, right, work.noise)
    work.peak, value = fit.minimum()
    at_jump = any(abs(work.peak - jump.start) <= 1 for jump in work.jumps)
    bias = abs(fit.slope(work.peak)) / 2 if at_jump else abs(fit.curvature(work.peak)) / 24
    separation = work.at(work.run.height, work.peak) + work.run.sensors.compliance * value
    work.peak_shift = _peak_shift(work, fit)
    work.set(
        pull_off_force_N=-value,
        retraction_at_pull_off_m=separation - work.zero_separation,
        sampling_bias_N=bias,
    )
    where = "at a jump" if at_jump else "smooth"
    return {
        "decision": f"{where} peak of a cubic over {(fit.stop - fit.start) / work.run.rate:.2g} s",
        "index": work.peak,
        "fit": fit,
    }


def _peak_shift(work: Extraction, fit: LocalFit) -> float:
    """How far the peak moves, samples, when only half the window is fitted: what the cubic cannot follow."""
    half = max(8, (fit.stop - fit.start) // 4)
    start, stop = max(fit.start, int(work.peak) - half), min(fit.stop, int(work.peak) + half + 1)
    narrow, _, _ = fit_window(work.force, start, stop, 3)
    return narrow.minimum()[0] - work.peak


def _side_of_jump(work: Extraction, index: int, left: int, right: int) -> tuple[int, int, int]:
    """Keep the window between two jumps. A peak within a jump belongs to the side of larger tension."""
    for jump in work.jumps:
        if jump.start <= index <= jump.stop or (abs(index - jump.middle) < 0.01 * work.run.rate):
            index = jump.start if jump.before < jump.after else jump.stop
        if jump.start >= index:
            right = min(right, jump.start + 1)
        elif jump.stop <= index:
            left = max(left, jump.stop)
    return index, min(left, index), max(right, index + 1)


@extraction_step(
    "energy",
    title="Energies",
    protocols=CONTACT_TESTS,
    after=("detachment", "pull-off"),
    gives={
        "adhesion_energy_J": "work of the tension from z_r = 0 to detachment",
        "energy_to_main_jump_J": "part of it up to the largest jump",
        "energy_after_main_jump_J": "part of it after the largest jump",
        "energy_to_pull_off_J": "part of it up to F_p",
    },
)
def energy(work: Extraction) -> Details:
    """Integrate -F_r over the separation (trapezoids) from z_r = 0 to detachment, split at the largest jump."""
    jump = max(work.jumps, key=lambda j: abs(j.size), default=None)
    split = min(jump.middle, work.release) if jump is not None else work.release
    first, last = int(np.ceil(work.zero)), int(np.floor(work.release))
    total, to_split, to_peak = (
        _work(work, first, stop) for stop in (last, int(np.floor(split)), int(np.floor(work.peak)))
    )
    work.set(
        adhesion_energy_J=total,
        energy_to_main_jump_J=to_split,
        energy_after_main_jump_J=total - to_split,
        energy_to_pull_off_J=to_peak,
    )
    return {"decision": "split at the largest jump" if jump is not None else "no jump to split at", "split": split}


def _work(work: Extraction, first: int, last: int) -> float:
    part = slice(first, last + 1)
    return -float(np.trapezoid(work.force[part], work.separation[part]))


@extraction_step(
    "hysteresis",
    title="Hysteresis loop",
    protocols=CONTACT_TESTS,
    after=("energy",),
    gives={"hysteresis_energy_J": "work done on the sample in the whole cycle, contact to detachment"},
)
def hysteresis(work: Extraction) -> Details:
    """Integrate -F_r over the separation around the loop: from contact over preload and dwell to detachment.

    What the gas and the pump put in during the cycle is part of it.
    """
    if work.windows.approach is None:
        raise FeatureMissing("the run has no approach")
    total = _work(work, work.contact_start, int(np.floor(work.release)))
    work.set(hysteresis_energy_J=total)
    return {"decision": "from contact to detachment", "window": (work.contact_start, work.release)}


@extraction_step(
    "pressure",
    title="Pressure",
    protocols=("pull_off",),
    after=("segments",),
    uses=("pull-off", "detachment"),
    gives={
        "initial_pressure_Pa": "P_0: P_a at the start of the retraction",
        "pressure_noise_Pa": "standard deviation of one pressure sample",
        "pressure_at_pull_off_Pa": "P_a at F_p",
        "pressure_at_detachment_Pa": "P_a just before detachment",
    },
)
def pressure(work: Extraction) -> Details:
    """P_0 is a line through the last half second before the retraction, at its start; the others are 100 ms means."""
    signal = work.run.pressure
    if signal is None:
        raise FeatureMissing("the scene has no pressure")
    start, _ = work.retraction()
    length = work.samples(0.5, least=8)
    window = (max(0, start - length), start) if start > 16 else (start, start + length)
    places = np.arange(*window, dtype=np.float64)
    line = np.polynomial.Polynomial.fit(places, signal[slice(*window)], 1)
    residual = np.asarray(signal[slice(*window)] - line(places), dtype=np.float64)
    work.set(initial_pressure_Pa=float(line(start)), pressure_noise_Pa=float(residual.std()))
    half = work.samples(0.05, least=1)
    for name, end in (("pull_off", work.peak + half), ("detachment", work.release)):
        if np.isnan(end):
            work.missing[f"pressure_at_{name}_Pa"] = f"no {name.replace('_', '-')}"
        else:
            last = max(1, int(end))
            work.values[f"pressure_at_{name}_Pa"] = float(signal[max(0, last - 2 * half) : last].mean())
    return {"decision": f"line over {length / work.run.rate:.2g} s before the retraction", "window": window}


@extraction_step(
    "gas work",
    title="Work of the gas",
    protocols=("pull_off",),
    after=("pressure",),
    gives={
        "pump_work_J": "work of the pump on the gas while P_0 is set, p dV",
        "gas_work_J": "work of the gas on the membrane in the retraction, up to 0.1 s before detachment, p dV",
    },
)
def gas_work(work: Extraction) -> Details:
    """Integrate P_a dV with the volume from Boyle's law: V = P_atm V_0 n / (P_atm + P_a).

    1. The amount of gas n is one at rest, where it fills V_0. It leaks, by P_a / (P_atm tau) in a second: tau is read
       off the pressure of the free membrane, from half a second after detachment on, where that is more than twice
       the uncertainty of the sensor's zero.
    2. The last 0.1 s before detachment are left out: there the membrane runs away within milliseconds, and the line to
       the sensor shows the pressure late.

    The pump's part uses the recorded pump volume where there is one, and Boyle's law with V_0 otherwise.
    """
    run = work.run
    if run.parameters is None or run.pressure is None:
        raise FeatureMissing("without parameters the chamber volume is unknown")
    atmosphere, volume = run.parameters.gas.atmospheric_pressure, run.parameters.gripper.chamber_volume
    reason = "the run has no pressurize step"
    width = work.samples(SMOOTHING, least=1)
    if work.windows.pressurize is not None:
        part = slice(*work.windows.pressurize)
        if run.pump_volume is not None:
            work.set(pump_work_J=float(np.trapezoid(run.pressure[part], run.pump_volume[part])))
        else:
            gas = running_mean(run.pressure[part], width)
            work.set(pump_work_J=float(np.trapezoid(gas, volume * (gas - gas[0]) / (atmosphere + gas))))
    else:
        work.missing["pump_work_J"] = reason
    start, stop = work.retraction()
    last = (stop if np.isnan(work.release) else int(work.release)) - work.samples(RUN_AWAY)
    if last <= start:
        raise FeatureMissing("the contact is lost at the start of the retraction")
    gas = running_mean(run.pressure[start:last], width)
    leak = _leak(work, run.pressure)
    amount = 1 - leak * np.cumsum(gas) / (run.rate * atmosphere)
    work.set(gas_work_J=float(np.trapezoid(gas, volume * atmosphere * amount / (atmosphere + gas))))
    words = "pump volume recorded" if run.pump_volume is not None else "volume from Boyle's law"
    return {"decision": words + (f"; leaks within {1 / leak:.0f} s" if leak else "; no leak seen")}


def _leak(work: Extraction, pressure: Array) -> float:
    """Rate at which the free membrane's pressure nears the room's after detachment, over that pressure, 1/s.

    Zero where the pressure is too small beside the uncertainty of the sensor's zero to tell.
    """
    first, (_, stop) = work.release, work.retraction()
    if np.isnan(first) or stop - first < work.samples(2 * SETTLING):
        return 0.0
    tail = pressure[int(first) + work.samples(SETTLING) : stop]
    mean = float(tail.mean())
    if abs(mean) <= 2 * work.run.sensors.pressure_offset:
        return 0.0
    slope = float(np.polynomial.Polynomial.fit(np.arange(tail.size), tail, 1).deriv()(0.0)) * work.run.rate
    return max(0.0, -slope / mean)


@extraction_step(
    "stress",
    title="Stress",
    protocols=("pull_off", "punch"),
    after=("pull-off",),
    gives={"adhesion_stress_Pa": "F_p over the contact area: measured, or pi r_e^2 (large spheres and flats)"},
)
def stress(work: Extraction) -> Details:
    """Divide F_p by the contact area: measured (``contact_area_mm2``), else that of a full contact.

    The contact is full on flats and large spheres. The papers use r_e = 7.3 mm there (1.67 cm^2), an average estimate;
    with the rigid gripper the area could not be seen on smaller spheres. Its uncertainty is that of r_e
    (``effective_radius_uncertainty_mm``, 0.1 mm unless the scene says otherwise).
    """
    measured = area_of(work.run, "contact_area_mm2")
    if measured is not None:
        work.set(adhesion_stress_Pa=work.values["pull_off_force_N"] / measured)
        return {"decision": f"A_c = {measured * 1e4:.3f} cm², measured"}
    parameters = work.run.parameters
    if parameters is None:
        raise FeatureMissing("without parameters the contact area is unknown")
    if parameters.substrate.radius < 3 * parameters.gripper.radius:
        raise FeatureMissing("the contact on so small a sphere is not full, and its area was not measured (--areas)")
    area = full_contact_area(full_contact_radius(parameters)).value
    work.set(adhesion_stress_Pa=work.values["pull_off_force_N"] / area)
    return {"decision": f"A_c = {area * 1e4:.3f} cm²"}
