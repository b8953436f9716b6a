"""The batch solver beside the scalar one."""

from __future__ import annotations

import random

import numpy as np
import pytest

from analysis.accuracy.cone_study import sweep_scenes
from analysis.accuracy.extremes import ordinary_scene
from model import Gas, GasAnchor, Gripper, InvalidParameter, Membrane, Parameters, Substrate, cone
from model.batch import FEATURES, solve_many
from model.prediction import Outcome


@pytest.mark.parametrize("contact_stretch", [True, False])
def test_agrees_with_the_scalar_solver(contact_stretch):
    source = random.Random(3)
    scenes = [*sweep_scenes(150), *(ordinary_scene(source) for _ in range(150))]
    solved = solve_many(scenes, contact_stretch=contact_stretch)
    for k, scene in enumerate(scenes):
        alone = cone.solve(scene, contact_stretch=contact_stretch, points=16)
        assert solved.outcome[k] == alone.outcome
        for name in FEATURES:
            size = max(abs(getattr(alone, name)), 1e-3 * alone.pull_off_distance)
            assert getattr(solved, name)[k] == pytest.approx(getattr(alone, name), abs=1e-8 * size), (name, scene)
        for name, errors in solved.numerical_error.items():
            value = getattr(alone, name)
            assert abs(getattr(solved, name)[k] - value) <= errors[k] + alone.numerical_error[name] + 1e-14 * value, (
                name
            )


def test_order_and_kinds_may_be_mixed():
    scenes = sweep_scenes(40)
    vented = [Parameters(scene.substrate, gas=Gas(0.0, anchor=GasAnchor.VENTED)) for scene in scenes]
    mixed = [one for pair in zip(scenes, vented, strict=True) for one in pair]
    together, apart = solve_many(mixed), solve_many(scenes)
    assert together.pull_off_force[::2] == pytest.approx(apart.pull_off_force, rel=1e-12)


def test_typed_outcomes_keep_their_place():
    scenes = [
        Parameters(Substrate("flat")),
        Parameters(Substrate("sphere", 15e-3), Gripper(chamber_volume=5e-7)),
        Parameters(Substrate("flat"), membrane=Membrane(work_of_adhesion=0.0), gas=Gas(-1000.0)),
        Parameters(Substrate("flat"), Gripper(effective_radius=8e-3)),
    ]
    solved = solve_many(scenes)
    assert list(solved.outcome) == [
        Outcome.PULL_OFF,
        Outcome.CHAMBER_CLOSED,
        Outcome.NO_EQUILIBRIUM,
        Outcome.PULL_OFF,
    ]
    assert np.isnan(solved.pull_off_force).tolist() == [False, True, True, False]
    frame = solved.frame()
    assert frame["outcome"].iloc[1] == str(Outcome.CHAMBER_CLOSED)
    assert {"pull_off_force_N", "pull_off_distance_m", "pull_off_force_error_N"} <= set(frame.columns)


def test_evaluations_per_scene_stay_few():
    solved = solve_many(sweep_scenes(512))
    assert solved.scalar_scenes <= 5
    assert solved.evaluations / 512 < 600


def test_an_impossible_scene_is_refused():
    with pytest.raises(InvalidParameter, match="V_0"):
        solve_many([Parameters(Substrate("flat")), Parameters(Substrate("flat"), Gripper(chamber_volume=-1.0))])


def test_nothing_in_nothing_out():
    assert solve_many([]).pull_off_force.size == 0
