"""Flow matching learns from demonstrations in the style of people, at the size of the committed results."""

import pytest

from symview_eval.experiments.cli import ExperimentConfig, run_experiment
from symview_eval.experiments.results import read_result


@pytest.mark.learning
@pytest.mark.usefixtures("unchecked_kernels")
def test_flow_matching_solves_picking_from_25_demonstrations_of_people(tmp_path):
    """docs/results.md has the success rates of several seeds, of regression and of LeRobot's own policies."""
    config = ExperimentConfig(
        scale="laptop",
        tasks=("block_picking",),
        methods=("flow_reproj_equi",),
        demos=(25,),
        seeds=(0,),
        num_workers=1,
        results_dir=tmp_path / "results",
        output_dir=tmp_path / "output",
    )
    (cell,) = run_experiment("chunks", config)
    last = read_result(config.results_dir / cell.path).checkpoints[-1]
    assert last.episodes == 60
    assert last.successes >= 45
