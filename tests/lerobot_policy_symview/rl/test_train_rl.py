"""`symview-train-rl` end to end: training, interruption, resumption, and its checkpoints in LeRobot's commands."""

import json
import os
import signal
import sys
from dataclasses import replace

import pytest
import torch
from lerobot.configs.default import WandBConfig
from lerobot.scripts import lerobot_eval
from safetensors.torch import load_file

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.equivariance import assert_equivariant
from lerobot_policy_symview.methods import METHODS
from lerobot_policy_symview.modeling_symview_sacfd import SymviewSacfdPolicy
from lerobot_policy_symview.rl import train_rl as command
from lerobot_policy_symview.rl.checkpoints import cpu_seconds
from lerobot_policy_symview.rl.demonstrations import open_dataset, rewards_and_ends
from lerobot_policy_symview.rl.learner import WEIGHTS
from lerobot_policy_symview.rl.metrics import read_table
from lerobot_policy_symview.rl.replay import ReplayConfig
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_policy_symview.rl.train_rl import train_rl
from lerobot_policy_symview.rl.training import Training
from lerobot_symview import keys
from lerobot_symview.errors import DivergenceError, SymviewError
from lerobot_symview.geometry.placement import CameraSpec
from lerobot_symview.runtime.flag_errors import FlagError
from lerobot_symview.runtime.locking import RUN_LOCK, locked
from symview_sim.settings import EnvSettings, RecordedDataset
from tests.helpers.datasets import contents
from tests.helpers.training import train

pytestmark = pytest.mark.long


def make_config(recorded, folder, **options):
    policy = SymviewSacfdConfig(device="cpu", width=16, crop_size=64, **options.pop("policy", {}))
    defaults = {"steps": 6, "batch_size": 8, "num_simulators": 2, "eval_every": 3, "eval_episodes": 3, "log_every": 2}
    config = TrainRlConfig(
        dataset=RecordedDataset("test/recorded", recorded),
        env=options.pop("env", EnvSettings(max_steps=4)),
        policy=policy,
        output_dir=folder,
        save_every=100,
    )
    return replace(config, **defaults | options)


def state_of(checkpoint):
    """Return everything in a checkpoint that another run of the same seed must have bit-identically."""
    weights = load_file(checkpoint / "pretrained_model" / "model.safetensors")
    weights |= {f"learner.{name}": value for name, value in load_file(checkpoint / "training_state" / WEIGHTS).items()}
    for name in ("actor", "critic", "temperature"):
        optimizer = load_file(checkpoint / "training_state" / name / "optimizer_state.safetensors")
        weights |= {f"{name}.{key}": value for key, value in optimizer.items()}
    state = json.loads((checkpoint / "training_state" / "state.json").read_text())
    return weights, {name: value for name, value in state.items() if name != "cpu_s"}


def assert_same_run(one, other):
    (weights, state), (other_weights, other_state) = state_of(one), state_of(other)
    assert weights.keys() == other_weights.keys()
    assert [name for name in weights if not torch.equal(weights[name], other_weights[name])] == []
    assert json.dumps(state) == json.dumps(other_state)  # as text, since nan is not equal to itself
    for table in ("training.csv", "evaluation.csv"):
        assert (one.parent.parent / table).read_bytes() == (other.parent.parent / table).read_bytes()


@pytest.fixture(scope="module")
def whole(recorded, tmp_path_factory):
    """An uninterrupted run."""
    return train_rl(make_config(recorded, tmp_path_factory.mktemp("rl") / "whole"))


def test_a_run_writes_metrics_and_a_policy(whole):
    folder = whole.parent.parent
    training, evaluation = read_table(folder / "training.csv"), read_table(folder / "evaluation.csv")
    assert [row["step"] for row in training] == [2, 4, 6]
    assert [row["step"] for row in evaluation] == [3, 6]
    assert sum(row["episodes"] for row in training) == 2  # of 4 actions, in 2 simulators
    assert all(row["critic_loss"] > 0 for row in training)
    assert (folder / "checkpoints" / "last").resolve() == whole
    assert_equivariant(SymviewSacfdPolicy.from_pretrained(whole / "pretrained_model"))


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_in_simulators(method, recorded, tmp_path):
    env = EnvSettings(max_steps=2, oracle=method == "oracle_equi")
    config = make_config(recorded, tmp_path, env=env, policy={"method": method}, batch_size=4)
    with Training(config, open_dataset(config.dataset)) as training:
        training.start()
        for _ in range(3):
            training.joint_step()
        assert training.window.updates == 3
        assert len(training.window.success) == 2
        assert set(training.replay.frames) == set(training.policy.scene.keys)


