"""Simulators in separate processes."""

import os
import signal

import numpy as np
import pytest

from lerobot_symview import keys
from lerobot_symview.runtime.cli import CommandError
from lerobot_symview.views import ViewSpec
from symview_sim.settings import EnvSettings
from symview_sim.simulators import Reset, SimulatorConfig, Simulators, Step

NAMES = (keys.view("side", "reproj"), keys.view("side", "reproj_height"), keys.STATE)
CONFIG = SimulatorConfig(EnvSettings(max_steps=3), NAMES, (ViewSpec("reproj", {"size": 76}),))
ACTIONS = np.random.default_rng(0).uniform(-0.05, 0.05, (20, 5)).astype(np.float32)


@pytest.fixture(scope="module")
def simulators():
    with Simulators(CONFIG, 2) as two:
        yield two


def run(simulators, index, command):
    simulators.send(index, command)
    return simulators.receive(index)


def assert_same(actual, expected):
    assert actual.keys() == expected.keys() == set(NAMES)
    for name, value in expected.items():
        np.testing.assert_array_equal(actual[name], value)


def test_observations_equal_those_of_the_environment_and_the_view(simulators):
    from lerobot_symview.geometry.camera import stored_camera
    from lerobot_symview.geometry.workspace import Workspace
    from lerobot_symview.views import Frame, ReprojectedView
    from symview_sim.camera_rig import named_features

    outcome = run(simulators, 0, Reset(7))
    env = CONFIG.env.make()
    raw = named_features(env.reset(seed=7)[0])
    env.close()
    camera = stored_camera(raw[keys.intrinsics("side")], raw[keys.world_from_cam("side")], 152, 152)
    depth = raw[keys.depth("side")][..., 0]
    made = ReprojectedView(size=76).render(Frame(raw[keys.rgb("side")], depth, camera, Workspace(), raw[keys.STATE]))
    assert outcome.observation[NAMES[0]].dtype == np.uint8
    np.testing.assert_array_equal(outcome.observation[NAMES[0]], made["reproj"])
    np.testing.assert_array_equal(outcome.observation[NAMES[1]][..., 0], made["reproj_height"])
    np.testing.assert_array_equal(outcome.observation[keys.STATE], raw[keys.STATE])


def test_the_next_episode_follows_the_end_of_an_episode(simulators):
    run(simulators, 0, Reset(1))
    outcomes = [run(simulators, 0, Step(ACTIONS[i], next_seed=2)) for i in range(3)]
    assert [outcome.last is not None for outcome in outcomes] == [False, False, True]
    assert not any(outcome.terminated or outcome.success or outcome.lost for outcome in outcomes)
    assert_same(outcomes[-1].observation, run(simulators, 1, Reset(2)).observation)
    assert outcomes[-1].last[keys.STATE][0] != outcomes[-1].observation[keys.STATE][0]


def test_without_a_next_seed_no_episode_follows(simulators):
    run(simulators, 0, Reset(1))
    outcomes = [run(simulators, 0, Step(ACTIONS[i], next_seed=None)) for i in range(3)]
    assert outcomes[-1].observation is None
    assert outcomes[-1].last is not None


def test_seed_and_actions_determine_a_simulators_state(simulators):
    run(simulators, 0, Reset(3))
    expected = [run(simulators, 0, Step(action, None)).observation for action in ACTIONS[:2]][-1]
    run(simulators, 1, Reset(99))
    run(simulators, 1, Step(ACTIONS[5], None))
    assert_same(run(simulators, 1, Reset(3, tuple(ACTIONS[:2]))).observation, expected)


@pytest.mark.parametrize("when", ["idle", "busy"])
def test_a_dead_simulator_is_replaced_and_its_episode_lost(simulators, caplog, when):
    run(simulators, 0, Reset(1))
    run(simulators, 1, Reset(1))
    before = simulators.process_ids
    if when == "busy":
        simulators.send(0, Step(ACTIONS[0], next_seed=5))
    os.kill(before[0], signal.SIGKILL)
    if when == "idle":
        while simulators.is_alive(0):
            pass
        assert simulators.cpu_seconds() > 0  # of the other one
        simulators.send(0, Step(ACTIONS[0], next_seed=5))
    outcome = simulators.receive(0)
    if when == "idle" or outcome.lost:  # a busy one may have finished before the signal
        assert outcome.lost
        assert "simulator 0 died (exit code -9)" in caplog.text
        assert simulators.process_ids[0] != before[0]
        assert_same(outcome.observation, run(simulators, 1, Reset(5)).observation)
        assert not run(simulators, 0, Step(ACTIONS[0], next_seed=6)).lost
    assert simulators.process_ids[1] == before[1]


def test_a_simulator_that_dies_at_every_start_raises_an_error():
    broken = SimulatorConfig(EnvSettings(), ("observation.images.nowhere",))
    with Simulators(broken, 1) as one:
        one.send(0, Reset(0))
        with pytest.raises(CommandError, match="simulator 0 dies as soon as it is started"):
            one.receive(0)


def test_an_action_that_is_not_finite_is_refused_and_the_simulator_lives_on(simulators):
    run(simulators, 0, Reset(1))
    with pytest.raises(ValueError, match="the action must be finite: dy is nan"):
        simulators.send(0, Step(np.array([0.0, np.nan, 0.0, 0.0, 1.0]), None))
    assert not run(simulators, 0, Step(ACTIONS[0], None)).lost


def test_ctrl_c_does_not_stop_a_simulator(simulators):
    run(simulators, 0, Reset(1))
    os.kill(simulators.process_ids[0], signal.SIGINT)
    assert not run(simulators, 0, Step(ACTIONS[0], None)).lost


def test_closed_simulators_leave_no_process():
    with Simulators(CONFIG, 1) as one:
        run(one, 0, Reset(0))
        (process,) = one.process_ids
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)
