"""A policy's processor file must not import modules or call functions."""

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
from tests.malicious.files import change_json, load_with_processors


def add_step(folder, step, name="policy_preprocessor.json"):
    steps = json.loads((folder / name).read_text())["steps"]
    change_json(folder / name, steps=[step, *steps])


@pytest.fixture
def foreign_step(tmp_path, monkeypatch):
    """A module on the import path that creates a file when it is imported."""
    code = f"from pathlib import Path\nPath({str(tmp_path / 'run')!r}).touch()\ndef Step(): return None\n"
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "foreign_steps.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    yield "foreign_steps.Step"
    sys.modules.pop("foreign_steps", None)


@pytest.mark.parametrize("name", ["policy_preprocessor.json", "policy_postprocessor.json"])
def test_a_processor_file_cannot_import_a_module(checkpoint, foreign_step, tmp_path, name):
    add_step(checkpoint, {"class": foreign_step}, name)
    with pytest.raises((ImportError, ValueError), match="foreign_steps"):
        load_with_processors(checkpoint)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("function", "options"),
    [
        ("os.system", {"command": "touch RUN"}),
        ("subprocess.check_call", {"args": ["touch", "RUN"]}),
        ("builtins.open", {"file": "RUN", "mode": "w"}),
    ],
)
def test_a_processor_file_cannot_call_a_function(checkpoint, tmp_path, function, options):
    config = json.loads(json.dumps(options).replace("RUN", str(tmp_path / "run")))
    add_step(checkpoint, {"class": function, "config": config})
    with pytest.raises((ImportError, ValueError), match=function):
        load_with_processors(checkpoint)
    assert not (tmp_path / "run").exists()


def test_processors_without_a_policy_cannot_import_a_module(checkpoint, foreign_step, tmp_path):
    """A robot's own program may load them before the policy, or without it."""
    add_step(checkpoint, {"class": foreign_step})
    with pytest.raises((ImportError, ValueError), match="foreign_steps"):
        make_pre_post_processors(make_config(), str(checkpoint))
    assert not (tmp_path / "run").exists()


def test_a_registered_step_cannot_run_code_from_the_hub(checkpoint, monkeypatch):
    """LeRobot's `action_tokenizer_processor` would run code of the repository that its configuration names."""
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
def test_the_state_file_of_a_step_must_be_inside_the_policy(checkpoint, tmp_path, file):
    shutil.copy(checkpoint / "model.safetensors", tmp_path / "weights.safetensors")
    state_file = file.replace("WEIGHTS", str(tmp_path / "weights.safetensors"))
    add_step(checkpoint, {"registry_name": "device_processor", "config": {"device": "cpu"}, "state_file": state_file})
    with pytest.raises(ValueError, match="state_file"):
        load_with_processors(checkpoint)


def test_a_processor_file_cannot_request_huge_views(checkpoint):
    add_step(checkpoint, {"registry_name": "symview_views", "config": {"views": [{"name": "persp", "size": 10**6}]}})
    with pytest.raises(ValueError, match="size must"):
        load_with_processors(checkpoint)


@pytest.mark.parametrize("views", [{"persp": {"size": 76}}, "persp", 3])
def test_views_that_are_no_list_are_refused(checkpoint, views):
    add_step(checkpoint, {"registry_name": "symview_views", "config": {"views": views}})
    with pytest.raises(ValueError, match="views must be a list of names or mappings"):
        load_with_processors(checkpoint)


@pytest.mark.parametrize("kind", [SymviewBcConfig, SymviewSacfdConfig])
def test_our_processors_use_registered_steps_only(kind):
    for pipeline in make_processors(make_config(kind)):
        for step in pipeline.get_config()["steps"]:
            assert "class" not in step
            assert step["registry_name"] in ProcessorStepRegistry.list()
