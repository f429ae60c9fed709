"""What LeRobot's commands print of a wrong flag: the reason, for every option of the policies and the environment."""

import pickle
import re
import subprocess
import sys
from dataclasses import dataclass, fields, is_dataclass

import draccus
import pytest
from draccus.utils import DecodingError
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs.configs import EnvConfig

from lerobot_policy_symview import SymviewBcConfig, SymviewEnvConfig, SymviewFlowConfig, SymviewSacfdConfig
from lerobot_policy_symview.rl.train_config import TrainRlConfig
from lerobot_symview.datasets.add_views import AddViewsConfig
from lerobot_symview.runtime.cli import USAGE, run_command
from lerobot_symview.runtime.flag_errors import FlagError
from symview_sim.generate import GenerateConfig

NAN = float("nan")
WRONG = {
    "symview_bc": {
        "method": ("reproj_equ", "did you mean 'reproj_equi'"),
        "view": ({"name": "persp", "siz": 76}, "--policy.view=persp: the view 'persp' has no option siz"),
        "modality": ("depth", "modality.*'depth'.*rgb"),
        "encoder": ("planar", "unknown --policy.encoder 'planar', expected one of: equivariant"),
        "group": ("D5", "unknown --policy.group 'D5', expected one of: "),
        "gripper_input": ("drawn", "gripper_input.*'drawn'.*vector"),
        "camera_direction": ("perhaps", "camera_direction.*'perhaps'"),
        "camera_rays": ("true", "--policy.camera_rays=true gives the rays of the camera's own image"),
        "width": (20, "--policy.width must be a multiple of 16 up to 1024, got 20"),
        "crop_size": (100, "unknown --policy.crop_size '100', expected one of: 64, 128"),
        "theta_representation": ("odd", "theta_representation.*'odd'.*sign"),
        "relaxation_weight": (-1.0, "--policy.relaxation_weight must not be negative, got -1.0"),
        "augmentation": ("d8", "augmentation.*'d8'.*so2"),
        "learning_rate": (0.0, "--policy.learning_rate must be positive, got 0.0"),
        "weight_averaging": (1.0, "--policy.weight_averaging must be at least 0 and below 1, got 1.0"),
        "dtype": ("float16", "dtype.*'float16'.*bfloat16"),
        "state_symmetry": (["x"], r"--policy.state_symmetry=\['x'\] lacks y, z, yaw"),
        "action_symmetry": (["height"], r"--policy.action_symmetry has unknown types \['height'\], expected any of"),
        "state_origin": ("table", "state_origin.*'table'.*world"),
        "origin_height": (20.0, "--policy.origin_height must be metres, from -3 to 3, got 20"),
        "workspace": ({"size": -1}, "--policy.workspace: workspace size and height_limit must be positive.*got -1"),
        "calibration": ({"units": "cm"}, "--policy.calibration: units must be m or mm, got 'cm'"),
        "arm": ({"joints": 3}, "--policy.arm: a stored arm is malformed: KeyError 'model'"),
        "max_joint_step": (0.0, "--policy.max_joint_step must be positive, got 0"),
        "max_arm_error": (NAN, "--policy.max_arm_error must be positive, got nan"),
        "unreachable": ("jump", "unreachable.*'jump'.*hold"),
        "camera_augmentation": (11, "--policy.camera_augmentation must lie in"),
        "check_camera": ("perhaps", "check_camera.*'perhaps'"),
        "normalization_mapping": ({"STATE": "MIN_MAX"}, "--policy.normalization_mapping must be IDENTITY for STATE"),
        "learning_rate_decay": ("linear", "learning_rate_decay.*'linear'.*cosine"),
        "horizon": (1000, "--policy.horizon must lie between 1 and 256, got 1000"),
        "n_action_steps": (2, "--policy.n_action_steps must be at least 1 and at most --policy.horizon=1, got 2"),
        "drop_n_last_frames": (-1, "--policy.drop_n_last_frames must not be negative, got -1"),
        "action_mode": ("relative", "action_mode.*'relative'.*absolute"),
        "wrist_camera": ("my camera", "--policy.wrist_camera must be the name of a camera, got 'my camera'"),
        "denoiser_width": (0, "--policy.denoiser_width must lie between 1 and 4096, got 0"),
        "aperture_noise": (NAN, "--policy.aperture_noise must be finite and at least 0, got nan"),
    },
    "symview_flow": {
        "n_obs_steps": (0, "--policy.n_obs_steps must lie between 1 and 8, got 0"),
        "integration_steps": (0, "--policy.integration_steps must lie between 1 and 100, got 0"),
        "noise_scale": (1.5, "--policy.noise_scale must lie between 0 and 1, got 1.5"),
    },
    "symview_sacfd": {
        "n_obs_steps": (2, "--policy.n_obs_steps must be 1 for symview_sacfd, got 2"),
        "discount": (0.0, "--policy.discount must be above 0 and at most 1, got 0.0"),
        "bc_weight": (-1.0, "--policy.bc_weight must not be negative, got -1.0"),
        "initial_temperature": (0.0, "--policy.initial_temperature must be positive, got 0.0"),
        "target_entropy": (NAN, "--policy.target_entropy must be finite, got nan"),
        "target_update": ("soft", "target_update.*'soft'.*polyak"),
        "target_tau": (1.5, "--policy.target_tau must be above 0 and at most 1, got 1.5"),
        "target_interval": (0, "--policy.target_interval must be at least 1, got 0"),
        "grad_clip_norm": (0.0, "--policy.grad_clip_norm must be positive and finite, got 0.0"),
        "timeouts_are_terminal": ("perhaps", "timeouts_are_terminal.*'perhaps'"),
    },
    "symview": {
        "task": ("block_piking", "--env: unknown task 'block_piking'.*did you mean 'block_picking'"),
        "robot": ("pandas", "--env: unknown robot 'pandas'.*did you mean 'panda'"),
        "fps": ("four", "fps.*'four'"),
        "camera.name": ("my camera", "env.*camera.*'my camera': name must be an identifier"),
        "camera.height": (2, "env.*camera.*height and width must be at least 8 pixels, got 2 x 152"),
        "camera.width": (2, "env.*camera.*height and width must be at least 8 pixels, got 152 x 2"),
        "camera.fov_deg": (180.0, r"env.*camera.*fov_deg must lie in \(0, 180\) degrees, got 180"),
        "camera.elevation_deg": (-30.0, r"env.*camera.*elevation_deg must lie in \(0, 90\] degrees, got -30"),
        "camera.azimuth_deg": (NAN, "env.*camera.*azimuth_deg and target must be finite, got nan"),
        "camera.distance": (0.0, "env.*camera.*distance must be positive metres, got 0"),
        "camera.target": ([0.0, 0.0, NAN], "env.*camera.*azimuth_deg and target must be finite, got.*nan"),
        "camera.spread.elevation_deg": (-1.0, "env.*camera.*spread must be finite and not negative.*elevation_deg=-1"),
        "camera.spread.azimuth_deg": (-1.0, "env.*camera.*spread must be finite and not negative.*azimuth_deg=-1"),
        "camera.spread.distance": (2.0, "env.*camera.*spread.distance must be smaller than distance, got 2"),
        "camera.spread.target": (NAN, "env.*camera.*spread must be finite and not negative.*target=nan"),
        "camera.intrinsics": ([1.0], "env.*camera.*intrinsics must be 9 numbers, got 1"),
        "camera.world_from_cam": ([1.0], "env.*camera.*world_from_cam must be 16 numbers, got 1"),
        "camera.distortion": (
            [0.1],
            "env.*camera.*distortion: the lens model plumb_bob has 4 or 5 coefficients, got 1",
        ),
        "camera.distortion_model": ("plumb_bob", r"env.*camera.*distortion_model=plumb_bob needs distortion, got \(\)"),
        "camera.distortion_known": ("perhaps", "camera.distortion_known.*'perhaps'"),
        "camera.sees_robot": ("perhaps", "camera.sees_robot.*'perhaps'"),
        "camera.depth_noise": (-1.0, "env.*camera.*depth_noise must not be negative, got -1"),
        "camera.depth_dropout": (2.0, r"env.*camera.*depth_dropout must lie in \[0, 1\], got 2"),
        "camera.flying_pixels": (2.0, r"env.*camera.*flying_pixels must lie in \[0, 1\], got 2"),
        "camera.delay": (-1, "env.*camera.*delay must be 0 to 100 actions, got -1"),
        "camera.miscalibration.position": (-1.0, "env.*camera.*errors of a calibration must be finite.*position=-1"),
        "camera.miscalibration.rotation_deg": (NAN, "env.*camera.*errors of a calibration must be finite.*=nan"),
        "camera.miscalibration.focal": (1.0, "env.*camera.*focal less than 1, got.*focal=1"),
        "more_cameras": ([{"name": "side"}], "--env: cameras must differ in their names, got side, side"),
        "oracle": ("perhaps", "oracle.*'perhaps'"),
        "depth": ("perhaps", "depth.*'perhaps'"),
        "segmentation": ("perhaps", "segmentation.*'perhaps'"),
        "workspace.center": ([NAN, 0.0], "env.*workspace values must be finite, got.*nan"),
        "workspace.size": (0.0, "env.*workspace size and height_limit must be positive metres, got 0 and 0.25"),
        "workspace.height_limit": (0.0, "env.*workspace size and height_limit must be positive.*got 0.4 and 0"),
        "wrist_camera": ("perhaps", "wrist_camera.*'perhaps'"),
        "control": ("fines", "--env: unknown control 'fines'.*did you mean 'fine'"),
        "style": ("humane", "--env: unknown style 'humane'.*did you mean 'human'"),
        "start_jitter": (-0.1, "--env: start_jitter must not be negative, got -0.1"),
        "max_steps": (0, "--env: max_steps must be at least 1, got 0"),
        "views": (["repro"], "--env: unknown view 'repro'.*did you mean 'reproj'"),
        "view_size": (4, "--env: a view's size must be an integer from 8 to 4096 pixels, got 4"),
        "reproj.size": (4, "env.*reproj.*a view's size must be an integer from 8 to 4096 pixels, got 4"),
        "reproj.infill": ("nearby", "reproj.infill.*'nearby'.*nearest"),
        "reproj.clip": (NAN, "env.*reproj.*clip must be gripper, none or a height in metres, got nan"),
        "reproj.clip_margin": (NAN, "env.*reproj.*clip_margin must be finite metres, got nan"),
        "reproj.clip_floor": (NAN, "env.*reproj.*clip_floor must be finite metres, got nan"),
        "reproj.clip_radius": (-1.0, "env.*reproj.*clip_radius must be finite metres, at least 0, got -1"),
        "reproj.lowest": (NAN, "env.*reproj.*lowest must be finite metres, got nan"),
        "reproj.flying_limit": (-1.0, "env.*reproj.*flying_limit must be finite metres, at least 0, got -1"),
        "reproj.source_scale": (9, "env.*reproj.*source_scale must be an integer from 1 to 8, got 9"),
        "reproj.height": ("perhaps", "reproj.height.*'perhaps'"),
        "reproj.mask": ("perhaps", "reproj.mask.*'perhaps'"),
        "reproj.memory": ("perhaps", "reproj.memory.*'perhaps'"),
        "reproj.age": ("perhaps", "reproj.age.*'perhaps'"),
        "reproj.cameras": (["left", "left"], "env.*reproj.*cameras must differ, got left, left"),
        "persp.size": (4, "env.*persp.*a view's size must be an integer from 8 to 4096 pixels, got 4"),
        "persp.plane_height": (NAN, "env.*persp.*plane_height must be gripper or a height in metres, got nan"),
        "persp.gripper": ("perhaps", "persp.gripper.*'perhaps'"),
        "persp.cameras": (["left", "left"], "env.*persp.*cameras must differ, got left, left"),
    },
}
"""Configuration -> field -> a wrong value, and what the terminal shows."""
FREE = {"camera", "state_names"}  # of the policies: any names; the dataset tells whether it has them
DATASET = {"dataset": {"repo_id": "a/b"}}
TOGETHER_WITH = {"view_size": {"views": ["persp"]}}
CASES = [(kind, field, *case) for kind, cases in WRONG.items() for field, case in cases.items()]


