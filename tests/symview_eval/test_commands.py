"""Commands that need an extra say which one."""

import pytest

from symview_eval import commands
from symview_sim.generate import RecordedEnv, RecordedFetch, RecordedMetaWorld, RecordedWorld


@pytest.fixture
def without(monkeypatch):
    def hide(*names):
        found = commands.find_spec
        monkeypatch.setattr(commands, "find_spec", lambda name: None if name in names else found(name))

    return hide


@pytest.mark.parametrize(
    ("command", "words", "hidden", "extras"),
    [
        ("train_rl", [], ["pybullet"], "sim"),
        ("benchmark", ["env"], ["pybullet"], "sim"),
        ("demo", [], ["pybullet", "matplotlib"], "sim,viz"),
        ("demo", [], ["matplotlib"], "viz"),
        ("experiment", ["table1"], ["pybullet"], "sim"),
        ("experiment", ["report"], ["pybullet", "matplotlib"], "viz"),
    ],
)
def test_a_command_names_the_extra_that_is_missing(monkeypatch, capsys, without, command, words, hidden, extras):
    without(*hidden)
    monkeypatch.setattr("sys.argv", ["symview-x", *words])
    with pytest.raises(SystemExit) as end:
        getattr(commands, command)()
    assert end.value.code == 1
    error = capsys.readouterr().err
    assert error.endswith(f"not installed: pip install 'lerobot_policy_symview[{extras}]'\n")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("env", "module", "extra"),
    [
        (RecordedEnv, "pybullet", "sim"),
        (RecordedMetaWorld, "metaworld", "metaworld"),
        (RecordedFetch, "gymnasium_robotics", "fetch"),
    ],
)
def test_a_recording_names_the_extra_of_its_simulator(monkeypatch, capsys, tmp_path, env, module, extra):
    def make(settings):
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    monkeypatch.setattr(env, "make", make)
    kind = RecordedWorld.get_choice_name(env)
    monkeypatch.setattr("sys.argv", ["symview-generate", f"--env.type={kind}", f"--root={tmp_path / 'data'}"])
    with pytest.raises(SystemExit) as end:
        commands.generate()
    assert end.value.code == 1
    assert capsys.readouterr().err.endswith(f"not installed: pip install 'lerobot_policy_symview[{extra}]'\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("module", "raised"), [("ray", SystemExit), ("gears", ModuleNotFoundError)])
def test_a_module_missing_later_is_named_if_an_extra_installs_it(monkeypatch, capsys, module, raised):
    class Command:
        @staticmethod
        def main():
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    monkeypatch.setattr(commands, "import_module", lambda name: Command)
    with pytest.raises(raised):
        commands.generate()
    assert ("lerobot_policy_symview[ray]" in capsys.readouterr().err) == (module == "ray")
