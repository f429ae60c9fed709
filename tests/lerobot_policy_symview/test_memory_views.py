"""Views with memory: datasets in order, a running policy to the same bits, and what cannot have them."""

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_symview import SymviewEnvConfig, ViewsProcessorStep
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import add_views
from lerobot_symview.runtime.flag_errors import FlagError
from lerobot_symview.views import ViewSpec
from symview_sim.settings import EnvSettings
from symview_sim.simulators import Reset, SimulatorConfig, Simulators, Step
from tests.conftest import VIEW_SIZE
from tests.helpers.datasets import contents, images_of, views_config
from tests.helpers.training import train

VIEW = {"name": "reproj", "size": VIEW_SIZE, "memory": True, "age": True}
OUTPUTS = [keys.view("side", output) for output in ViewSpec.parse(VIEW).make().outputs]


@pytest.fixture(scope="module")
def remembered(recorded, tmp_path_factory):
    target = tmp_path_factory.mktemp("memory") / "remembered"
    return add_views(views_config(recorded, target, views=[VIEW], size=None))


@pytest.fixture(scope="module")
def frames(recorded):
    """The frames of both episodes as a policy's processor gets them."""
    dataset = LeRobotDataset("test/recorded", root=recorded, depth_output_unit="m")
    items = [dataset[index] for index in range(len(dataset))]
    batches = [{key: value[None] for key, value in item.items() if torch.is_tensor(value)} for item in items]
    return [[batch for batch in batches if batch["episode_index"] == episode] for episode in (0, 1)]


def test_a_processor_and_a_dataset_remember_the_same_bits(remembered, frames):
    stored = {key: images_of(remembered, key) for key in OUTPUTS}
    step, index = ViewsProcessorStep(views=[VIEW]), 0
    for episode in frames:
        step.reset()
        for frame in episode:
            made = step.observation(dict(frame))
            for key, images in stored.items():
                np.testing.assert_array_equal(made[key][0].numpy(), images[index], err_msg=key)
            index += 1
    ages = stored[OUTPUTS[-1]] * 255
    starts = [0, len(frames[0])]
    assert set(np.unique(ages[starts])) == {0.0, 255.0}
    assert ages[(ages > 0) & (ages < 254.5)].max() > 1.5


def test_a_batch_of_episodes_is_remembered_one_by_one(frames):
    step = ViewsProcessorStep(views=[VIEW])
    alone = [ViewsProcessorStep(views=[VIEW]) for _ in frames]
    for pair in zip(*frames, strict=False):
        together = {key: torch.cat([frame[key] for frame in pair]) for key in pair[0]}
        made = step.observation(together)
        for index, (one, frame) in enumerate(zip(alone, pair, strict=True)):
            single = one.observation(dict(frame))
            for key in OUTPUTS:
                assert torch.equal(made[key][index], single[key][0])


@pytest.mark.long
def test_processes_and_interruptions_change_nothing(recorded, remembered, tmp_path, monkeypatch):
    from lerobot_symview.datasets import derivation

    options = {"views": [VIEW], "size": None, "new_repo_id": "test/derived"}
    parallel = add_views(views_config(recorded, tmp_path / "parallel", num_workers=2, **options))
    monkeypatch.setattr(derivation, "PART_FRAMES", 1)  # a part for each episode

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(derivation, "finish", interrupt)
        with pytest.raises(KeyboardInterrupt):
            add_views(views_config(recorded, tmp_path / "resumed", **options))
    tables = sorted((tmp_path / "resumed.partial").rglob("file-*.parquet"))
    tables[1].unlink()
    resumed = add_views(views_config(recorded, tmp_path / "resumed", resume=True, **options))
    for key in OUTPUTS:
        np.testing.assert_array_equal(images_of(resumed, key), images_of(remembered, key))
    assert contents(parallel) == contents(remembered)


def test_simulators_remember_and_a_repeated_episode_is_the_same():
    settings = EnvSettings("block_pushing", max_steps=4)
    config = SimulatorConfig(settings, (*OUTPUTS, keys.STATE), (ViewSpec.parse(VIEW),))
    actions = [np.array([0.0, 0.0, -0.05, 0.0, 0.0], np.float32)] * 3

    def seen(*commands):
        for command in commands:
            one.send(0, command)
            outcome = one.receive(0)
        return outcome.observation

    with Simulators(config, 1) as one:
        stepped = seen(Reset(2), *(Step(action, None) for action in actions))
        repeated = seen(Reset(2, tuple(actions)))
        fresh = seen(Reset(2))
    for key in OUTPUTS:
        np.testing.assert_array_equal(stepped[key], repeated[key])
    assert (stepped[OUTPUTS[-1]] == 1).any()
    assert set(np.unique(fresh[OUTPUTS[-1]])) == {0, 255}


@pytest.mark.long
def test_a_policy_trains_on_remembered_views_and_remembers_until_its_reset(
    recorded, remembered, frames, tmp_path, monkeypatch
):
    with pytest.raises(ValueError, match="memory=true is made from the frames of an episode in order"):
        train(monkeypatch, recorded, tmp_path / "raw", "--policy.view={name: reproj, memory: true}")
    checkpoint = train(monkeypatch, remembered, tmp_path / "trained")
    config = PreTrainedConfig.from_pretrained(checkpoint)
    assert config.view.options["memory"]
    config.device = "cpu"
    policy = SymviewBcPolicy.from_pretrained(checkpoint, config=config)
    preprocessor, _ = make_pre_post_processors(policy.config, str(checkpoint))
    images = []
    for _ in range(2):
        policy.reset()  # as lerobot-eval does; it resets no processor
        images.append([preprocessor(dict(frame))[OUTPUTS[0]] for frame in frames[1][:4]])
    for first, second, stored in zip(*images, images_of(remembered, OUTPUTS[0])[len(frames[0]) :], strict=False):
        assert torch.equal(first, second)
        np.testing.assert_array_equal(first[0].numpy(), stored)


def test_environments_make_no_views_with_memory():
    with pytest.raises(FlagError, match="needs to know when an episode starts"):
        SymviewEnvConfig(views=[VIEW])