def test_lerobot_train_fits_the_actor_to_demonstrations(recorded, tmp_path, monkeypatch):
    options = ("--policy.type=symview_sacfd", "--policy.augmentation=o2")
    checkpoint = train(monkeypatch, recorded, tmp_path / "fitted", *options)
    assert SymviewSacfdPolicy.from_pretrained(checkpoint).config.augmentation == "o2"


def test_lerobot_eval_reproduces_the_evaluation_of_the_training(whole, recorded, monkeypatch, tmp_path):
    """The same policy on the same scenes has the same successes in LeRobot's own loop."""
    config = make_config(recorded, whole.parent.parent)
    with Training(config, open_dataset(config.dataset)) as training:
        training.policy.load_state_dict(SymviewSacfdPolicy.from_pretrained(whole / "pretrained_model").state_dict())
        evaluation = training.evaluate()
    argv = [
        "lerobot-eval", f"--policy.path={whole / 'pretrained_model'}", "--env.type=symview", "--env.max_steps=4",
        "--eval.n_episodes=3", "--eval.batch_size=1", f"--output_dir={tmp_path}", "--policy.device=cpu",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", argv)
    lerobot_eval.main()
    overall = json.loads((tmp_path / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == 3
    assert overall["pc_success"] / 100 == pytest.approx(evaluation.success_rate)


def test_a_resumed_run_is_bit_identical_to_the_uninterrupted_one(recorded, whole, tmp_path, monkeypatch):
    """Ctrl-C in the middle of an episode and of a metrics window; resumed twice."""
    real, steps, handler = Training.joint_step, [], signal.getsignal(signal.SIGINT)

    def joint_step(self):
        real(self)
        steps.append(self.step)
        if len(steps) in (3, 5):
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Training, "joint_step", joint_step)
    config = make_config(recorded, tmp_path / "stopped")
    with pytest.raises(KeyboardInterrupt):
        train_rl(config)
    with pytest.raises(KeyboardInterrupt):
        train_rl(replace(config, resume=True))
    last = train_rl(replace(config, resume=True))
    assert steps == [1, 2, 3, 4, 5, 6]
    assert_same_run(last, whole)
    kept = [folder.name for folder in last.parent.iterdir() if (folder / "training_state" / "replay").is_dir()]
    assert sorted(kept) == ["000006", "last"]
    spent = [cpu_seconds(last.parent / name) for name in ("000003", "000005", "000006")]
    assert 0 < spent[0] < spent[1] < spent[2]  # that of the runs before included
    assert signal.getsignal(signal.SIGINT) is handler  # Python's own, or none in a shell's background


def test_an_incomplete_checkpoint_is_ignored(recorded, whole, tmp_path, monkeypatch):
    """A run that is killed while it writes the second checkpoint resumes from the first."""
    config = make_config(recorded, tmp_path / "killed", save_every=2)
    real = command.save_checkpoint

    def save_checkpoint(training, run_id):
        if training.step == 4:
            monkeypatch.setattr(training.replay, "save", lambda folder: 1 / 0)
        return real(training, run_id)

    monkeypatch.setattr(command, "save_checkpoint", save_checkpoint)
    with pytest.raises(ZeroDivisionError):
        train_rl(config)
    monkeypatch.setattr(command, "save_checkpoint", real)
    assert_same_run(train_rl(replace(config, resume=True)), whole)


@pytest.mark.parametrize(
    ("spoilt", "step", "message"),
    [
        ("actor", 3, r"after step 3: the policy's action is not finite \(in .*\): its weights are not finite"),
        ("critic", 3, "after step 3: the critic's loss is not finite"),
        ("critic", 6, "after step 6: weights are not finite, in critic"),
    ],
)
def test_a_diverged_training_is_reported_and_the_last_checkpoint_kept(
    recorded, tmp_path, monkeypatch, spoilt, step, message
):
    real = Training.joint_step

    def joint_step(self):
        real(self)
        if self.step == step:
            network = {"actor": self.policy.network, "critic": self.learner.critic}[spoilt]
            next(network.parameters()).data.fill_(torch.nan)

    monkeypatch.setattr(Training, "joint_step", joint_step)
    config = make_config(recorded, tmp_path / "run", save_every=2, eval_every=100, eval_episodes=1)
    last = config.output_dir / "checkpoints" / f"{2 * ((step - 1) // 2):06d}"
    with pytest.raises(DivergenceError, match=rf"{message}.*; the last checkpoint is {last}: train again with a lower"):
        train_rl(config)
    assert sorted(path.name for path in last.parent.iterdir())[-2:] == [last.name, "last"]
    assert (last / "training_state" / "replay").is_dir()


def test_frames_on_disk_give_the_same_run(recorded, whole, tmp_path):
    config = make_config(recorded, tmp_path / "disk", replay=ReplayConfig(memory_limit_gb=0.0))
    checkpoint = train_rl(config)
    assert (config.output_dir / "replay").is_dir()
    assert_same_run(checkpoint, whole)


def test_a_simulator_that_dies_is_replaced_and_its_episode_counted_as_lost(recorded, tmp_path, monkeypatch, caplog):
    real = Training.joint_step

    def joint_step(self):
        if self.step == 2:
            os.kill(self.simulators.process_ids[1], signal.SIGKILL)
            while self.simulators.is_alive(1):
                pass
        real(self)

    monkeypatch.setattr(Training, "joint_step", joint_step)
    train_rl(make_config(recorded, tmp_path / "died"))
    rows = read_table(tmp_path / "died" / "training.csv")
    assert [row["lost_episodes"] for row in rows] == [0, 1, 0]
    assert sum(row["episodes"] for row in rows) == 1
    assert "simulator 1 died (exit code -9)" in caplog.text


@pytest.mark.parametrize("terminal", [False, True])
def test_time_outs_bootstrap_from_the_last_observation_unless_terminal(recorded, tmp_path, terminal):
    config = make_config(recorded, tmp_path, policy={"timeouts_are_terminal": terminal})
    with Training(config, open_dataset(config.dataset)) as training:
        training.start()
        before = len(training.replay)
        for _ in range(5):
            training.joint_step()
        replay = training.replay
        first = replay.slots - 2 * (config.steps + config.steps // 4 + 2)
        ends = replay.columns["terminal"][first : first + 6].tolist()
        acted = (replay.columns["priority"][first : first + 6] > 0).tolist()
        state = replay.frames[keys.STATE][first : first + 6]
    assert len(replay) == before + 10
    assert ends == [False, False, False, terminal, False, False]
    assert acted == [True] * 4 + ([True, False] if terminal else [False, True])
    assert abs(state[4] - state[0]).max() > 1e-3 or terminal


def test_the_replay_holds_the_demonstrations_as_recorded(recorded, tmp_path):
    config = make_config(recorded, tmp_path)
    dataset = open_dataset(config.dataset)
    reward, ends, succeeds = rewards_and_ends(dataset)
    assert reward.sum() == ends.sum() == succeeds.sum() == 2
    with Training(config, dataset) as training:
        training.start()
        assert len(training.replay) == len(dataset)
        columns, frames = training.replay.columns, training.replay.frames
        for index in (0, 3, len(dataset) - 1):
            assert (frames[keys.STATE][index] == dataset[index][keys.STATE].numpy()).all()
            physical = training.policy.physical(torch.from_numpy(columns["action"][index]))
            torch.testing.assert_close(physical, dataset[index][keys.ACTION], rtol=0, atol=1e-6)
        assert columns["terminal"][: len(dataset)].tolist() == ends.tolist()
        assert frames["observation.images.side_reproj"].shape[1:] == (3, 76, 76)


def test_views_of_the_dataset_and_of_simulators_are_bit_identical(with_views, tmp_path):
    """The dataset's first frame, made offline, is a simulator's first frame for the same seed."""
    from symview_sim.demonstration import episode_seed
    from symview_sim.simulators import Reset

    config = make_config(with_views, tmp_path)
    with Training(config, open_dataset(config.dataset)) as training:
        training.start()
        training.simulators.send(0, Reset(episode_seed(0, 0)))
        packed = training.pack(training.simulators.receive(0).observation)
        for name, image in packed.items():
            assert (training.replay.frames[name][0] == image).all()


def test_weights_and_biases_logs_the_metrics_offline(recorded, tmp_path):
    config = make_config(recorded, tmp_path / "run", wandb=WandBConfig(enable=True, mode="offline"))
    checkpoint = train_rl(config)
    (run,) = (tmp_path / "run" / "wandb").glob("offline-run-*/run-*.wandb")
    assert b"train/critic_loss" in run.read_bytes()
    assert json.loads((checkpoint / "training_state" / "state.json").read_text())["wandb_run_id"] in run.name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "already has a run: use --resume=true"),
        ({"resume": True, "seed": 3}, "started with other flags: --seed is 3, was 0"),
        ({"resume": True, "policy": {"learning_rate": 0.5}}, r"--policy.learning_rate is 0.5, was 0.001"),
    ],
    ids=str,
)
def test_an_output_folder_with_a_different_run_is_refused(recorded, whole, options, message):
    with pytest.raises(SymviewError, match=message):
        train_rl(make_config(recorded, whole.parent.parent, **options))


