"""A processor file of a policy imports and calls nothing."""

import json
import shutil
import sys

import pytest
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import ProcessorStepRegistry, tokenizer_processor

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.processor_pipelines import make_processors
from tests.helpers.policies import make_config
from tests.hostile.files import change_json, load_with_processors


def add_step(folder, step, name="policy_preprocessor.json"):
    steps = json.loads((folder / name).read_text())["steps"]
    change_json(folder / name, steps=[step, *steps])


@pytest.fixture
def strange_step(tmp_path, monkeypatch):
    """A module that is on the path and not ours to import; it and its step leave a file."""
    code = f"from pathlib import Path\nPath({str(tmp_path / 'run')!r}).touch()\ndef Step(): return None\n"
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "strange_steps.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    yield "strange_steps.Step"
    sys.modules.pop("strange_steps", None)


@pytest.mark.parametrize("name", ["policy_preprocessor.json", "policy_postprocessor.json"])
def test_a_processor_file_imports_nothing(checkpoint, strange_step, tmp_path, name):
    add_step(checkpoint, {"class": strange_step}, name)
    with pytest.raises((ImportError, ValueError), match="strange_steps"):
        load_with_processors(checkpoint)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("called", "options"),
    [
        ("os.system", {"command": "touch RUN"}),
        ("subprocess.check_call", {"args": ["touch", "RUN"]}),
        ("builtins.open", {"file": "RUN", "mode": "w"}),
    ],
)
def test_a_processor_file_calls_nothing(checkpoint, tmp_path, called, options):
    config = json.loads(json.dumps(options).replace("RUN", str(tmp_path / "run")))
    add_step(checkpoint, {"class": called, "config": config})
    with pytest.raises((ImportError, ValueError), match=called):
        load_with_processors(checkpoint)
    assert not (tmp_path / "run").exists()


def test_processors_alone_import_nothing_either(checkpoint, strange_step, tmp_path):
    """As a robot's own program loads them, without or before the policy."""
    add_step(checkpoint, {"class": strange_step})
    with pytest.raises((ImportError, ValueError), match="strange_steps"):
        make_pre_post_processors(make_config(), str(checkpoint))
    assert not (tmp_path / "run").exists()


def test_a_registered_step_that_runs_code_from_the_hub_is_not_made(checkpoint, monkeypatch):
    """LeRobot's `action_tokenizer_processor` trusts what the repository that it is told to load brings along."""
    loaded = []

    class Recorder:
        @staticmethod
        def from_pretrained(name, **options):
            loaded.append((name, options))

    monkeypatch.setattr(tokenizer_processor, "_transformers_available", True)
    for name in ("AutoProcessor", "AutoTokenizer"):
        monkeypatch.setattr(tokenizer_processor, name, Recorder, raising=False)
    config = {"action_tokenizer_name": "stranger/code"}
    add_step(checkpoint, {"registry_name": "action_tokenizer_processor", "config": config})
    with pytest.raises((ImportError, ValueError), match="action_tokenizer_processor"):
        load_with_processors(checkpoint)
    assert not loaded


@pytest.mark.parametrize("file", ["../weights.safetensors", "WEIGHTS"])
def test_the_state_of_a_step_is_in_the_policys_folder(checkpoint, tmp_path, file):
    shutil.copy(checkpoint / "model.safetensors", tmp_path / "weights.safetensors")
    stated = file.replace("WEIGHTS", str(tmp_path / "weights.safetensors"))
    add_step(checkpoint, {"registry_name": "device_processor", "config": {"device": "cpu"}, "state_file": stated})
    with pytest.raises(ValueError, match="state_file"):
        load_with_processors(checkpoint)


def test_a_processor_file_makes_views_of_a_possible_size(checkpoint):
    add_step(checkpoint, {"registry_name": "symview_views", "config": {"views": {"persp": {"size": 10**6}}}})
    with pytest.raises(ValueError, match="size must"):
        load_with_processors(checkpoint)


@pytest.mark.parametrize("kind", [SymviewBcConfig, SymviewSacfdConfig])
def test_our_own_processors_name_registered_steps_only(kind):
    for pipeline in make_processors(make_config(kind)):
        for step in pipeline.get_config()["steps"]:
            assert "class" not in step
            assert step["registry_name"] in ProcessorStepRegistry.list()
