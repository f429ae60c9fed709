import json

import pytest
import torch

from lerobot_policy_symview.chunks import ChunkPolicy
from lerobot_policy_symview.configuration_symview_flow import SymviewFlowConfig
from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.nn.encoders.convolutional import ConvolutionalEncoder
from lerobot_policy_symview.nn.escnn_bridge import EscnnEncoder
from symview_eval.benchmarks import cli, experts
from symview_eval.benchmarks import policy as policy_benchmark
from symview_eval.benchmarks import rl as rl_benchmark
from symview_eval.benchmarks import tick as tick_benchmark
from symview_eval.benchmarks import views as views_benchmark

pytestmark = pytest.mark.long


def test_the_experts_benchmark_reports_every_task():
    results = experts.benchmark_experts(experts.ExpertsBenchmark(seeds=2, tasks=["block_picking"]))
    assert results == {"block_picking": {"success": 1.0, "mean_length": 7.0, "min_length": 7, "max_length": 7}}
    fine = experts.benchmark_experts(experts.ExpertsBenchmark(seeds=2, tasks=["block_picking"], control="fine"))
    assert fine["block_picking"]["success"] == 1.0
    assert fine["block_picking"]["min_length"] > 25
    with pytest.raises(ValueError, match="unknown --control 'fines'"):
        experts.ExpertsBenchmark(control="fines")


