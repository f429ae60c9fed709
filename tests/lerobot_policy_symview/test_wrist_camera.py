"""`--policy.wrist_camera`: equivariance with the gripper's image, and LeRobot's commands around it."""

import sys

import numpy as np
import pytest
import torch
from lerobot.scripts import lerobot_eval

from lerobot_policy_symview import equivariance
from lerobot_policy_symview.configuration_symview_flow import SymviewFlowConfig
from lerobot_policy_symview.equivariance import assert_equivariant, equivariance_errors, example_observation
from lerobot_policy_symview.inputs.history import as_history
from lerobot_policy_symview.inputs.wrist import wrist_input
from lerobot_policy_symview.model_card import model_card
from lerobot_policy_symview.modeling_symview_flow import SymviewFlowPolicy
from lerobot_policy_symview.rl.rollouts import Actor, simulator_config
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_policy_symview.symmetry.transforms import PlanarTransform
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from lerobot_symview.runtime.flag_errors import FlagError
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import EnvSettings, NewDataset
from symview_sim.simulators import Reset, Simulators
from tests.helpers.training import train as lerobot_train
from tests.lerobot_policy_symview.test_modeling_symview_flow import make_chunk_policy, train

WRIST = keys.rgb("wrist")


@pytest.mark.parametrize("kind", ["flow", "regression"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"method": "sideview_equi", "group": "C4"}, marks=pytest.mark.long),
        pytest.param({"n_obs_steps": 1, "crop_size": 128}, marks=pytest.mark.long),
        pytest.param({"method": "point_cloud_equi"}, marks=pytest.mark.long),
    ],
)
def test_chunks_are_equivariant_with_the_image_of_the_gripper(kind, options, tmp_path):
    policy = train(make_chunk_policy(kind, wrist_camera="wrist", **options))
    assert_equivariant(policy)
    policy.save_pretrained(tmp_path)
    loaded = type(policy).from_pretrained(tmp_path)
    assert loaded.config.wrist_camera == "wrist"
    assert_equivariant(loaded)
    assert_equivariant(loaded.double(), tolerance=1e-10)


def test_one_observation_and_one_action_are_equivariant_too():
    policy = make_chunk_policy("regression", wrist_camera="wrist", n_obs_steps=1, horizon=1, n_action_steps=1)
    assert policy.select_action(example_observation(policy.config)).shape == (2, 5)
    assert_equivariant(policy)


@pytest.mark.parametrize("wrong", ["reflections keep it", "rotations turn it"])
def test_the_check_fails_if_the_image_transforms_otherwise(wrong, monkeypatch):
    policy = train(make_chunk_policy(wrist_camera="wrist"), steps=30)
    correct = equivariance.transform_observation

    def transformed(observation, config, group, element, camera=None):
        moved = correct(observation, config, group, element, camera)
        if wrong == "reflections keep it":
            return moved | {WRIST: observation[WRIST]}
        return moved | {WRIST: moved[WRIST].flip((-2, -1))} if element % 4 == 2 else moved

    monkeypatch.setattr(equivariance, "transform_observation", transformed)
    errors = equivariance_errors(policy)
    violated = {element for element, error in errors.items() if error > 1e-3}
    assert violated == ({4, 5, 6, 7} if wrong == "reflections keep it" else {2, 6})
    with pytest.raises(AssertionError, match="not equivariant"):
        assert_equivariant(policy)


def test_all_frames_of_the_image_change_the_chunk():
    policy = train(make_chunk_policy(wrist_camera="wrist"))
    observation, noise = as_history(example_observation(policy.config, batch=4), 2), policy.draw_noise(2)
    chunk = policy.predict_action_chunk(observation, noise=noise)
    for frame in range(2):
        changed = observation[WRIST].clone()
        changed[0, frame] = 0
        other = policy.predict_action_chunk(observation | {WRIST: changed}, noise=noise)
        assert (other[0] - chunk[0]).abs().max() > 1e-6
        torch.testing.assert_close(other[1], chunk[1])


def test_reflected_scenes_have_flipped_images_in_training():
    images = torch.rand(3, 3, 60, 80, generator=torch.Generator().manual_seed(0))
    angle = torch.tensor([0.0, 1.0, 2.0])
    transform = PlanarTransform(angle, torch.tensor([False, True, False]))
    moved, still = wrist_input(images, 76, 64, transform), wrist_input(images, 76, 64)
    torch.testing.assert_close(moved[[0, 2]], still[[0, 2]], rtol=0, atol=0)
    torch.testing.assert_close(moved[1], still[1].flip(-1))
    cropped = wrist_input(images, 76, 64, transform, torch.zeros(3, 2))
    assert cropped.shape == (3, 3, 64, 64)
    flipped = wrist_input(images.flip(-1), 76, 64, None, torch.zeros(3, 2))
    torch.testing.assert_close(cropped[1], flipped[1])


