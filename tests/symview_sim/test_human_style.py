"""Demonstrations like a person's: several ways to act in one state, and a set of styles that is closed under D4."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from symview_sim import TASK_NAMES
from symview_sim.control import CONTROLS, FINE
from symview_sim.human_style import EARLY_CLOSE, WRONG_PLACE, Hand, Style, draw_style, human_action
from symview_sim.settings import EnvSettings
from symview_sim.tasks import make_task
from tests.helpers.scenes import TransformedScene

TINY = CameraSpec(height=8, width=8)
GROUP = [(turns, reflect) for turns in range(4) for reflect in (False, True)]
GRASPS = ("block_picking", "block_in_bowl", "block_stacking")
STYLE = draw_style(np.random.default_rng(0), 1, ())


def make_env(task, control="fine", **options):
    return EnvSettings(task, control=control, style="human", camera=TINY, depth=False, **options).make()


def episode(env, seed):
    """Return the states, actions and outcome of an episode."""
    observation, info = env.reset(seed=seed)
    states, actions, done = [observation["agent_pos"]], [], False
    while not done:
        actions.append(env.expert_action())
        observation, _, terminated, truncated, info = env.step(actions[-1])
        states.append(observation["agent_pos"])
        done = terminated or truncated
    return np.array(states), np.array(actions), info["is_success"]


def first_seed(env, mistake):
    """Return the first seed whose episode has a mistake."""
    for seed in range(200):
        env.reset(seed=seed)
        if env.episode_style["mistake"] == mistake:
            return seed
    raise AssertionError(f"no {mistake} in 200 episodes")


@pytest.mark.long
@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("task", TASK_NAMES)
def test_people_solve_the_tasks(task, control):
    env = make_env(task, control)
    outcomes = [episode(env, seed) for seed in range(5)]
    assert all(success for *_, success in outcomes)
    for _, actions, _ in outcomes:
        assert (np.abs(actions[:, :4]) <= CONTROLS[control].limits + 1e-7).all()
    assert len({len(actions) for _, actions, _ in outcomes}) > 2


@pytest.mark.parametrize("task", TASK_NAMES)
def test_an_episode_follows_from_its_seed_and_shows_the_planners_scene(task):
    camera = replace(TINY, spread=CameraSpread(azimuth_deg=90.0))
    planner, human, other = (
        EnvSettings(task, control="fine", style=style, camera=camera).make() for style in ("planner", "human", "human")
    )
    other.reset(seed=1)
    expected, first, second = (env.reset(seed=4)[0] for env in (planner, human, other))
    for observation in (first, second):
        np.testing.assert_array_equal(observation["pixels"]["side"], expected["pixels"]["side"])
        np.testing.assert_array_equal(observation["camera.side.world_from_cam"], expected["camera.side.world_from_cam"])
    assert human.episode_style == other.episode_style != {} == planner.episode_style
    for _ in range(10):
        action = human.expert_action()
        np.testing.assert_array_equal(action, human.expert_action())  # asking twice changes nothing
        np.testing.assert_array_equal(action, other.expert_action())
        human.step(action)
        other.step(action)


@pytest.mark.parametrize("task", TASK_NAMES)
def test_people_act_differently_in_one_state(task):
    """The first motion of two ways ends in places or yaws that are far from each other."""
    env = make_env(task)
    apart = []
    for seed in range(8):
        env.reset(seed=seed)
        intents = [env.episode_task.action_of_way(env.scene, way) for way in range(env.episode_task.ways)]
        assert len(intents) >= 2
        for index, one in enumerate(intents):
            for other in intents[:index]:
                turned = abs((one[3] - other[3] + np.pi / 2) % np.pi - np.pi / 2)
                apart.append(turned > 1.5 or np.linalg.norm((one - other)[:2]) > 0.035)
    assert np.mean(apart) > 0.8


def test_equal_states_have_two_grasps_90_degrees_apart():
    """The same scene, demonstrated in both ways: the cube's yaw and the gripper's differ by 0 or by 90 degrees."""
    env = make_env("block_picking")
    grasps = {0: [], 1: []}
    for seed in range(4):
        for way, differences in grasps.items():
            env.reset(seed=seed)
            env._style = replace(env._style, way=way, mistake="none")
            done = False
            while not done and not env.scene.arm.holds(env.episode_task._cube):
                difference = env.scene.arm.yaw - env.scene.pose(env.episode_task._cube)[1]
                _, _, terminated, truncated, _ = env.step(env.expert_action())
                done = terminated or truncated
            assert not done
            differences.append(abs((difference + np.pi / 2) % np.pi - np.pi / 2))
    assert max(grasps[0]) < 0.2
    assert min(grasps[1]) > np.pi / 2 - 0.2


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_ways_are_closed_under_rotations_and_reflections(task):
    """A planar transform of the scene permutes the ways; all are equally probable."""
    env = make_env(task, start_jitter=0.05)
    scenes = {element: [] for element in GROUP}
    ways = range(env.episode_task.ways)
    for seed in range(3):
        env.reset(seed=seed)
        done = False
        while not done:
            for element, actions in scenes.items():
                scene = TransformedScene(env.scene, *element)
                expected = [scene.transformed_action(env.episode_task.action_of_way(env.scene, way)) for way in ways]
                actions.append((expected, [env.episode_task.action_of_way(scene, way) for way in ways]))
            _, _, terminated, truncated, _ = env.step(env.expert_action())
            done = terminated or truncated
    for element, actions in scenes.items():
        expected, actual = (np.array(side) for side in zip(*actions, strict=True))
        errors = [np.abs(actual[:, list(order)] - expected) for order in permutations(ways)]
        assert min(error.max() for error in errors) < 1e-6, element


@pytest.mark.parametrize(("quarter_turns", "reflect"), GROUP)
def test_a_transformed_style_acts_as_the_style_in_the_transformed_scene(quarter_turns, reflect):
    sign, angle = -1.0 if reflect else 1.0, quarter_turns * np.pi / 2
    matrix = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([1.0, sign])

    def transformed(action):
        return np.array([*(matrix @ action[:2]), action[2], sign * action[3], action[4]])

    rng = np.random.default_rng(1)
    for mistake in (WRONG_PLACE, EARLY_CLOSE):
        style = replace(draw_style(rng, 1, ()), mistake=mistake, aim=(0.03, -0.02))
        other = replace(style, bend=sign * style.bend, aim=tuple(matrix @ style.aim))
        hand, other_hand = Hand(), Hand()
        position, goal = np.array([0.1, -0.05, 0.2]), np.array([0.0, 0.08, 0.025])
        for step in range(60):
            intent = np.array([*(goal - position), 0.5 - 0.01 * step, 1.0])
            action, hand = human_action(style, hand, step / 10, intent, position[2], FINE)
            turned, other_hand = human_action(other, other_hand, step / 10, transformed(intent), position[2], FINE)
            np.testing.assert_allclose(turned, transformed(action), atol=1e-12)
            position = position + action[:3]
        assert np.linalg.norm(position - goal) < 0.02


def test_styles_and_their_reflections_are_equally_probable():
    """Bends to both sides, aims in all directions, and all ways: within four standard deviations."""
    rng = np.random.default_rng(0)
    count = 2000
    styles = [draw_style(rng, 4, (WRONG_PLACE, EARLY_CLOSE)) for _ in range(count)]
    tolerance = 4 * np.sqrt(count) / 2
    assert abs(sum(style.bend > 0 for style in styles) - count / 2) < tolerance
    octants = [int(np.arctan2(style.aim[1], style.aim[0]) % (2 * np.pi) // (np.pi / 4)) for style in styles]
    for values, parts in ((octants, 8), ([style.way for style in styles], 4)):
        assert np.abs(np.bincount(values, minlength=parts) - count / parts).max() < tolerance
    assert abs(np.corrcoef([style.bend > 0 for style in styles], [style.way for style in styles])[0, 1]) < 0.1
    mistakes = [style.mistake for style in styles]
    assert 0.25 < 1 - mistakes.count("none") / count < 0.35
    assert set(mistakes) == {"none", WRONG_PLACE, EARLY_CLOSE}


def test_the_pace_varies_and_a_pause_stops_the_hand():
    style = replace(STYLE, pauses=((1.0, 1.0),), swing=(0.3, 2.0, 0.0), mistake="none")
    hand, speeds = Hand(), []
    for step in range(60):
        action, hand = human_action(style, hand, step / 10, np.array([1.0, 0.0, 0.0, 0.0, 1.0]), 0.2, FINE)
        speeds.append(np.linalg.norm(action[:3]) * 10)
    assert speeds[0] < 0.6 * speeds[5]  # it gathers speed
    assert max(speeds[16:19]) < 0.1 * style.pace
    assert max(speeds[25:]) > 1.3 * min(speeds[25:])


def test_a_hand_goes_past_its_goal_and_returns():
    style = replace(STYLE, aim=(0.0, 0.0), bend=0.0, pauses=(), reaction=5.0, inertia=0.25)
    hand, positions = Hand(), [0.0]
    for step in range(80):
        intent = np.array([0.1 - positions[-1], 0.0, 0.0, 0.0, 1.0])
        action, hand = human_action(style, hand, step / 10, intent, 0.2, FINE)
        positions.append(positions[-1] + action[0])
    assert 0.102 < max(positions) < 0.115
    assert positions[-1] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("task", GRASPS)
def test_fingers_that_close_too_early_open_again_and_the_episode_succeeds(task):
    env = make_env(task)
    _, actions, success = episode(env, first_seed(env, EARLY_CLOSE))
    closed = actions[:, 4] < 0.5
    assert success
    assert np.count_nonzero(np.diff(closed.astype(int)) == 1) >= 2


@pytest.mark.parametrize("task", TASK_NAMES)
def test_a_wrong_place_is_left_after_a_pause_and_the_episode_succeeds(task):
    env = make_env(task)
    states, _, success = episode(env, first_seed(env, WRONG_PLACE))
    speeds = np.linalg.norm(np.diff(states[:, :3], axis=0), axis=1)
    assert success
    above = states[1:, 2] > 0.06
    assert speeds[above][4:-4].min() < 0.004


def test_a_task_without_ways_of_its_own_is_demonstrated_in_the_experts():
    class Plain(type(make_task("block_picking"))):
        action_of_way = make_task("block_picking").__class__.__mro__[1].action_of_way

    env = make_env("block_picking")
    env.reset(seed=0)
    task = env.episode_task
    task.__class__ = Plain
    np.testing.assert_array_equal(task.action_of_way(env.scene, 0), task.expert_action(env.scene))


def test_a_style_is_plain_data():
    env = make_env("block_picking")
    env.reset(seed=0)
    assert set(env.episode_style) == set(Style.__dataclass_fields__)
