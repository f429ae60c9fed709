import json

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.envs.utils import preprocess_observation

from lerobot_policy_symview.inputs.depth_reader import IN_METRES, delivered_units
from lerobot_policy_symview.processor_pipelines import make_processors
from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_policy_symview.rl.rollouts import simulator_config
from lerobot_symview import keys
from lerobot_symview.errors import CalibrationError
from lerobot_symview.geometry.camera import stored_camera
from lerobot_symview.geometry.units import UNIT_NAMES
from lerobot_symview.geometry.units import in_metres as in_metres_offline
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import VIEWS, Frame, ViewSpec, make_view
from lerobot_symview.views.reprojection import INFILLS
from symview_sim.demonstration import episode_seed
from symview_sim.settings import EnvSettings
from tests.conftest import VIEW_SIZE
from tests.helpers.policies import make_config

OPTIONS = [{"name": name, "size": VIEW_SIZE} for name in VIEWS]
REPROJ = {"name": "reproj", "size": VIEW_SIZE}


@pytest.fixture(scope="module")
def observed():
    """A batch of one observation, as lerobot-eval passes it to the processors: the first frame of the recording."""
    env = EnvSettings("block_picking").make()
    observation, _ = env.reset(seed=episode_seed(0, 0))
    env.close()
    batched = {
        key: {name: image[None] for name, image in value.items()} if isinstance(value, dict) else value[None]
        for key, value in observation.items()
    }
    return preprocess_observation(batched)


def test_online_and_offline_views_are_bit_identical(observed, with_views):
    online = ViewsProcessorStep(views=OPTIONS).observation(dict(observed))
    offline = LeRobotDataset("test/with_views", root=with_views, depth_output_unit="m")[0]
    for name in VIEWS:
        for output in make_view(name).outputs:
            key = keys.view("side", output)
            np.testing.assert_array_equal(online[key][0].numpy(), offline[key].numpy(), err_msg=key)


def in_metres(depth):
    return depth


def in_millimetres(depth):
    return np.rint(1000 * depth).astype(np.uint16)


def with_pixel_values(depth, values):
    changed = depth.copy()
    for start, value in enumerate(values):
        changed.reshape(-1)[start::31] = value
    return changed


def with_invalid_pixels(depth):
    return with_pixel_values(depth, [np.nan, -np.inf, 0.0, -0.5])


def with_far_pixels(depth):
    return with_pixel_values(depth, [np.inf, 12.0])


@pytest.mark.parametrize("convert_depth", [in_metres, in_millimetres, with_invalid_pixels, with_far_pixels])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        *(("reproj", {"infill": infill, "clip": clip}) for infill in INFILLS for clip in ("none", 0.05, "gripper")),
        *(("reproj", {"infill": infill, "source_scale": 2, "mask": True}) for infill in INFILLS),
        ("reproj", {"height": False, "mask": True, "clip_margin": 0.03, "clip_floor": 0.02}),
        ("persp", {"plane_height": "gripper"}),
        ("persp", {"plane_height": 0.03, "gripper": False}),
    ],
)
def test_step_and_view_are_bit_identical_for_all_options_and_depths(observed, name, options, convert_depth):
    view = make_view(name, size=VIEW_SIZE, **options)
    matrices = (observed[key("side")][0].numpy() for key in (keys.intrinsics, keys.world_from_cam))
    rgb = (observed[keys.rgb("side")][0] * 255).round().byte().permute(1, 2, 0).numpy()
    depth = convert_depth(observed[keys.depth("side")][0, 0].numpy())
    camera = stored_camera(*matrices, *depth.shape)
    offline = view.render(Frame(rgb, in_metres_offline(depth), camera, Workspace(), observed[keys.STATE][0].numpy()))
    observation = observed | {keys.depth("side"): torch.from_numpy(depth)[None, None]}
    online = ViewsProcessorStep(views=[{"name": name, "size": VIEW_SIZE} | options]).observation(observation)
    assert offline.keys() == view.outputs.keys()
    for output, image in offline.items():
        expected = image.transpose(2, 0, 1) / np.float32(255) if image.ndim == 3 else image[None]
        made = online[keys.view("side", output)][0].numpy()
        assert made.dtype == expected.dtype
        np.testing.assert_array_equal(made, expected, err_msg=output)
        assert made.any()


def test_present_views_are_kept_unchanged(observed):
    step = ViewsProcessorStep(views=["reproj"])
    first = step.observation(dict(observed))
    marked = first | {"observation.images.side_reproj": torch.zeros(1, 3, 4, 4)}
    assert step.observation(marked)["observation.images.side_reproj"].shape == (1, 3, 4, 4)


