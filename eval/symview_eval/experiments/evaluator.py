"""Evaluations of a policy during its training, in a thread of their own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_model, save_model

from lerobot_policy_symview.rl.rollouts import Actor, evaluate
from symview_eval.experiments.results import Checkpoint, checkpoint
from symview_sim.simulators import Simulators


@dataclass(frozen=True)
class _Submitted:
    step: int
    loss: float
    actor: Actor | None
    """The copy that is evaluated; None if that was finished in an earlier run."""
    result: Future[Checkpoint]


class Evaluator:
    """Evaluates copies of a policy in a thread, one after the other, while its training may continue.

    Args:
        simulators: the simulators that run the episodes.
        episodes: episodes per evaluation.
        first_seed: seed of the first scene; later scenes and evaluations have the following seeds.
        discount: discount factor of the returns.
    """

    def __init__(self, simulators: Simulators, episodes: int, first_seed: int, discount: float):
        self._simulators, self._episodes, self._first_seed, self._discount = simulators, episodes, first_seed, discount
        threads = torch.get_num_threads()
        self._thread = ThreadPoolExecutor(1, "evaluation", initializer=torch.set_num_threads, initargs=(threads,))
        self._submitted: list[_Submitted] = []
        self.seconds = 0.0
        """Time of the evaluations."""
        self.waiting_s = 0.0
        """Time that the training waited for them."""

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def submit(self, actor: Actor, step: int, loss: float) -> None:
        """Evaluate a copy of a policy with its present weights. Wait for the result if the policy remembers.

        Args:
            actor: the policy.
            step: training steps so far.
            loss: mean loss since the last evaluation.
        """
        self._submit(actor.copy(), step, loss)
        if actor.remembers:  # its evaluation draws from the random numbers that the training draws from
            self._wait()

    def results(self) -> list[Checkpoint]:
        """Wait for all evaluations; return them in the order of their steps."""
        self._wait()
        return [submitted.result.result() for submitted in self._submitted]

    def save(self, folder: Path) -> list[dict[str, Any]]:
        """Return the evaluations, in JSON types, and write the policies of those that are not finished."""
        saved = []
        for submitted in self._submitted:
            if submitted.result.done():
                saved.append(asdict(submitted.result.result()))
            else:
                assert submitted.actor is not None
                save_model(submitted.actor.policy, str(_weights(folder, submitted.step)))
                saved.append({"step": submitted.step, "loss": submitted.loss})
        return saved

    def load(self, folder: Path, saved: list[dict[str, Any]], actor: Actor) -> None:
        """Restore what `save` returned and wrote; evaluate what was not finished in copies of `actor`."""
        for evaluation in saved:
            if "successes" in evaluation:
                finished: Future[Checkpoint] = Future()
                finished.set_result(Checkpoint(**evaluation))
                self._submitted.append(_Submitted(evaluation["step"], evaluation["loss"], None, finished))
            else:
                copy = actor.copy()
                load_model(copy.policy, _weights(folder, evaluation["step"]), device=copy.policy.config.device)
                self._submit(copy, **evaluation)

    def _submit(self, actor: Actor, step: int, loss: float) -> None:
        first = self._first_seed + len(self._submitted) * self._episodes
        result = self._thread.submit(self._evaluate, actor, range(first, first + self._episodes), step, loss)
        self._submitted.append(_Submitted(step, loss, actor, result))

    def _evaluate(self, actor: Actor, seeds: Sequence[int], step: int, loss: float) -> Checkpoint:
        start = time.perf_counter()
        evaluation = evaluate(actor, self._simulators, seeds, self._discount)
        self.seconds += time.perf_counter() - start
        return checkpoint(step, evaluation, loss)

    def _wait(self) -> None:
        start = time.perf_counter()
        for submitted in self._submitted:
            submitted.result.result()
        self.waiting_s += time.perf_counter() - start


def _weights(folder: Path, step: int) -> Path:
    return folder / f"evaluated_{step}.safetensors"