def test_a_second_run_is_refused_while_the_first_is_alive(recorded, whole):
    config = make_config(recorded, whole.parent.parent, resume=True)
    before = contents(config.output_dir)
    with (
        locked(config.output_dir / RUN_LOCK, config.output_dir, "--output_dir"),
        pytest.raises(SymviewError, match=rf"is being written by process {os.getpid()} on .*--output_dir"),
    ):
        train_rl(config)
    assert contents(config.output_dir) == before


def test_a_missing_checkpoint_and_a_missing_dataset_are_reported(recorded, tmp_path):
    with pytest.raises(SymviewError, match=r"no checkpoint in .* to resume from: leave out --resume=true"):
        train_rl(make_config(recorded, tmp_path / "empty", resume=True))
    with pytest.raises(SymviewError, match=r"--dataset: there is no LeRobot dataset in"):
        train_rl(make_config(tmp_path / "nowhere", tmp_path / "empty"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "--steps must be at least 1, got 0"),
        ({"seed": -1}, "--seed must not be negative"),
        ({"policy": {"method": "oracle_equi"}}, "needs the camera 'top': use --env.oracle=true"),
    ],
    ids=str,
)
def test_errors_name_the_invalid_flag(recorded, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        make_config(recorded, tmp_path, **options)


@pytest.mark.parametrize(
    ("env", "policy", "message"),
    [
        (EnvSettings(task="drawer_opening"), {}, "--env.task is 'drawer_opening', the dataset has 'block_picking'"),
        (EnvSettings(control="fine"), {}, "--env.control is 'fine', the dataset has 'coarse'"),
        (EnvSettings(camera=CameraSpec(elevation_deg=30)), {}, "--env.camera.elevation_deg is 30, the dataset has 45"),
        (EnvSettings(), {"camera": "left"}, "--policy.camera=left is not simulated; --env.camera.name is 'side'"),
    ],
    ids=str,
)
def test_demonstrations_of_a_different_scene_are_refused(recorded, tmp_path, env, policy, message):
    with pytest.raises(ValueError, match=message):
        train_rl(make_config(recorded, tmp_path, env=env, policy=policy))


@pytest.mark.parametrize(
    "options", [{"discount": 0.0}, {"target_tau": 1.5}, {"initial_temperature": 0.0}, {"target_interval": 0},
                {"bc_weight": -1.0}, {"target_update": "soft"}], ids=str,
)  # fmt: skip
def test_errors_name_the_invalid_policy_option(options):
    with pytest.raises(FlagError, match=f"--policy.{next(iter(options))}"):
        SymviewSacfdConfig(device="cpu", **options)


def test_the_command_reports_an_error_in_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["symview-train-rl", f"--dataset.root={tmp_path}", "--policy.method=reproj_equi"])
    with pytest.raises(SystemExit) as end:
        command.main()
    assert end.value.code == 1
    error = "symview-train-rl: error: --dataset: there is no LeRobot dataset in"
    assert capsys.readouterr().err.startswith(f"{error} {tmp_path}")