@pytest.mark.parametrize("missing", make_view("reproj").outputs)
def test_only_missing_outputs_of_a_view_are_added(observed, missing):
    step = ViewsProcessorStep(views=[REPROJ])
    own = step.observation(dict(observed))
    outputs = [keys.view("side", output) for output in make_view("reproj").outputs]
    marked = own | {key: torch.full_like(own[key], 0.5) for key in outputs}
    del marked[keys.view("side", missing)]
    made = step.observation(dict(marked))
    for key in outputs:
        assert torch.equal(made[key], marked.get(key, own[key])), key


def test_every_sample_of_a_batch_uses_its_own_calibration(observed):
    two = {key: torch.cat([value, value]) for key, value in observed.items()}
    pose = two[keys.world_from_cam("side")].clone().reshape(2, 4, 4)
    pose[1, 0, 3] += 0.1
    two[keys.world_from_cam("side")] = pose.reshape(2, 16)
    images = ViewsProcessorStep(views=OPTIONS).observation(two)["observation.images.side_persp"]
    alone = ViewsProcessorStep(views=OPTIONS).observation(dict(observed))["observation.images.side_persp"]
    assert torch.equal(images[:1], alone)
    assert not torch.equal(images[1:], alone)


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("square", [False, True])
def test_calibration_may_be_unbatched_or_square(observed, batch, square):
    """LeRobot adds a batch axis to images and states only."""
    several = {key: torch.cat([value] * batch) for key, value in observed.items()}
    expected = ViewsProcessorStep(views=OPTIONS).observation(dict(several))
    for count in ((), (batch,)):
        matrices = {
            key: several[key][0].reshape((side, side) if square else (side**2,)).expand(*count, *[-1] * (1 + square))
            for key, side in ((keys.intrinsics("side"), 3), (keys.world_from_cam("side"), 4))
        }
        made = ViewsProcessorStep(views=OPTIONS).observation(several | matrices)
        for name in VIEWS:
            for output in make_view(name).outputs:
                assert torch.equal(made[keys.view("side", output)], expected[keys.view("side", output)]), output


def test_calibration_of_a_wrong_shape_raises(observed):
    wrong = observed | {keys.intrinsics("side"): torch.eye(4)[None]}
    with pytest.raises(
        CalibrationError, match=r"side\.intrinsics has shape \(1, 4, 4\), expected one of \[\(9,\), \(3, 3\)"
    ):
        ViewsProcessorStep(views=OPTIONS).observation(wrong)


def test_colour_may_be_uint8(observed):
    key = keys.rgb("side")
    made, expected = (
        ViewsProcessorStep(views=OPTIONS).observation(observed | {key: image})
        for image in ((observed[key] * 255).round().to(torch.uint8), observed[key])
    )
    for name in VIEWS:
        for output in make_view(name).outputs:
            assert torch.equal(made[keys.view("side", output)], expected[keys.view("side", output)]), output


def test_views_are_rendered_on_the_cpu_for_devices_without_float64(observed, monkeypatch):
    class Mps(str):
        type = "mps"

    class MpsTensor(torch.Tensor):
        device = Mps("cpu")  # torch treats it as the CPU, our code as an Apple GPU

    def refuse(*_):
        raise AssertionError("float64 on an Apple GPU")

    monkeypatch.setattr("lerobot_symview.views.torch_backend.render_batch", refuse)
    key = keys.rgb("side")
    on_mps = observed | {key: observed[key].as_subclass(MpsTensor)}
    made, expected = (ViewsProcessorStep(views=OPTIONS).observation(batch) for batch in (on_mps, dict(observed)))
    assert torch.equal(made[keys.view("side", "reproj")], expected[keys.view("side", "reproj")])


def test_the_step_is_rebuilt_from_its_configuration(observed):
    step = ViewsProcessorStep(views=OPTIONS, workspace={"center": [0.45, 0.0], "size": 0.3, "height_limit": 0.2})
    again = ViewsProcessorStep(**step.get_config())
    key = "observation.images.side_reproj"
    assert torch.equal(again.observation(dict(observed))[key], step.observation(dict(observed))[key])


def reordered(observed):
    """The same frame with the state's dimensions in another order, and their declaration."""
    dimensions = ["aperture", "yaw", "scalar", "y", "z", "x"]
    named = dict(zip(keys.STATE_NAMES, observed[keys.STATE][0], strict=True)) | {"scalar": torch.tensor(9.0)}
    return observed | {keys.STATE: torch.stack([named[label] for label in dimensions])[None]}, dimensions


