"""Suite `policy`: training and inference time of the equivariant policy, relative to escnn and to a plain network."""

from __future__ import annotations

import logging
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn
from torch.nn import functional

from lerobot_policy_symview.configuration import CROP_SIZES
from lerobot_policy_symview.configuration_chunks import ChunkConfig
from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.inputs.voxels import HEIGHT, SIDE, VOXEL_CHANNELS
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.nn.encoders.convolutional import ConvolutionalEncoder, ImageEncoder
from lerobot_policy_symview.nn.encoders.voxel import VoxelEncoder
from lerobot_policy_symview.symmetry.groups import make_group
from lerobot_symview import keys
from lerobot_symview.datasets.add_views import AddViewsConfig, add_views
from lerobot_symview.datasets.hub import HubDataset
from symview_eval.benchmarks.clock import medians
from symview_eval.benchmarks.tick import benchmark_ticks
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset

logger = logging.getLogger(__name__)

LEROBOT = "import time, lerobot.scripts.lerobot_train, lerobot.scripts.lerobot_eval; start = time.perf_counter()"
PLUGIN = f"{LEROBOT}; import lerobot_policy_symview; print(time.perf_counter() - start)"
LOADED_EPISODES = 4
VOXEL_BATCH = 8
MARGIN = 24  # pixels between the image and its random crop: the paper crops 152 to 128


@dataclass(frozen=True)
class PolicyBenchmark:
    """Measure training steps, inference, start-up and data loading of symview_bc, as ratios within one run.

    With `--policy.type`, measure that policy's control tick and training step instead.
    """

    batch_size: int = 128
    """Samples per training step."""
    width: int = 64
    """Width n of the network: regular fields per layer."""
    crop_size: int = 128
    """Rows and columns of the crop that the network takes, pixels."""
    repeats: int = 3
    """Timed training steps of each network; medians are reported. Inference is timed ten times as often."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of our convolutions. escnn runs in float32, the plain network in the faster of the two."""
    device: str = "cpu"
    """PyTorch device of the networks, such as `cuda`; data is loaded on the CPU."""
    policy: PreTrainedConfig | None = None
    """`--policy.type=symview_flow` or `symview_bc`, with sizes of its own (`--policy.width`, `--policy.crop_size`)."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def __post_init__(self) -> None:
        for name in ("batch_size", "repeats"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} must be at least 1, got {getattr(self, name)}")
        if self.crop_size not in CROP_SIZES:
            raise ValueError(f"--crop_size must be one of {CROP_SIZES}, got {self.crop_size}")
        if self.dtype not in ("float32", "bfloat16"):
            raise ValueError(f"--dtype must be float32 or bfloat16, got {self.dtype}")
        try:
            torch.empty(0, device=self.device)
        except (AssertionError, RuntimeError) as error:
            raise ValueError(f"--device={self.device} is not available here: {error}") from None
        if self.policy is not None and not isinstance(self.policy, ChunkConfig):
            raise ValueError(f"--policy.type must be symview_flow or symview_bc, got {self.policy.type}")


class PlainNetwork(nn.Module):
    """Plain convolutions with the expanded widths and the current filters of an equivariant encoder.

    A training step costs as much as dense execution of the equivariant network if the expansion of filters were free.
    Inference is that of the equivariant network with its filters expanded once.
    """

    def __init__(self, encoder: ImageEncoder):
        super().__init__()
        self.pooled = encoder.pooled
        self.layers = nn.ModuleList()
        for layer in encoder.layers:
            with torch.no_grad():
                weight, bias = layer.expanded()  # type: ignore[operator]
            outputs, inputs = weight.shape[:2]
            dense = nn.Conv2d(inputs, outputs, 3, padding=layer.padding)  # type: ignore[arg-type]
            dense.load_state_dict({"weight": weight.reshape(outputs, inputs, 3, 3), "bias": bias})
            self.layers.append(dense)

    def forward(self, image: Tensor, state: Tensor) -> Tensor:
        """Map images (B, C, crop, crop) and states (B, D) to features (B, channels)."""
        planes = state[:, :, None, None].expand(-1, -1, *image.shape[-2:])
        features = torch.cat([image, planes], dim=1)
        if torch.is_autocast_enabled(features.device.type) or features.is_cuda:  # as in our encoder
            features = features.contiguous(memory_format=torch.channels_last)
        for layer, pool in zip(self.layers, self.pooled, strict=True):
            features = layer(features)
            features = functional.relu(functional.max_pool2d(features, 2) if pool else features)
        return features.flatten(1)


class WholeConvolutions(nn.Module):
    """A voxel encoder whose first layers are computed at every voxel."""

    def __init__(self, encoder: VoxelEncoder):
        super().__init__()
        self.encoder = encoder

    def forward(self, grid: Tensor, state: Tensor) -> Tensor:
        """Map voxel grids and states to the encoder's features."""
        return ConvolutionalEncoder.forward(self.encoder, grid, state)


