import json

import pytest

from symview_eval import benchmark, views_benchmark


def test_experts_are_counted_per_task():
    results = benchmark.benchmark_experts(benchmark.ExpertsBenchmark(seeds=2, tasks=["block_picking"]))
    assert results == {"block_picking": {"success": 1.0, "mean_length": 7.0, "min_length": 7, "max_length": 7}}


def test_the_environment_benchmark_names_every_cost(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "env", "--episodes=1", "--json"])
    with pytest.raises(SystemExit) as end:
        benchmark.main()
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
    assert all(value > 0 for value in results.values())


def test_an_unknown_suite_is_answered_with_the_nearest_known_one(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "expert"])
    with pytest.raises(SystemExit) as end:
        benchmark.main()
    assert end.value.code == 2
    assert "did you mean 'experts'" in capsys.readouterr().err


def test_the_views_benchmark_names_every_ratio(monkeypatch, capsys):
    monkeypatch.setattr(views_benchmark, "RECORDED", 2)
    monkeypatch.setattr("sys.argv", ["symview-benchmark", "views", "--repeats=2", "--frames=20", "--json"])
    with pytest.raises(SystemExit) as end:
        benchmark.main()
    assert end.value.code == 0
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    stated = {"offline_codec_share", "offline_two_process_speedup", "frames_per_s", "floor_ratio", "warp_us"}
    assert stated | {f"{name}_ratio" for name in views_benchmark.VIEWS} <= set(results)
    assert results["offline_codec_share"] < 1
    assert all(value > 0 for value in results.values())


def test_batches_are_measured_on_any_device():
    results = views_benchmark.batched_ratios(views_benchmark._frame(), 2, "cpu")
    assert len(results) == 6
    assert all(value > 0 for value in results.values())