def test_augmented_samples_give_transformed_features():
    policy = make_chunk_policy(wrist_camera="wrist", augmentation="d4", n_obs_steps=1).eval()
    config, group = policy.config, make_group("D4")
    raw = example_observation(config)
    features = policy.network.encoder(*policy.network_input(raw))
    element = 5
    moved = policy.network.encoder(
        *policy.network_input(raw, PlanarTransform.of_element(group, element, raw[keys.STATE]))
    )
    torch.testing.assert_close(moved, features[:, group.quotient[element]], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("camera", ["side", "left"])
def test_the_camera_of_a_view_is_refused(camera):
    with pytest.raises(FlagError, match=f"--policy.wrist_camera={camera} is a camera of the policy's view"):
        SymviewFlowConfig(view={"name": "reproj", "cameras": ["left"]}, wrist_camera=camera)


def test_observations_without_the_image_are_refused():
    policy = make_chunk_policy(wrist_camera="wrist")
    observation = example_observation(policy.config)
    del observation[WRIST]
    with pytest.raises(KeyError, match=r"--policy.wrist_camera=wrist needs observation\.images\.wrist, the obs"):
        policy.select_action(observation)


def test_simulators_report_the_image():
    policy = make_chunk_policy(wrist_camera="wrist")
    with pytest.raises(ValueError, match=r"needs observation.images.wrist: --env.wrist_camera=true simulates"):
        simulator_config(policy.config, EnvSettings("block_picking"))
    config = simulator_config(policy.config, EnvSettings("block_picking", wrist_camera=True))
    with Simulators(config, 1) as simulators:
        simulators.send(0, Reset(0))
        observation = simulators.receive(0).observation
    assert observation[WRIST].shape == (96, 96, 3)
    assert np.isfinite(Actor(policy)([observation])).all()


def test_the_model_card_names_the_image():
    card = str(model_card(make_chunk_policy(wrist_camera="wrist").config, 1000, "me/data", {}))
    assert "the image `observation.images.wrist` of a camera on the gripper" in card


def test_it_does_not_take_the_place_of_the_policys_camera():
    config = SymviewFlowConfig(method="persp_equi", wrist_camera="wrist")
    names = [keys.rgb("wrist"), *keys.calibration("wrist", ()), keys.rgb("front"), *keys.calibration("front", ())]
    assert config.substitutes(names) == ["front"]
    assert SymviewFlowConfig(method="persp_equi").substitutes(names) != ["front"]


@pytest.fixture(scope="module")
def with_wrist(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wrist")
    env = RecordedEnv("block_picking", wrist_camera=True, oracle=False)
    source = generate(GenerateConfig(NewDataset("test/wrist", folder / "recorded"), env, num_episodes=1))
    config = AddViewsConfig(HubDataset("test/wrist", source), new_root=folder / "views", keep=["wrist"], size=76)
    return add_views(config)


SIZES = ("--policy.type=symview_flow", "--policy.width=16", "--policy.crop_size=64")
FLOW = (*SIZES, "--policy.horizon=4", "--policy.n_action_steps=2", "--policy.augmentation=d4")


@pytest.mark.long
def test_lerobot_trains_and_evaluates_with_the_simulators_camera(with_wrist, tmp_path, monkeypatch):
    checkpoint = lerobot_train(
        monkeypatch, with_wrist, tmp_path / "policy", policy=[*FLOW, "--policy.wrist_camera=wrist"]
    )
    policy = SymviewFlowPolicy.from_pretrained(checkpoint)
    assert policy.config.input_features[WRIST].shape == (3, 96, 96)
    assert_equivariant(policy)
    seen = []
    original = SymviewFlowPolicy.network_input

    def recorded(self, batch, *arguments):
        seen.append(batch[WRIST].shape)
        return original(self, batch, *arguments)

    monkeypatch.setattr(SymviewFlowPolicy, "network_input", recorded)
    command = f"lerobot-eval --policy.path={checkpoint} --policy.device=cpu --env.type=symview --env.max_steps=3"
    size = f"--env.wrist_camera=true --eval.n_episodes=1 --eval.batch_size=1 --output_dir={tmp_path / 'eval'}"
    monkeypatch.setattr(sys, "argv", [*command.split(), *size.split()])
    lerobot_eval.main()
    assert seen == [(2, 3, 96, 96)] * 2


@pytest.mark.long
@pytest.mark.parametrize("camera", ["hand", "side_reproj_height"])
def test_a_dataset_without_the_colour_image_is_refused(camera, with_wrist, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=rf"--policy.wrist_camera={camera} needs the colour image .* has the images"):
        lerobot_train(monkeypatch, with_wrist, tmp_path / "policy", policy=[*FLOW, f"--policy.wrist_camera={camera}"])