@pytest.mark.parametrize("method", ["reproj_equi", "persp_equi"])
def test_order_of_the_state_does_not_change_the_view(observed, method):
    state, dimensions = reordered(observed)
    view = ViewSpec("persp", {"plane_height": "gripper"}) if method == "persp_equi" else ViewSpec("reproj")
    usual = make_config(method=method, view=view)
    expected = make_processors(usual)[0](dict(observed))
    config = make_config(method=method, view=view, state_symmetry=dimensions)
    reordered_view = make_processors(config)[0](dict(state))
    for key in filter(None, (config.color_key, config.height_key if method == "reproj_equi" else None)):
        assert torch.equal(reordered_view[key], expected[key]), key


def test_view_that_uses_the_gripper_raises_if_the_state_has_none(observed):
    options = {"state_symmetry": ["x", "y", "scalar", "sign", "scalar"], "gripper_input": "vector"}
    with pytest.raises(ValueError, match=r"--policy.state_symmetry=.* lacks z, yaw: .*clip: none"):
        make_processors(make_config(**options))
    config = make_config(**options, view=ViewSpec("reproj", {"clip": "none"}))
    assert config.color_key in make_processors(config)[0](dict(observed))


def test_simulator_raises_if_the_declared_state_is_not_its_own(observed):
    _, dimensions = reordered(observed)
    assert simulator_config(make_config(), EnvSettings("block_picking")).names
    dimensions.remove("scalar")
    with pytest.raises(ValueError, match=r"--policy.state_symmetry=.* which is \[x, y, z, yaw, aperture\]"):
        simulator_config(make_config(state_symmetry=dimensions), EnvSettings("block_picking"))


def test_missing_input_error_names_the_key(observed):
    without = {key: value for key, value in observed.items() if "intrinsics" not in key}
    with pytest.raises(KeyError, match=r"observation\.camera\.side\.intrinsics.*--policy.camera.*--rename_map"):
        ViewsProcessorStep(views=OPTIONS).observation(without)


DEPTH, HEIGHT = keys.depth("side"), keys.view("side", "reproj_height")


def metres(key, values, **units):
    made = ViewsProcessorStep(depth_units=units.get("units", {})).observation({key: values})
    assert IN_METRES in made
    return made[key]


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf, 12.0, -12.0, 0.0])
def test_invalid_pixel_does_not_change_the_inferred_depth_unit(wrong):
    depth = torch.tensor([0.0, 0.8, 1.2, wrong])
    torch.testing.assert_close(metres(DEPTH, depth), depth, equal_nan=True)
    torch.testing.assert_close(metres(DEPTH, depth * 1000), depth, equal_nan=True)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf, 0.0])
def test_highest_value_decides_the_inferred_height_unit(wrong):
    heights = torch.tensor([0.0, 0.0, 0.0, 0.001, 0.03, wrong])
    torch.testing.assert_close(metres(HEIGHT, heights), heights, equal_nan=True)
    torch.testing.assert_close(metres(HEIGHT, heights * 1000), heights, equal_nan=True)


@pytest.mark.parametrize("key", [DEPTH, HEIGHT])
def test_declared_unit_takes_precedence_over_the_values(key, caplog):
    low = torch.tensor([0.0, 1.0, 9.0])  # millimetres of a nearly bare table
    torch.testing.assert_close(metres(key, low, units={key: "mm"}), low / 1000)
    far = torch.tensor([20.0, 30.0])
    torch.testing.assert_close(metres(key, far, units={key: "m"}), far)
    assert not caplog.messages


def test_inferred_unit_is_logged_once(caplog):
    caplog.set_level("INFO")
    step = ViewsProcessorStep()
    for _ in range(2):
        step.observation({DEPTH: torch.tensor([800.0])})
    assert caplog.messages == [f"{DEPTH} declares no unit: its values are taken to be millimetres"]


def test_depth_is_converted_once():
    step = ViewsProcessorStep(depth_units={DEPTH: "mm"})
    first = step.observation({DEPTH: torch.tensor([800.0])})
    assert torch.equal(step.observation(dict(first))[DEPTH], first[DEPTH])


@pytest.mark.parametrize("output_unit", ["m", "mm"])
def test_delivered_units_match_lerobots_loader(with_views, output_unit):
    dataset = LeRobotDataset("test/with_views", root=with_views, depth_output_unit=output_unit)
    units = delivered_units(dataset.meta)
    assert units[DEPTH] == units[HEIGHT] == UNIT_NAMES[output_unit]
    made = metres(DEPTH, dataset[0][DEPTH][None], units=units)
    assert 0.3 < float(made.median()) < 2


@pytest.mark.parametrize("key", [DEPTH, HEIGHT])
@pytest.mark.parametrize("dtype", [torch.uint16, torch.int16, torch.int32])
def test_integers_are_millimetres(key, dtype):
    millimetres = np.array([0, 4, 5, 812], dtype=np.uint16)
    made = metres(key, torch.from_numpy(millimetres).to(dtype))
    assert made.dtype == torch.float32
    np.testing.assert_array_equal(made.numpy(), in_metres_offline(millimetres))