def test_the_env_benchmark_names_every_time(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "env", "--episodes=1", "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out)
    assert list(results) == [
        "step_ms",
        "physics_ms",
        "inverse_kinematics_ms",
        "render_ms",
        "other_ms",
        "floor_ms",
        "reset_ms",
        "episodes_per_s",
        "saved_episodes_per_s",
    ]
    results.pop("other_ms")  # a difference of medians, which a busy machine can make negative
    assert all(value > 0 for value in results.values())


def test_an_unknown_suite_gets_a_suggestion(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "expert"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert "did you mean 'experts'" in capsys.readouterr().err


def test_the_views_benchmark_names_every_ratio(monkeypatch, capsys):
    monkeypatch.setattr(views_benchmark, "RECORDED", 2)
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "views", "--repeats=2", "--frames=20", "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {
        f"{name}_{unit}" for name in ("vga_lens", "vga_unaligned", "fused", "splat") for unit in ("ms", "ratio")
    } <= set(results)
    assert {"vga_ms", "hd_ms", "memory_ratio"} <= set(results)
    expected = {"offline_codec_share", "offline_two_process_speedup", "frames_per_s", "floor_ratio", "warp_us"}
    assert expected | {f"{name}_ratio" for name in views_benchmark.VIEWS} <= set(results)
    assert results["offline_codec_share"] < 1
    assert all(value > 0 for value in results.values())


def test_the_experiment_benchmark_names_every_share(monkeypatch, capsys):
    arguments = ["--scale=smoke", "--method=sideview_nonequi", "--num_workers=1", "--json"]
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "experiment", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert 0 < results["useful_core_share"] <= 1
    assert 0 < results["cell_s"] < 3600 / results["cells_per_hour"]
    parts = ("preparation", "training", "waiting")
    assert 0 < sum(results[f"{part}_share"] for part in parts) <= 1


def test_the_policy_benchmark_names_every_ratio(monkeypatch, capsys):
    monkeypatch.setattr(
        "sys.argv",
        ["symview-benchmark", "policy", "--batch_size=2", "--width=16", "--crop_size=64", "--repeats=1", "--json"],
    )
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    expected = {
        "train_step_ratio_escnn_fp32",
        "train_step_ratio_plain",
        "voxel_train_step_ratio",
        "train_step_floor_s",
        "inference_ratio_b1",
        "inference_ms_b1",
        "inference_ratio_b5",
        "inference_ms_b5",
        "plugin_import_s",
        "construct_s",
        "loader_share",
    }
    assert expected <= set(results)
    assert all(value > 0 for value in results.values())


def test_the_rl_benchmark_names_every_time(monkeypatch, capsys):
    monkeypatch.setattr(rl_benchmark, "DEMONSTRATIONS", 1)
    argv = ["symview-benchmark", "rl", "--batch_size=4", "--num_simulators=2", "--rounds=1", "--json"]
    monkeypatch.setattr("sys.argv", [*argv, "--policy.width=16", "--policy.crop_size=64"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"joint_step_ratio", "sample_ms", "sample_floor_ms", "joint_step_s", "network_s", "simulation_s"} <= set(
        results
    )
    assert results["bytes_per_transition"] == 76 * 76 * 5 + 20 + 20 + 4 + 1 + 8
    assert all(value > 0 for value in results.values())
    assert results["network_share"] + results["waiting_share"] < 1


def test_the_plain_network_computes_the_same_features():
    config = policy_benchmark.PolicyBenchmark(width=16, crop_size=64)
    policy = policy_benchmark.make_policy(config)
    inputs = policy_benchmark.example_input(config, policy, 3)
    plain = policy_benchmark.PlainNetwork(policy.network.encoder)
    torch.testing.assert_close(plain(*inputs), policy.network.encoder(*inputs).flatten(1), rtol=1e-4, atol=1e-4)


def test_without_escnn_the_policy_benchmark_leaves_its_ratio_out(monkeypatch, caplog):
    monkeypatch.setattr(policy_benchmark, "find_spec", lambda name: None)
    monkeypatch.setattr(policy_benchmark, "loading_seconds", lambda config: 1.0)
    monkeypatch.setattr(policy_benchmark, "plugin_import_seconds", lambda: 1.0)
    config = policy_benchmark.PolicyBenchmark(batch_size=2, width=16, crop_size=64, repeats=1)
    with caplog.at_level("INFO", logger=policy_benchmark.__name__):
        results = policy_benchmark.benchmark_policy(config)
    assert results["train_step_ratio_plain"] > 0
    assert not [name for name in results if "escnn" in name]
    assert "escnn is not installed" in caplog.text


def test_the_policy_benchmark_runs_in_bfloat16(monkeypatch):
    """escnn's network stays in float32. Parts that do not depend on the precision are replaced."""
    monkeypatch.setattr(policy_benchmark, "loading_seconds", lambda config: 1.0)
    monkeypatch.setattr(policy_benchmark, "plugin_import_seconds", lambda: 1.0)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    computed = {}
    for kind in (policy_benchmark.PlainNetwork, ConvolutionalEncoder, EscnnEncoder):
        forward = kind.forward

        def recorded(self, *inputs, kind=kind, forward=forward):
            result = forward(self, *inputs)
            computed.setdefault(kind.__name__, set()).add(result.dtype)
            return result

        monkeypatch.setattr(kind, "forward", recorded)
    config = policy_benchmark.PolicyBenchmark(batch_size=2, width=16, crop_size=64, repeats=1, dtype="bfloat16")
    assert all(value > 0 for value in policy_benchmark.benchmark_policy(config).values())
    assert computed == {
        "PlainNetwork": {torch.float32, torch.bfloat16},
        "ConvolutionalEncoder": {torch.bfloat16},
        "EscnnEncoder": {torch.float32},
    }


@pytest.mark.parametrize("kind", ["symview_flow", "symview_bc"])
def test_a_policy_is_timed_as_it_acts_and_trains(kind, monkeypatch, capsys):
    for name, value in {"ROWS": 96, "COLUMNS": 128, "FRAMES": 3}.items():
        monkeypatch.setattr(tick_benchmark, name, value)
    predicted = []
    predict = ChunkPolicy.predict_action_chunk
    monkeypatch.setattr(
        ChunkPolicy,
        "predict_action_chunk",
        lambda *inputs, **options: predicted.append(1) or predict(*inputs, **options),
    )
    sizes = ["--policy.width=16", "--policy.crop_size=64", "--policy.device=cpu", "--batch_size=2", "--repeats=1"]
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "policy", f"--policy.type={kind}", *sizes, "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(predicted) == 12 + 8  # chunks, and one for each element of D4
    assert results["tick_limit_ms"] == 25
    assert results["train_step_limit_encoder"] == 1.3
    assert results["cores"] == 1
    parts = sum(results[f"{part}_ms"] for part in ("view", "encoder", "head", "other"))
    assert results["tick_ms"] == pytest.approx(parts)
    assert 0 < results["equivariance_error"] < 1e-4
    assert results["tick_mean_ms"] > 0
    assert results["train_step_ratio_encoder"] == results["train_step_s"] / results["encoder_step_s"]


def test_only_policies_of_chunks_have_ticks():
    with pytest.raises(ValueError, match=r"--policy.type must be symview_flow or symview_bc, got symview_sacfd"):
        policy_benchmark.PolicyBenchmark(policy=SymviewSacfdConfig())


@pytest.mark.parametrize("method", ["sideview_equi", "oracle_equi", "point_cloud_equi"])
def test_ticks_of_other_methods(method, monkeypatch):
    for name, value in {"ROWS": 96, "COLUMNS": 128, "FRAMES": 2}.items():
        monkeypatch.setattr(tick_benchmark, name, value)
    config = SymviewFlowConfig(method=method, width=32, crop_size=64, device="cpu")
    results = tick_benchmark.benchmark_ticks(config, batch_size=2, repeats=1)
    assert "tick_limit_ms" not in results
    assert results["tick_ms"] > 0


@pytest.mark.parametrize(("option", "value"), [("dtype", "float16"), ("device", "cuda:99"), ("device", "abacus")])
def test_an_unavailable_precision_or_device_is_refused(option, value):
    with pytest.raises(ValueError, match=f"--{option}.*{value}"):
        policy_benchmark.PolicyBenchmark(**{option: value})


def test_batched_ratios_on_the_cpu():
    results = views_benchmark.batched_ratios(views_benchmark.simulated_frame(), 2, "cpu")
    assert len(results) == 6
    assert all(value > 0 for value in results.values())
