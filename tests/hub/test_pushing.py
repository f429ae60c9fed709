"""Pushing datasets and policies to the Hub and loading them again, over HTTP; and the errors when that fails."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from huggingface_hub import DatasetCard, ModelCard, create_repo, upload_folder
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.scripts import lerobot_eval, lerobot_train

from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.processor_views import ViewsProcessorStep
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset, push_dataset
from lerobot_symview.runtime.cli import CommandError
from symview_sim.generate import GenerateConfig, generate
from symview_sim.settings import NewDataset
from tests.conftest import VIEW_SIZE
from tests.helpers.training import train
from tests.hub.client import online
from tests.hub.server import ALICE, BOB, HubServer

pytestmark = pytest.mark.long

STOCK = {  # the smallest networks
    "act": ["--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32"]
    + ["--policy.pretrained_backbone_weights=null"],
    "diffusion": ["--policy.horizon=8", "--policy.n_action_steps=4", "--policy.drop_n_last_frames=3"]
    + ["--policy.down_dims=[16,32]", "--policy.num_train_timesteps=4"]
    + ["--policy.pretrained_backbone_weights=null"],
}


@pytest.fixture
def hub():
    with HubServer() as server, online(server, ALICE):
        yield server


@pytest.fixture
def target(recorded, tmp_path):
    """A local dataset that the user alice may push."""
    folder = shutil.copytree(recorded, tmp_path / "recorded")
    return HubDataset("alice/picking", folder)


def local_files(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_generated_dataset_is_pushed_and_loaded(hub, tmp_path):
    dataset = NewDataset("alice/new", tmp_path / "new", push_to_hub=True, tags=["mine"])
    folder = generate(GenerateConfig(dataset, num_episodes=1))
    assert {name: hub.files("alice/new")[name] for name in local_files(folder)} == local_files(folder)
    pulled, local = LeRobotDataset("alice/new"), LeRobotDataset("alice/new", root=folder)
    assert pulled.root != folder
    assert torch.equal(pulled[3]["action"], local[3]["action"])
    assert torch.equal(pulled[3]["observation.images.side"], local[3]["observation.images.side"])
    card = DatasetCard(hub.files("alice/new")["README.md"].decode())
    assert {"LeRobot", "symview", "mine"} <= set(card.data.tags)
    for fact in ("block_picking", "panda", "`observation.images.side`", "45 degrees", "100.0 %", "K in pixels"):
        assert fact in card.text
    assert hub.files("alice/new")["meta/symview_image.png"].startswith(b"\x89PNG")


def test_views_are_pushed_to_a_private_branch_with_their_parameters(hub, target, tmp_path):
    pushed = replace(target, push_to_hub=True, private=True, branch="small")
    add_views(AddViewsConfig(pushed, new_repo_id="alice/views", new_root=tmp_path / "views", size=76, keep=[]))
    assert hub.repos["dataset", "alice/views"].private
    assert ("dataset", "alice/picking") not in hub.repos
    text = hub.files("alice/views", revision="small")["README.md"].decode()
    assert "view `reproj` made from camera `side` (size=76, infill=nearest" in text
    assert "--policy.method=reproj_equi" in text
    assert LeRobotDataset("alice/views", revision="small").meta.total_episodes == 2
    with online(hub, BOB), pytest.raises(Exception, match=r"404|not found|Not Found"):
        LeRobotDataset("alice/views", revision="small")


def test_a_broken_upload_is_resumed(hub, target):
    before = local_files(target.folder())
    hub.fail_uploads_after = 1
    with pytest.raises(CommandError, match=r"upload was interrupted.*Nothing is lost.*--resume=true"):
        push_dataset(target, target)
    assert before.items() <= local_files(target.folder()).items()
    hub.fail_uploads_after = None
    push_dataset(target, target)
    assert len(hub.lfs_uploads) == len(set(hub.lfs_uploads)) > 1
    assert local_files(target.folder()).items() <= hub.files("alice/picking").items()


@pytest.mark.parametrize(
    ("token", "message"),
    [
        ("hf_unknown", "the Hub rejects the token: run `hf auth login` again"),
        (BOB, "has no write access to alice/picking: set --dataset.repo_id to a repository of yours"),
        (None, "`hf auth login`"),
    ],
)
def test_a_refused_push_names_the_remedy(token, message, hub, target):
    with online(hub, token), pytest.raises(CommandError, match=message) as error:
        push_dataset(target, target)
    assert "Nothing is lost" in str(error.value)


def test_a_push_without_a_network_is_an_error(target, monkeypatch):
    with pytest.raises(CommandError, match="HF_HUB_OFFLINE=1 blocks the upload of alice/picking to the Hub: unset it"):
        push_dataset(target, target)
    with HubServer() as stopped, online(stopped, ALICE):
        stopped.__exit__(None, None, None)
        with pytest.raises(CommandError, match="the Hub cannot be reached"):
            push_dataset(target, target)


def test_lerobot_pushes_a_policy_and_evaluates_it_by_name(hub, with_views, tmp_path, monkeypatch):
    options = ("--policy.push_to_hub=true", "--policy.repo_id=alice/picker", "--policy.tags=[mine]")
    checkpoint = train(monkeypatch, with_views, tmp_path / "policy", *options)
    card = ModelCard(hub.files("alice/picker", kind="model")["README.md"].decode())
    assert card.data.datasets == ["test/recorded"]
    assert {"symview", "symview_bc", "mine"} <= set(card.data.tags)
    for fact in ("method `reproj_equi`", "group D4", "x, y, z, yaw, aperture", "steps 2", "episodes 2", "## Limits"):
        assert fact in card.text
    pulled, local = SymviewBcPolicy.from_pretrained("alice/picker"), SymviewBcPolicy.from_pretrained(checkpoint)
    assert all(mine.equal(other) for mine, other in zip(local.parameters(), pulled.parameters(), strict=True))
    steps = make_pre_post_processors(pulled.config, "alice/picker")[0].steps
    assert [type(step).__name__ for step in steps].count("ViewsProcessorStep") == 1
    arguments = ["lerobot-eval", "--policy.path=alice/picker", "--policy.device=cpu", "--env.type=symview"]
    arguments += [
        "--env.max_steps=2",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    lerobot_eval.main()
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 1


def test_lerobot_train_pulls_a_dataset_by_name(target, tmp_path):
    """In its own process, as a user runs it: LeRobot pulls the dataset and discovers the installed plugin."""
    with HubServer() as hub:
        with online(hub, ALICE):
            push_dataset(target, target)
        program = shutil.which("lerobot-train", path=os.path.dirname(sys.executable))
        command = [program, "--dataset.repo_id=alice/picking", "--policy.type=symview_bc", "--policy.width=16"]
        command += ["--policy.crop_size=64", "--policy.device=cpu", "--policy.push_to_hub=false", "--steps=1"]
        command += ["--batch_size=2", "--num_workers=0", "--env_eval_freq=0", f"--output_dir={tmp_path / 'out'}"]
        home = {"HF_HOME": str(tmp_path / "home"), "HF_LEROBOT_HOME": str(tmp_path / "home" / "lerobot")}
        done = subprocess.run(command, env=os.environ | hub.environment(ALICE) | home, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "out" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()


@pytest.mark.parametrize(("policy", "options"), STOCK.items())
def test_a_stock_policy_loads_its_view_in_another_process(policy, options, recorded, tmp_path, monkeypatch):
    """A stock policy trained on a view, with our step in its preprocessor, is evaluated from the Hub."""
    config = AddViewsConfig(
        HubDataset("test/recorded", recorded),
        new_root=tmp_path / "stock",
        views=["reproj"],
        size=VIEW_SIZE,
        for_stock_policies=True,
    )
    arguments = ["lerobot-train", "--dataset.repo_id=test/stock", f"--dataset.root={add_views(config)}"]
    arguments += [f"--policy.type={policy}", "--policy.push_to_hub=false", "--policy.device=cpu", *options]
    arguments += ["--steps=1", "--batch_size=2", "--num_workers=0", "--env_eval_freq=0", f"--output_dir={tmp_path}/run"]
    monkeypatch.setattr(sys, "argv", arguments)
    lerobot_train.main()
    checkpoint = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    preprocessor = make_pre_post_processors(PreTrainedConfig.from_pretrained(checkpoint), str(checkpoint))[0]
    step = ViewsProcessorStep(views=[{"name": "reproj", "size": VIEW_SIZE, "height": False}])
    preprocessor.steps.insert(-1, step)  # before the normalisation
    preprocessor.save_pretrained(checkpoint)
    same_name = json.dumps({"observation.images.side": "observation.images.side"})
    evaluation = ["--env.type=symview", "--env.max_steps=2", "--eval.n_episodes=1", "--eval.batch_size=1"]
    evaluation += ["--policy.device=cpu", f"--rename_map={same_name}", f"--output_dir={tmp_path / 'eval'}"]
    with HubServer() as hub:
        with online(hub, ALICE):
            create_repo("alice/stock")
            upload_folder(repo_id="alice/stock", folder_path=checkpoint)
        program = shutil.which("lerobot-eval", path=os.path.dirname(sys.executable))
        home = {"HF_HOME": str(tmp_path / "home"), "HF_LEROBOT_HOME": str(tmp_path / "home" / "lerobot")}
        command = [program, "--policy.path=alice/stock", *evaluation]
        done = subprocess.run(command, env=os.environ | hub.environment(ALICE) | home, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 1
