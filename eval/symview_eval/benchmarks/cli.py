"""`symview-benchmark`: measures one suite and prints a table or JSON."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

from lerobot_symview.runtime.cli import run_command, subcommand

EXAMPLES = """\
  symview-benchmark experts --seeds=200
  symview-benchmark env --json=true
  symview-benchmark views
  symview-benchmark policy --batch_size=32
  symview-benchmark policy --policy.type=symview_flow --policy.width=16 --policy.crop_size=64 --batch_size=8
  symview-benchmark rl --policy.width=16 --policy.crop_size=64 --batch_size=32
  symview-benchmark experiment --scale=laptop

The first argument is the suite: experts (the default), env, views, policy, rl or experiment.
`symview-benchmark SUITE --help` lists the options of that suite."""

SUITES = {
    "experts": ("symview_eval.benchmarks.experts", "ExpertsBenchmark", "benchmark_experts"),
    "env": ("symview_eval.benchmarks.env", "EnvBenchmark", "benchmark_env"),
    "views": ("symview_eval.benchmarks.views", "ViewsBenchmark", "benchmark_views"),
    "policy": ("symview_eval.benchmarks.policy", "PolicyBenchmark", "benchmark_policy"),
    "rl": ("symview_eval.benchmarks.rl", "RlBenchmark", "benchmark_rl"),
    "experiment": ("symview_eval.benchmarks.experiment", "ExperimentBenchmark", "benchmark_experiment"),
}
"""Suite -> module, configuration class and function. A suite's module is imported only when the suite runs: worker
processes import this module, and importing PyTorch takes longer than their work."""


def print_results(results: dict[str, Any], as_json: bool) -> None:
    """Print the results of a suite as one JSON object, or as one line per name."""
    if as_json:
        sys.stdout.write(json.dumps(results) + "\n")
        return
    for name, value in results.items():
        values = value if isinstance(value, dict) else {"": value}
        columns = "  ".join(f"{label:>11} {number:7.4g}" for label, number in values.items())
        sys.stdout.write(f"{name:28}{columns}\n")


def main() -> None:
    """Run the console command: the first argument names the suite."""
    module, *names = SUITES[subcommand("suite", SUITES, default="experts")]
    config_class, benchmark = (getattr(import_module(module), name) for name in names)
    sys.argv = [
        argument.replace("--json", "--json=true") if argument == "--json" else argument for argument in sys.argv
    ]
    run_command(config_class, lambda config: print_results(benchmark(config), config.json), EXAMPLES)
