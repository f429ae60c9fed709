"""Pickle is never loaded: not from weights, replay buffers or calibrations."""

import ast
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import SafetensorError

from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_symview.calibration.read import read_calibration
from lerobot_symview.errors import SymviewError
from tests.malicious.files import saved_replay

ROOT = Path(__file__).parents[2]


class Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def test_our_code_never_loads_pickle():
    forbidden = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    calls = {"torch.load", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "pd.read_pickle", "eval", "exec"}
    for folder in ("lerobot_symview", "policies", "datasets_gen", "eval", "tools"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    modules = {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
                    assert not {module.split(".")[0] for module in modules} & forbidden, file
                elif isinstance(node, ast.Call):
                    assert ast.unparse(node.func) not in calls, f"{file}:{node.lineno}"
                    assert not any(keyword.arg == "allow_pickle" for keyword in node.keywords), f"{file}:{node.lineno}"


def test_pickled_weights_are_not_loaded(checkpoint, tmp_path):
    (checkpoint / "model.safetensors").write_bytes(pickle.dumps(Payload(tmp_path / "run")))
    with pytest.raises(SafetensorError):
        SymviewBcPolicy.from_pretrained(checkpoint)
    (checkpoint / "model.safetensors").unlink()
    torch.save(Payload(tmp_path / "run"), checkpoint / "pytorch_model.bin")
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors"):
        SymviewBcPolicy.from_pretrained(checkpoint)
    assert not (tmp_path / "run").exists()


def test_a_pickled_replay_is_not_loaded(tmp_path):
    replay = saved_replay(tmp_path / "replay")
    np.save(
        tmp_path / "replay" / "image.npy",
        np.array([Payload(tmp_path / "run")], dtype=object),
        allow_pickle=True,
    )
    with pytest.raises(ValueError, match="Python objects"):
        replay.load(tmp_path / "replay")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("tag", ["object/apply:os.system [touch {}]", "object/new:pathlib.Path [{}]", "name:os.system"])
def test_a_calibration_cannot_construct_python_objects(tmp_path, tag):
    (tmp_path / "cameras.yaml").write_text(f"units: !!python/{tag.format(tmp_path / 'run')}")
    with pytest.raises(SymviewError, match="could not determine a constructor"):
        read_calibration(tmp_path / "cameras.yaml")
    assert not (tmp_path / "run").exists()