def benchmark_policy(config: PolicyBenchmark) -> dict[str, float]:
    """Time the policy and the networks it is compared with.

    Returns:
        Times in seconds unless the name says otherwise. `train_step_ratio_escnn_fp32` and `train_step_ratio_plain`: our
        training step over escnn's, and over that of a plain network of the same expanded widths in its faster
        precision. `inference_ratio_b1` and `_b5`: our inference over the plain network's, for batches of 1 and 5.
        `train_step_floor_s`: the plain network's arithmetic at the rate of large matrix products in `--dtype`.
        `voxel_train_step_ratio`: the voxel encoder's training step over that of whole convolutions, for 8 grids.
        `plugin_import_s`: time that the plugin adds to LeRobot's import. `loader_share`: time to load a batch over the
        time of a training step. Without the extra `escnn`, the entries of escnn are left out. With a policy, those of
        `benchmark_ticks`.
    """
    if isinstance(config.policy, ChunkConfig):
        return benchmark_ticks(config.policy, config.batch_size, config.repeats)
    start = time.perf_counter()
    policy = make_policy(config)
    construct = time.perf_counter() - start
    encoder = policy.network.encoder
    assert isinstance(encoder, ImageEncoder)
    plain = PlainNetwork(encoder).to(config.device)
    networks: dict[str, tuple[nn.Module, str]] = {"": (encoder, config.dtype)}
    if find_spec("escnn") is None:
        logger.info("escnn is not installed: no ratio to it (docs/install.md says how to install it)")
    else:
        networks["escnn_"] = (_escnn(encoder).to(config.device), "float32")
    networks |= {f"plain_{dtype}_": (plain, dtype) for dtype in _precisions(config.device)}
    image, state = example_input(config, policy, config.batch_size)
    calls = {name: _training_step(network, image, state, dtype) for name, (network, dtype) in networks.items()}
    steps = medians(calls, config.repeats, "step")
    results = {f"{name}train_step_s": seconds for name, seconds in steps.items()}
    results |= {
        "train_step_ratio_plain": steps[""] / _plain(steps),
        "train_step_floor_s": _dense_operations(plain, config) / _operations_per_second(config),
    }
    if "escnn_" in networks:
        results["train_step_ratio_escnn_fp32"] = steps[""] / steps["escnn_"]
        del networks["escnn_"]
    if "plain_bfloat16_" in networks:  # converted once, not at every call
        networks["plain_bfloat16_"] = (deepcopy(plain).to(torch.bfloat16), "bfloat16")
    for batch in (1, 5):
        inputs = example_input(config, policy, batch)
        calls = {name: _inference(network.eval(), *inputs, dtype) for name, (network, dtype) in networks.items()}
        times = medians(calls, 10 * config.repeats, f"inference of {batch}")
        results |= {
            f"inference_ms_b{batch}": 1000 * times[""],
            f"inference_ratio_b{batch}": times[""] / _plain(times),
        }
    loading = loading_seconds(config)
    return results | {
        "plugin_import_s": plugin_import_seconds(),
        "construct_s": construct,
        "voxel_train_step_ratio": voxel_ratio(config),
        "loader_s": loading,
        "loader_share": loading / steps[""],
    }


def make_policy(config: PolicyBenchmark) -> SymviewBcPolicy:
    """Return an untrained policy of the benchmark's size."""
    settings = SymviewBcConfig(device=config.device, width=config.width, crop_size=config.crop_size)
    settings.output_features = {keys.ACTION: PolicyFeature(FeatureType.ACTION, (len(keys.ACTION_NAMES),))}
    return SymviewBcPolicy(settings).to(config.device)


def _escnn(encoder: ImageEncoder) -> nn.Module:
    """Return escnn's network of the same layout, with random weights."""
    from lerobot_policy_symview.nn.escnn_bridge import EscnnEncoder

    network = EscnnEncoder(encoder, initialize=False)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.02)
    return network


def example_input(config: PolicyBenchmark, policy: SymviewBcPolicy, batch: int) -> tuple[Tensor, Tensor]:
    """Return random images (B, C, crop, crop) and states (B, 2), the same at every call."""
    generator = torch.Generator().manual_seed(0)
    size = config.crop_size
    image = torch.rand(batch, policy.config.channels, size, size, generator=generator)
    return image.to(config.device), torch.rand(batch, 2, generator=generator).to(config.device)


