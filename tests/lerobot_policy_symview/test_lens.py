"""Cameras with a lens: views offline and online, and the policies that see them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from lerobot.datasets import LeRobotDataset

from lerobot_policy_symview.export import export_policy
from lerobot_policy_symview.inputs.observation_codec import ObservationCodec
from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview import keys
from lerobot_symview.calibration.file import Calibration, plain_calibration
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.lens import EQUIDISTANT, PLUMB_BOB, Lens
from lerobot_symview.geometry.visibility import table_rays
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import make_view
from tests.helpers.cameras import make_camera
from tests.helpers.datasets import record_real_robot, views_config
from tests.helpers.policies import make_policy, training_batch

LENSES = {"webcam": Lens(PLUMB_BOB, (-0.1, 0.02, 0.001, 0.0)), "fisheye": Lens(EQUIDISTANT, (0.05, 0.0, 0.0, 0.0))}
OPTIONS = [{"name": "reproj", "size": 32, "clip": "none"}, {"name": "persp", "size": 32, "gripper": False}]


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_online_and_offline_views_through_a_lens_are_bit_identical(tmp_path, lens):
    """From the file, from the lens that the result stores, and rendered again from the result."""
    camera = replace(make_camera(size=96), lens=lens)
    depth = table_rays(camera, Workspace())[1].astype(np.float32)
    rgb = np.random.default_rng(0).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    record_real_robot(tmp_path / "source", rgb, depth)
    file = tmp_path / "cameras.yaml"
    file.write_text(yaml.safe_dump(plain_calibration(Calibration({"front": camera}))))
    views = {"views": ["reproj", "persp"], "size": 32, "camera": "front", "depth_unit": "m"}
    result = add_views(views_config(tmp_path / "source", tmp_path / "views", calibration=file, **views))
    frame = LeRobotDataset("test/views", root=result, depth_output_unit="m")[0]
    stored = Lens(lens.model, tuple(np.float32(lens.coefficients).tolist())).stored()
    np.testing.assert_array_equal(frame[keys.distortion("front")].numpy(), stored.astype(np.float32))
    made = [keys.view("front", output) for each in OPTIONS for output in make_view(**each).outputs]
    observed = {key: values[None] for key, values in frame.items() if torch.is_tensor(values) and key not in made}
    bare = {key: values for key, values in observed.items() if not key.startswith("observation.camera.")}
    own = plain_calibration(read_calibration(file))
    for observation, calibration in ((observed, {}), (bare, own)):
        step = ViewsProcessorStep(views=OPTIONS, camera="front", calibration=calibration, gripper=[])
        online = step.observation(dict(observation))
        for key in made:
            np.testing.assert_array_equal(online[key][0].numpy(), frame[key].numpy(), err_msg=key)
    without_lens = {key: values for key, values in observed.items() if key != keys.distortion("front")}
    step = ViewsProcessorStep(views=OPTIONS[1:], camera="front", gripper=[])
    assert not torch.equal(step.observation(without_lens)[keys.view("front", "persp")][0], frame[made[-1]])


def test_a_lens_of_a_wrong_shape_raises():
    camera = make_camera(size=96)
    observation = {
        keys.rgb("front"): torch.zeros(1, 3, 96, 96),
        keys.intrinsics("front"): torch.from_numpy(camera.intrinsics),
        keys.world_from_cam("front"): torch.from_numpy(camera.world_from_cam),
        keys.distortion("front"): torch.zeros(1, 5),
    }
    step = ViewsProcessorStep(views=OPTIONS[1:], camera="front", gripper=[])
    with pytest.raises(CalibrationError, match=r"distortion has shape \(1, 5\), expected one of"):
        step.observation(observation)


@pytest.mark.parametrize("method", ["voxel_equi", "point_cloud_equi"])
def test_policies_of_points_train_with_a_lens_and_keep_it(method):
    policy = make_policy(method=method)
    batch = training_batch(policy.config)
    key = keys.distortion(policy.config.camera)
    lens = torch.from_numpy(LENSES["webcam"].stored()).float().expand(4, -1)
    seen, plain = policy.scene.form(batch | {key: lens})[0], policy.scene.form(batch)[0]
    assert not torch.equal(seen, plain)
    assert torch.equal(policy.scene.form(batch | {key: torch.zeros(4, 9)})[0], plain)
    loss, _ = policy.forward(batch | {key: lens})
    assert loss.isfinite()
    stored = ObservationCodec(policy.scene).pack(batch | {key: lens})
    np.testing.assert_array_equal(stored[0][key], lens[0].numpy())
    with pytest.raises(Exception, match="a policy is exported for one lens"):
        export_policy(policy, batch | {key: lens})
