"""Exported and traced policies against the policies themselves."""

import io

import onnxruntime
import pytest
import torch

from lerobot_policy_symview.equivariance import assert_equivariant, example_observation
from lerobot_policy_symview.export import PolicyModule, export_onnx, export_policy
from lerobot_policy_symview.nn.encoders.point_cloud import SetAbstraction
from lerobot_symview import keys
from tests.helpers.policies import make_actor, make_policy

pytestmark = pytest.mark.long

POLICIES = {
    "equivariant": lambda: make_policy(weight_averaging=0.9),
    "plain": lambda: make_actor(method="sideview_nonequi"),
}
FIXED_SIZE = pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning")  # of decisions by the images' size


@pytest.fixture(params=POLICIES)
def policy(request):
    return with_biases(POLICIES[request.param]())


def with_biases(policy):
    """Give all biases, which are initialised with zeros, other values."""
    for name, parameter in policy.named_parameters():
        if name.endswith("bias"):
            torch.nn.init.normal_(parameter, std=0.1)
    return policy


def inputs(policy, batch=2):
    observation = example_observation(policy.config, batch=batch)
    return {key: observation[key] for key in policy.scene.keys}


def assert_same_policy(exported, policy, monkeypatch):
    """Compare actions for batches of different size, and check the equivariance of the exported policy."""
    for batch in (1, 2, 3):
        observation = inputs(policy, batch)
        torch.testing.assert_close(exported(observation), policy.select_action(observation), rtol=0, atol=1e-5)
    if policy.config.group == "D4":
        with monkeypatch.context() as patch:
            patch.setattr(policy, "select_action", lambda batch: exported({key: batch[key] for key in observation}))
            assert_equivariant(policy)


def onnx_policy(policy, folder):
    """The policy as a function that runs its ONNX model."""
    file = folder / "policy.onnx"
    export_onnx(policy, example_observation(policy.config), file)
    assert [path.name for path in folder.iterdir()] == ["policy.onnx"]
    session = onnxruntime.InferenceSession(file)
    assert [feature.name for feature in session.get_inputs()] == policy.scene.keys
    assert [output.name for output in session.get_outputs()] == ["action"]

    def run(observation):
        (action,) = session.run(None, {key: values.numpy() for key, values in observation.items()})
        return torch.from_numpy(action)

    return run


def test_onnx_models_match_the_policy(policy, tmp_path, monkeypatch):
    assert_same_policy(onnx_policy(policy, tmp_path), policy, monkeypatch)


@FIXED_SIZE
def test_traced_policies_match_the_policy(policy, tmp_path, monkeypatch):
    torch.jit.trace(PolicyModule(policy), (inputs(policy),)).save(tmp_path / "policy.pt")
    assert_same_policy(torch.jit.load(tmp_path / "policy.pt"), policy, monkeypatch)


def test_exported_programs_match_the_policy(monkeypatch):
    policy = with_biases(make_actor())
    program = export_policy(policy, example_observation(policy.config, batch=1))
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    buffer.seek(0)
    assert_same_policy(torch.export.load(buffer).module(), policy, monkeypatch)


def test_strictly_exported_programs_match_the_policy(monkeypatch):
    policy = with_biases(make_policy())
    module, example = PolicyModule(policy), inputs(policy)
    sizes = {key: {0: torch.export.Dim("batch")} for key in example}
    program = torch.export.export(module, (example,), dynamic_shapes=(sizes,), strict=True)
    assert_same_policy(program.module(), policy, monkeypatch)


@FIXED_SIZE
@pytest.mark.parametrize(
    ("method", "distortion"),
    [
        ("persp_equi_broken", []),
        ("sideview_plucker", [-0.1, 0.02, 0.001, 0.0]),
        ("voxel_equi", [-0.1, 0.02, 0.0, 0.001]),
    ],
)
def test_a_configured_calibration_is_part_of_the_policy(method, distortion):
    """Recorded before the policy has run: what is recorded of a lens must not stay in the policy."""
    observation = example_observation(make_policy(method=method).config)
    names = keys.calibration("side")
    k, pose = (observation.pop(name)[0] for name in keys.calibration("side", ()))
    height, width = observation[keys.rgb("side")].shape[-2:] if keys.rgb("side") in observation else (480, 640)
    side = {
        "width": width,
        "height": height,
        "intrinsics": k.view(3, 3).tolist(),
        "world_from_cam": pose.view(4, 4).tolist(),
        "distortion": distortion,
    }
    policy = with_biases(make_policy(method=method, calibration={"units": "m", "cameras": {"side": side}}))
    observation = {key: values for key, values in observation.items() if key in policy.scene.keys}
    program = export_policy(policy, observation)
    (example,), _ = program.example_inputs
    assert not set(names) & set(example)
    traced = torch.jit.trace(PolicyModule(policy), (example,))
    for again in (program.module(), traced):
        torch.testing.assert_close(again(example), policy.select_action(example), rtol=0, atol=1e-5)


@FIXED_SIZE
@pytest.mark.parametrize("method", ["voxel_equi", "point_cloud_equi"])
def test_policies_on_points_are_exported_and_traced(method, monkeypatch):
    policy = with_biases(make_policy(method=method))
    for module in policy.modules():
        if isinstance(module, SetAbstraction):
            module.centers = 17  # each is an iteration, which an export unrolls
    traced = torch.jit.trace(PolicyModule(policy), (inputs(policy),))
    exported = export_policy(policy, inputs(policy)).module()
    for again in (traced, exported):
        assert_same_policy(again, policy, monkeypatch)


def test_onnx_models_of_voxels_match_the_policy(tmp_path, monkeypatch):
    policy = with_biases(make_policy(method="voxel_equi"))
    assert_same_policy(onnx_policy(policy, tmp_path), policy, monkeypatch)
