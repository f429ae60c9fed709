"""LeRobot's own loops around chunks: a training that is resumed, several processes, a robot, compiled networks."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.rollout.inference.sync import SyncInferenceEngine
from lerobot.scripts import lerobot_train
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features
from safetensors.torch import load_file

from lerobot_policy_symview.equivariance import assert_equivariant, example_observation
from lerobot_policy_symview.modeling_symview_flow import SymviewFlowPolicy
from lerobot_symview import keys
from tests.helpers.training import train
from tests.lerobot_policy_symview.test_modeling_symview_flow import chunk_batch, make_chunk_policy
from tests.lerobot_policy_symview.test_modeling_symview_flow import train as train_in_memory

pytestmark = pytest.mark.long

FLOW = ("--policy.type=symview_flow", "--policy.width=16", "--policy.crop_size=64", "--policy.denoiser_width=32")
CHECKPOINTS = ("000002", "000004")


@pytest.fixture
def samples(monkeypatch):
    """Indices of the frames of every training step, which determine the step's random numbers too.

    LeRobot restores the random numbers of a checkpoint; then the loader of the resumed run, which starts anew, draws
    one of them.
    """
    indices = []
    update = lerobot_train.update_policy

    def recorded(tracker, policy, batch, *arguments, **options):
        indices.append(batch["index"].tolist())
        torch.manual_seed(sum(indices[-1]))
        return update(tracker, policy, batch, *arguments, **options)

    monkeypatch.setattr(lerobot_train, "update_policy", recorded)
    return indices


def test_a_resumed_training_goes_on_with_the_same_samples_and_state(with_views, tmp_path, monkeypatch, samples):
    """Weights, averaged weights, Adam's moments and the schedule: the last checkpoints are bit-identical."""
    train(monkeypatch, with_views, tmp_path / "run", "--steps=4", "--save_freq=2", policy=FLOW)
    middle, last = (tmp_path / "run" / "checkpoints" / name / "pretrained_model" for name in CHECKPOINTS)
    half, whole = (load_file(folder / "model.safetensors") for folder in (middle, last))
    shutil.rmtree(last.parent)
    monkeypatch.setattr(
        sys, "argv", ["lerobot-train", f"--config_path={middle / 'train_config.json'}", "--resume=true"]
    )
    lerobot_train.main()
    resumed = load_file(last / "model.safetensors")
    assert samples[4:] == samples[2:4]
    assert not torch.equal(half["network.encoder.layers.0.weight"], whole["network.encoder.layers.0.weight"])
    torch.testing.assert_close(resumed, whole, rtol=0, atol=0)


@pytest.mark.slow
def test_two_processes_train_one_policy(with_views, tmp_path):
    """They average their gradients and one writes the checkpoint. `accelerate launch --cpu` would start one process."""
    launch = "-m torch.distributed.run --standalone --nproc_per_node=2"
    options = f"--policy.device=cpu --policy.push_to_hub=false --dataset.repo_id=test/views --dataset.root={with_views}"
    sizes = f"--steps=2 --batch_size=2 --num_workers=0 --env_eval_freq=0 --output_dir={tmp_path / 'run'}"
    command = f"{launch} -m lerobot.scripts.lerobot_train {options} {sizes}".split()
    done = subprocess.run(
        [sys.executable, *command, *FLOW],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "Effective batch size: 2 x 2 = 4" in done.stderr + done.stdout
    policy = SymviewFlowPolicy.from_pretrained(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")
    assert policy.state_dict()["network.head.denoiser.leave.weight"].abs().max() > 0  # zero before training
    assert_equivariant(policy)


def test_a_robot_carries_out_chunks_in_lerobots_rollout(with_views, tmp_path, monkeypatch):
    """LeRobot's inference engine: a chunk is predicted once in n_action_steps, from the last two observations."""
    options = ("--policy.method=persp_equi", "--policy.n_action_steps=3")
    checkpoint = train(monkeypatch, with_views, tmp_path / "run", *options, policy=FLOW)
    policy = SymviewFlowPolicy.from_pretrained(checkpoint).eval()
    before, after = make_pre_post_processors(policy.config, str(checkpoint))
    motors = dict.fromkeys(keys.STATE_NAMES, float)
    features = hw_to_dataset_features(motors | {"side": (152, 152, 3)}, "observation", use_video=False)
    features |= hw_to_dataset_features(dict.fromkeys(keys.ACTION_NAMES, float), "action", use_video=False)
    engine = SyncInferenceEngine(
        policy=policy,
        preprocessor=before,
        postprocessor=after,
        dataset_features=features,
        ordered_action_keys=keys.ACTION_NAMES,
        task="pick",
        device="cpu",
        robot_type="symview",
    )
    chunks = []
    predict = policy.predict_action_chunk

    def recorded(batch, **arguments):
        chunks.append((batch[keys.STATE].clone(), predict(batch, **arguments)))
        return chunks[-1][1]

    policy.predict_action_chunk = recorded
    engine.reset()
    rng = np.random.default_rng(0)
    states, actions = [], []
    for index in range(6):
        pose = [0.01 * index, 0.0, 0.15, 0.0, 1.0]
        image = {"side": rng.integers(256, size=(152, 152, 3), dtype=np.uint8)}
        observed = dict(zip(keys.STATE_NAMES, pose, strict=True)) | image
        actions.append(engine.get_action(build_dataset_frame(features, observed, prefix="observation")))
        states.append(torch.tensor(pose))
    assert len(chunks) == 2
    torch.testing.assert_close(chunks[1][0][0], torch.stack(states[2:4]))
    expected = torch.cat([chunk[0, :3] for _, chunk in chunks])
    torch.testing.assert_close(torch.stack(actions), expected)
    engine.reset()
    engine.get_action(build_dataset_frame(features, observed, prefix="observation"))
    assert len(chunks) == 3


@pytest.mark.filterwarnings("ignore:Dynamo detected a call")  # to cached functions that scipy's array checks call
@pytest.mark.parametrize("compiled", ["networks", "policy"])
def test_compiled_policies_predict_the_same_chunks(compiled):
    """Code for a CPU takes minutes to generate: in 96 s the default backend, inductor, gave the same chunks too.

    `lerobot-rollout --use_torch_compile=true` compiles the policy's `predict_action_chunk`.
    """
    policy = train_in_memory(make_chunk_policy(weight_averaging=0.9))
    observation, noise = example_observation(policy.config), policy.draw_noise(2)
    chunk = policy.predict_action_chunk(observation, noise=noise)
    if compiled == "policy":
        policy.predict_action_chunk = torch.compile(policy.predict_action_chunk, backend="aot_eager")
    else:
        for network in (policy.averaged.encoder, policy.averaged.head):
            network.compile(backend="aot_eager")
    torch.testing.assert_close(policy.predict_action_chunk(observation, noise=noise), chunk, rtol=1e-4, atol=1e-6)


def test_training_in_bfloat16_has_nearly_the_same_loss():
    losses = []
    for dtype in ("float32", "bfloat16"):
        policy = train_in_memory(make_chunk_policy(dtype=dtype))  # before the training the velocity is zero
        torch.manual_seed(0)
        with policy.precision():  # LeRobot takes it from the configuration
            loss, _ = policy.forward(chunk_batch(policy.config))
        loss.backward()
        assert all(parameter.grad.isfinite().all() for parameter in policy.network.parameters())
        losses.append(loss.item())
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
    assert losses[1] != losses[0]