def options(configuration, base):
    """Yield the names of the fields that `base` lacks or whose values differ, dotted in nested configurations."""
    inherited = {entry.name for entry in fields(base)} - {"task", "fps", "normalization_mapping"}
    for entry in fields(configuration):
        default = getattr(configuration, entry.name)
        if is_dataclass(default):
            yield from (f"{entry.name}.{name}" for name in options(default, Empty))
        elif entry.name not in inherited:
            yield entry.name


@dataclass
class Empty:
    """Declares no fields."""


def test_every_option_has_a_wrong_value_here():
    cloning, flow, learning = WRONG["symview_bc"], WRONG["symview_flow"], WRONG["symview_sacfd"]
    assert {*cloning, *FREE} == set(options(SymviewBcConfig(device="cpu"), PreTrainedConfig))
    assert {*cloning, *flow, *FREE} >= set(options(SymviewFlowConfig(device="cpu"), PreTrainedConfig))
    assert {*cloning, *learning, *FREE} >= set(options(SymviewSacfdConfig(device="cpu"), PreTrainedConfig))
    assert set(WRONG["symview"]) == set(options(SymviewEnvConfig(), EnvConfig))


@pytest.mark.parametrize(
    ("kind", "field", "value", "shown"), CASES, ids=[f"{kind}.{field}" for kind, field, *_ in CASES]
)
def test_the_error_that_lerobot_prints_has_the_reason(kind, field, value, shown):
    values = draccus.utils.deflatten({"type": kind, field: value} | TOGETHER_WITH.get(field, {}))
    if kind == "symview":
        commands = {TrainPipelineConfig: DATASET | {"env": values}, EvalPipelineConfig: {"env": values}}
    else:
        commands = {TrainPipelineConfig: DATASET | {"policy": values}}
    for command, arguments in commands.items():
        with pytest.raises(DecodingError) as caught:  # LeRobot prints its text, see configs/parser.py
            draccus.decode(command, arguments)
        assert re.search(shown, str(caught.value).replace("\n", " ")), str(caught.value)