def _precisions(device: str) -> list[str]:
    """Return the precisions of the plain network: bfloat16 takes minutes on a CPU without instructions for it."""
    is_emulated = device == "cpu" and not torch.backends.cpu.get_cpu_capability().startswith("AVX512")
    return ["float32"] if is_emulated else ["float32", "bfloat16"]


def _plain(times: Mapping[str, float]) -> float:
    """Return the plain network's time in its faster precision."""
    return min(seconds for name, seconds in times.items() if name.startswith("plain_"))


def _training_step(network: nn.Module, image: Tensor, state: Tensor, dtype: str) -> Callable[[], None]:
    """Return a training step, least squares on the features: a head's time is negligible."""
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-5)

    def step() -> None:
        network.train()
        with torch.autocast(image.device.type, torch.bfloat16, enabled=dtype == "bfloat16"):
            features = network(image, state)
        features.float().square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def _inference(network: nn.Module, image: Tensor, state: Tensor, dtype: str) -> Callable[[], None]:
    def run() -> None:
        precision = torch.autocast(image.device.type, torch.bfloat16, enabled=dtype == "bfloat16")
        with torch.inference_mode(), precision:
            network(image, state)

    return run


def voxel_ratio(config: PolicyBenchmark) -> float:
    """Return the training step of the voxel encoder over that with whole convolutions, for blocks and a gripper."""
    channels = VOXEL_CHANNELS + 1  # the gripper
    encoder = VoxelEncoder(make_group("D4"), channels, np.zeros((8, 0, 0)), config.width).to(config.device)
    grid = torch.zeros(VOXEL_BATCH, channels, HEIGHT, SIDE, SIDE, device=config.device)
    scene, gripper = grid[:, :VOXEL_CHANNELS], grid[:, VOXEL_CHANNELS]
    scene[:, :, 0] = scene[:, :, 1:9, 20:29, 31:40] = scene[:, :, 1:9, 40:49, 10:19] = 1.0
    gripper[:, 18:22, 20:24, 30:34] = gripper[:, 18:22, 20:24, 44:48] = 1.0
    state = torch.zeros(VOXEL_BATCH, 0, device=config.device)
    networks = {"sparse": encoder, "whole": WholeConvolutions(encoder)}
    calls = {name: _training_step(network, grid, state, config.dtype) for name, network in networks.items()}
    times = medians(calls, config.repeats, "step of voxels")
    return times["sparse"] / times["whole"]


def _dense_operations(network: PlainNetwork, config: PolicyBenchmark) -> float:
    """Return the floating-point operations of a dense training step: 3 convolutions per layer, 2 for the first."""
    side, total = config.crop_size, 0.0
    for index, (layer, pool) in enumerate(zip(network.layers, network.pooled, strict=True)):
        assert isinstance(layer, nn.Conv2d)
        side += 2 * int(layer.padding[0]) - 2
        total += 2 * layer.weight.numel() * side * side * (2 if index == 0 else 3)
        side = side // 2 if pool else side
    return total * config.batch_size


def _operations_per_second(config: PolicyBenchmark, size: int = 1024, repeats: int = 5) -> float:
    """Return the measured rate of matrix products, the fastest arithmetic of the device."""
    a, b = torch.rand(2, size, size, device=config.device, dtype=getattr(torch, config.dtype))
    return 2 * size**3 / medians({"": lambda: torch.mm(a, b)}, repeats, "matrix product")[""]


def plugin_import_seconds() -> float:
    """Return the time that the plugin adds to LeRobot's import, in a process of its own."""
    command = [sys.executable, "-c", PLUGIN]
    done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603  a constant of this module
    return float(done.stdout.split()[-1])


def loading_seconds(config: PolicyBenchmark) -> float:
    """Return the seconds that LeRobot's loader takes per batch in the training process, for a dataset of views only."""
    from lerobot.datasets import LeRobotDataset

    with tempfile.TemporaryDirectory() as folder:
        recorded, views = Path(folder) / "recorded", Path(folder) / "views"
        target = NewDataset("benchmark/recorded", recorded)
        generate(GenerateConfig(target, env=RecordedEnv(), num_episodes=LOADED_EPISODES))
        add_views(
            AddViewsConfig(
                HubDataset("benchmark/recorded", recorded),
                new_repo_id="benchmark/views",
                new_root=views,
                size=config.crop_size + MARGIN,
                keep=[],
            )
        )
        dataset = LeRobotDataset("benchmark/views", root=views)
        loader = torch.utils.data.DataLoader(
            dataset,
            batch_size=config.batch_size,
            sampler=torch.utils.data.RandomSampler(dataset, num_samples=3 * config.batch_size, replacement=True),
        )
        times, start = [], time.perf_counter()
        for _ in loader:
            times.append(time.perf_counter() - start)
            start = time.perf_counter()
    return statistics.median(times)
