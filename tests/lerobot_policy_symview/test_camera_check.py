"""`--policy.check_camera`: the first observation is compared with the demonstrations."""

import logging

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.placement import CameraSpec, CameraSpread
from lerobot_symview.runtime.flag_errors import FlagError
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset
from tests.helpers.datasets import views_config
from tests.helpers.policies import make_policy
from tests.helpers.training import train

IMAGE = keys.rgb("side")
CHECK = "--policy.check_camera=true"


@pytest.fixture(scope="module")
def checkpoint(recorded, tmp_path_factory):
    """Folder of a policy that keeps an image of the demonstrations."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        return train(monkeypatch, recorded, tmp_path_factory.mktemp("checked") / "policy", CHECK)


@pytest.fixture
def frame(recorded):
    """The first frame of the second demonstration: the same camera, other objects."""
    dataset = LeRobotDataset("test/recorded", root=recorded, depth_output_unit="m")
    index = int(dataset.meta.episodes[1]["dataset_from_index"])
    return {key: value for key, value in dataset[index].items() if key.startswith("observation.")}


def shifted(image, pixels):
    """An image (3, H, W) whose content has moved to the right; its edge is repeated."""
    return torch.cat([image[..., :1].expand(-1, -1, pixels), image[..., :-pixels]], dim=-1)


def act(checkpoint, observation):
    policy = SymviewBcPolicy.from_pretrained(checkpoint)
    return policy, policy.select_action(make_processors(policy.config)[0](observation))


def test_a_camera_that_stands_still_is_told_once(checkpoint, frame, caplog):
    caplog.set_level(logging.INFO)
    policy, action = act(checkpoint, frame)
    assert action.isfinite().all()
    assert "the image of camera 'side' has moved by 0.0 pixels" in caplog.text
    caplog.clear()
    policy.select_action(make_processors(policy.config)[0](frame))
    assert "moved" not in caplog.text


def test_a_moved_camera_is_warned_of_with_millimetres(checkpoint, frame, caplog):
    _, action = act(checkpoint, frame | {IMAGE: shifted(frame[IMAGE], 4)})
    assert action.isfinite().all()
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "has moved by 4.0 pixels (up to " in warning
    assert "mm on the table): move it back" in warning


@pytest.mark.parametrize("kind", ["lens cap", "another scene", "upside down"])
def test_a_policy_does_not_act_on_an_image_that_shows_something_else(kind, checkpoint, frame):
    image = frame[IMAGE]
    other = {
        "lens cap": torch.zeros_like(image),
        "another scene": torch.from_numpy(np.random.default_rng(0).random(image.shape, dtype=np.float32)),
        "upside down": image.flip(-2),
    }
    is_black = kind == "lens cap"
    message = "the view 'reproj' of camera 'side' is black" if is_black else "does not show what it showed in the demo"
    with pytest.raises(CalibrationError, match=message):
        act(checkpoint, frame | {IMAGE: other[kind]})


def test_the_stored_image_is_the_first_of_the_demonstrations(checkpoint, recorded):
    policy = SymviewBcPolicy.from_pretrained(checkpoint)
    first = LeRobotDataset("test/recorded", root=recorded)[0][IMAGE]
    torch.testing.assert_close(policy.reference_image.permute(2, 0, 1).float() / 255, first)


def test_the_check_can_be_switched_off_but_not_on_without_an_image(checkpoint, frame, tmp_path, caplog):
    config = SymviewBcPolicy.from_pretrained(checkpoint).config
    config.check_camera = False
    policy = SymviewBcPolicy.from_pretrained(checkpoint, config=config)
    observation = make_processors(config)[0](frame | {IMAGE: torch.zeros_like(frame[IMAGE])})
    assert policy.select_action(observation).isfinite().all()
    policy.save_pretrained(tmp_path)
    config.check_camera = True
    with pytest.raises(ValueError, match=r"needs a policy that was trained with --policy\.check_camera=true"):
        SymviewBcPolicy.from_pretrained(tmp_path, config=config)


def test_a_policy_on_the_cameras_own_image_is_checked_too(monkeypatch, recorded, tmp_path, frame):
    checkpoint = train(monkeypatch, recorded, tmp_path / "policy", CHECK, "--policy.method=sideview_equi")
    assert act(checkpoint, frame)[1].isfinite().all()
    with pytest.raises(CalibrationError, match="does not show what it showed"):
        act(checkpoint, frame | {IMAGE: torch.zeros_like(frame[IMAGE])})


def test_reinforcement_learning_has_no_images_to_compare():
    with pytest.raises(FlagError, match=r"--policy\.check_camera is for cloned policies"):
        SymviewSacfdConfig(check_camera=True)


def test_policies_without_the_check_store_no_image():
    assert "reference_image" not in make_policy().state_dict()


def test_training_needs_the_images_of_one_calibration(monkeypatch, recorded, tmp_path, capfd):
    env = RecordedEnv(camera=CameraSpec(spread=CameraSpread(azimuth_deg=10.0)))
    moving = generate(GenerateConfig(NewDataset("test/recorded", tmp_path / "moving"), num_episodes=2, env=env))
    views = add_views(views_config(recorded, tmp_path / "views", views=["reproj"], keep=[]))
    for name, dataset in {"moving": moving, "views": views}.items():
        with pytest.raises(ValueError, match="check_camera compares images of the camera 'side' with those of the"):
            train(monkeypatch, dataset, tmp_path / f"policy_{name}", CHECK)