def printed(command, arguments, monkeypatch, capsys):
    """Return what LeRobot prints when it parses the arguments of a command."""

    def main(config):
        raise AssertionError(f"{arguments} were accepted")

    main.__annotations__["config"] = command
    monkeypatch.setattr(sys, "argv", ["lerobot", *arguments])
    with pytest.raises(SystemExit):
        parser.wrap()(main)()
    return capsys.readouterr().err


TRAIN = ["--dataset.repo_id=a/b", "--policy.type=symview_bc"]


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        (["--policy.width=20"], "--policy.width must be a multiple of 16 up to 1024, got 20\n"),
        (["--policy.width=wide"], "`width`: Couldn't parse 'wide' into an int\n"),
        (["--policy.widht=16"], "unrecognized arguments: --policy.widht=16\n"),
        (["--policy.modality=depth"], "argument --policy.modality: invalid choice: 'depth'"),
        (["--policy.view={nam: persp}"], "`view`: a view must be a name or a mapping with a name and options, got {"),
        (["--env.type=symview", "--env.robot=pandas"], "--env: unknown robot 'pandas', expected one of: panda, kuka"),
    ],
    ids=str,
)
def test_lerobot_train_prints_the_reason(arguments, shown, monkeypatch, capsys):
    assert shown in printed(TrainPipelineConfig, TRAIN + arguments, monkeypatch, capsys)


