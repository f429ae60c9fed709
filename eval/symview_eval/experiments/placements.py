"""Evaluation of a trained policy with cameras that its demonstrations did not have."""

from __future__ import annotations

import time
from dataclasses import replace

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.rl.rollouts import EVALUATION_SEED, Actor, evaluate, simulator_config
from symview_eval.experiments.grid import Cell
from symview_eval.experiments.results import Checkpoint, Times, checkpoint
from symview_sim.settings import WorldSettings
from symview_sim.simulators import Simulators


def evaluate_placements(cell: Cell, actor: Actor, env: WorldSettings) -> tuple[list[Checkpoint], Times]:
    """Evaluate a policy with each of a cell's cameras, in the same scenes.

    Args:
        cell: the cell.
        actor: its policy, trained with the cell's demonstrations.
        env: environment of the evaluations, but for its camera.
    """
    begin, begin_cpu = time.perf_counter(), time.process_time()
    first_seed = EVALUATION_SEED + cell.seed * cell.scale.placement_episodes
    seeds = range(first_seed, first_seed + cell.scale.placement_episodes)
    checkpoints, simulated_s = [], 0.0
    for name, camera in cell.placements:
        config = simulator_config(actor.scene.config, replace(env, camera=camera))
        with Simulators(config, cell.scale.simulators) as simulators:
            evaluation = evaluate(actor, simulators, seeds, SymviewSacfdConfig.discount)
            simulated_s += simulators.cpu_seconds()
        checkpoints.append(checkpoint(cell.steps, evaluation, camera=name))
    seconds, cpu_s = time.perf_counter() - begin, time.process_time() - begin_cpu + simulated_s
    return checkpoints, Times(evaluation_s=seconds, cpu_s=cpu_s)