@pytest.mark.parametrize("key", [DEPTH, HEIGHT])
def test_empty_images_are_accepted(key):
    assert metres(key, torch.zeros(0, 1, 4, 4)).shape == (0, 1, 4, 4)


def test_views_of_a_robot_without_gripper_state_are_not_clipped(observed):
    step = ViewsProcessorStep(views=OPTIONS, gripper=[])
    without = {key: value for key, value in observed.items() if key != keys.STATE}
    made = step.observation(without)
    unclipped = ViewsProcessorStep(views=[REPROJ | {"clip": "none"}]).observation(dict(observed))
    assert torch.equal(made[keys.view("side", "reproj")], unclipped[keys.view("side", "reproj")])
    assert keys.view("side", "persp") in made
    assert keys.view("side", "persp_gripper") not in made


def test_integer_depth_of_a_camera_is_reprojected(observed):
    """LeRobot's `prepare_observation_for_inference` passes a RealSense's depth as integers."""
    key = keys.depth("side")
    millimetres = (observed[key] * 1000).round()
    step = ViewsProcessorStep(views=[REPROJ])
    made, expected = (
        step.observation(observed | {key: depth})
        for depth in (millimetres.to(torch.uint16), millimetres / torch.tensor(1000.0))
    )
    for output in make_view("reproj").outputs:
        assert torch.equal(made[keys.view("side", output)], expected[keys.view("side", output)]), output


def without_calibration(observed):
    return {key: value for key, value in observed.items() if not key.startswith("observation.camera.")}


def calibration_of(observed):
    matrices = {"intrinsics": (keys.intrinsics, 3), "world_from_cam": (keys.world_from_cam, 4)}
    side = {name: observed[key("side")][0].reshape(n, n).tolist() for name, (key, n) in matrices.items()}
    return {"units": "m", "cameras": {"side": {"height": 152, "width": 152, **side}}}


def test_configured_calibration_is_used_for_observations_without_one(observed):
    own = ViewsProcessorStep(views=OPTIONS).observation(dict(observed))
    step = ViewsProcessorStep(views=OPTIONS, calibration=json.loads(json.dumps(calibration_of(observed))))
    for key, image in ViewsProcessorStep(**step.get_config()).observation(without_calibration(observed)).items():
        assert torch.equal(image, own[key]), key


def test_observed_calibration_takes_precedence(observed):
    wrong = calibration_of(observed)
    wrong["cameras"]["side"]["intrinsics"][0][0] *= 2
    own = ViewsProcessorStep(views=OPTIONS).observation(dict(observed))
    step = ViewsProcessorStep(views=OPTIONS, calibration=wrong)
    key = keys.view("side", "persp")
    assert torch.equal(step.observation(dict(observed))[key], own[key])
    assert not torch.equal(step.observation(without_calibration(observed))[key], own[key])


def test_images_of_another_size_than_calibrated_raise(observed):
    step = ViewsProcessorStep(views=["persp"], calibration=calibration_of(observed))
    small = {key: value[..., ::2, ::2] if "images" in key else value for key, value in observed.items()}
    with pytest.raises(CalibrationError, match="calibrated for 152 x 152 pixels, the observation has 76 x 76"):
        step.observation(without_calibration(small))


def test_the_detail_of_the_camera_is_logged_once(observed, caplog):
    caplog.set_level("INFO")
    step = ViewsProcessorStep(views=[{"name": "reproj", "size": 32}])
    for _ in range(2):
        step.observation(dict(observed))
    assert caplog.text.count("it fills a view of 73 x 73 pixels, reproj has 32") == 1


@pytest.mark.parametrize("name", ["reproj", "persp"])
def test_a_view_that_turns_black_warns_once_or_raises(observed, name, caplog):
    """The first frame is right; then the lens is covered, or depth has no valid pixel."""
    views = [{"name": name, "size": 32}]
    dark = observed | {key: torch.zeros_like(observed[key]) for key in (keys.rgb("side"), keys.depth("side"))}
    step, strict = ViewsProcessorStep(views=views), ViewsProcessorStep(views=views, require_views=True)
    for each in (step, strict):
        each.observation(dict(observed))
    for _ in range(2):
        assert not step.observation(dict(dark))[keys.view("side", name)].any()
    assert caplog.text.count(f"the view '{name}' of camera 'side' is black") == 1
    with pytest.raises(CalibrationError, match=f"the view '{name}' of camera 'side' is black"):
        strict.observation(dict(dark))
    training = {"observation": dict(dark), "action": torch.zeros(1, 5)}
    assert not strict(training)["observation"][keys.view("side", name)].any()