def test_lerobot_eval_prints_the_reason_in_one_line(tmp_path, monkeypatch, capsys):
    error = printed(EvalPipelineConfig, ["--env.type=symview", "--env.max_steps=0"], monkeypatch, capsys)
    assert error == "error: --env: max_steps must be at least 1, got 0\n"
    SymviewBcConfig(device="cpu").save_pretrained(tmp_path)
    arguments = [f"--policy.path={tmp_path}", "--policy.width=20", "--env.type=symview"]
    error = printed(EvalPipelineConfig, arguments, monkeypatch, capsys)
    assert error == "error: --policy.width must be a multiple of 16 up to 1024, got 20\n"


@pytest.mark.parametrize(
    ("command", "argument", "line"),
    [
        (TrainRlConfig, "--policy.width=20", "--policy.width must be a multiple of 16 up to 1024, got 20"),
        (TrainRlConfig, "--env.max_steps=0", "--env: max_steps must be at least 1, got 0"),
        (
            GenerateConfig,
            "--env.camera.elevation_deg=-30",
            "--env.camera: camera 'side': elevation_deg must lie in (0, 90] degrees, got -30",
        ),
        (AddViewsConfig, "--workspace.size=0", "--workspace: workspace size and height_limit must be positive metres"),
    ],
)
def test_own_commands_print_the_reason_once(command, argument, line, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["symview", argument])
    with pytest.raises(SystemExit) as end:
        run_command(command, print, "")
    assert end.value.code == USAGE
    error = capsys.readouterr().err
    assert error.startswith(f"symview: error: {line}")
    assert error.count("\n") == error.count(line) == 1


def test_a_flag_error_survives_a_worker_process():
    error = pickle.loads(pickle.dumps(FlagError("--env: no")))
    assert (type(error), str(error)) == (FlagError, "--env: no")


@pytest.mark.long
def test_the_console_command_prints_the_reason():
    code = "from lerobot.scripts.lerobot_train import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *TRAIN, "--policy.width=20"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "--policy.width must be a multiple of 16 up to 1024, got 20\n" in done.stderr
