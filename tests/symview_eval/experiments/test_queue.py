from dataclasses import replace

import pytest

from symview_eval.experiments.grid import select
from symview_eval.experiments.queue import Costs, chosen_cells, distinct, remaining
from symview_eval.experiments.results import Times, finished_results, write_result
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.tables import EXPERIMENTS

from .test_results import result

LAPTOP = SCALES["laptop"]


def all_cells(costs=Costs(), **chosen):  # noqa: B008 - frozen
    filters = {"tasks": (), "methods": (), "demos": (), "seeds": ()} | chosen
    return chosen_cells("all", LAPTOP, **filters, costs=costs)


def test_all_cells_are_those_of_every_experiment():
    cells = all_cells()
    assert len(cells) == len({cell.path for cell in cells})
    assert {cell.path for cell in cells} == {
        cell.path for experiment in EXPERIMENTS.values() for cell in select(experiment, LAPTOP)
    }


def test_the_tables_that_say_most_come_first():
    cells = all_cells()
    first = [cell for cell in cells if cell.experiment in ("table1", "table2") and cell.demonstrations == 10]
    assert cells[: len(first)] == first
    assert [cell.seed for cell in first] == sorted(cell.seed for cell in first)
    rank = {(cell.experiment, cell.task, cell.demonstrations, cell.seed): index for index, cell in enumerate(cells)}
    assert rank["table4", "drawer_opening", 5, 1] < rank["figure7", "block_picking", 10, 0]
    assert rank["figure5", "drawer_opening", 20, 2] < rank["table4", "drawer_opening", 5, 2]
    assert rank["figure7", "drawer_opening", 10, 2] < rank["table1", "block_picking", 50, 0]


def test_cheap_cells_come_before_dear_ones_of_the_same_seed():
    costs = Costs({("bc", "reproj_equi"): 90.0, ("bc",): 100.0, ("bc", "oracle_equi", "block_pushing"): 10.0})
    cells = [cell for cell in all_cells(costs, seeds=[0]) if cell.experiment == "table1"]
    assert [cells[0].row.name, cells[0].task] == ["oracle_equi", "block_pushing"]
    assert {cell.row.name for cell in cells[1:6]} == {"reproj_equi"}


def test_filters_apply_to_the_experiments_that_have_them():
    cells = all_cells(tasks=["block_pulling"])
    assert {cell.experiment for cell in cells} == {"figure5", "figure6"}
    assert {cell.experiment for cell in all_cells(methods=["reproj_equi_local"])} == {"table4"}
    assert {cell.demonstrations for cell in all_cells(demos=[5])} == {5}
    with pytest.raises(ValueError, match="--methods entry"):
        all_cells(methods=["reproj"])


def test_costs_are_medians_of_the_nearest_results(tmp_path):
    cells = select(EXPERIMENTS["table1"], LAPTOP, ["block_picking"], ["reproj_equi"], [10])
    cells += select(EXPERIMENTS["table1"], LAPTOP, ["block_pushing"], ["sideview_equi"], [10], [0])
    for cell, seconds in zip(cells, (90.0, 100.0, 400.0, 60.0), strict=True):
        write_result(
            tmp_path / cell.path, replace(result(cell.configuration_hash, seed=cell.seed), times=Times(cpu_s=seconds))
        )
    costs = Costs.measured(finished_results(tmp_path, "laptop"))

    def seconds(name, task, method):
        return costs.seconds(select(EXPERIMENTS[name], LAPTOP, [task], [method])[0])

    assert seconds("table1", "block_picking", "reproj_equi") == 100.0
    assert seconds("table4", "drawer_opening", "reproj_equi_local") == 100.0  # the same method, another task
    assert seconds("table1", "drawer_opening", "voxel_equi") == 95.0  # the median of all four
    assert seconds("figure5", "block_picking", "reproj_equi") is None  # no reinforcement learning was measured
    (cell,) = select(EXPERIMENTS["figure5"], LAPTOP, ["block_picking"], ["reproj_equi"], seeds=[0])
    for times, expected in ((Times(), None), (Times(cpu_s=300.0), 300.0)):  # the first has no processor time
        write_result(tmp_path / cell.path, replace(result(), times=times))
        costs = Costs.measured(finished_results(tmp_path, "laptop"))
        assert seconds("figure5", "block_picking", "oracle_equi") == expected


def test_costs_of_chunks_are_of_the_same_row(tmp_path):
    cells = select(EXPERIMENTS["chunks"], LAPTOP, ["block_picking"], ["flow_reproj_equi", "act_reproj"], seeds=[0])
    for cell, seconds in zip(cells, (300.0, 500.0), strict=True):
        write_result(tmp_path / cell.path, replace(result(cell.configuration_hash), times=Times(cpu_s=seconds)))
    costs = Costs.measured(finished_results(tmp_path, "laptop"))
    assert [costs.seconds(cell) for cell in cells] == [300.0, 500.0]
    (other,) = select(EXPERIMENTS["chunks"], LAPTOP, ["block_pushing"], ["act_reproj"], seeds=[0])
    assert costs.seconds(other) == 500.0
    (single,) = select(EXPERIMENTS["table1"], LAPTOP, ["block_picking"], ["reproj_equi"], [10], [0])
    assert costs.seconds(single) is None


def test_what_remains_counts_each_run_once():
    cells = all_cells(tasks=["block_stacking"], methods=["reproj_equi"], demos=[10], seeds=[0])
    assert [cell.experiment for cell in cells] == [
        "table1",
        "table3",
        "table4",
        "transfer",
        "robustness",
        "lens",
        "hidden",
    ]
    assert len(distinct(cells)) == 4
    assert len({cell.training_hash for cell in cells}) == 1  # the others use the policy of the tables
    cells = cells[:3]
    assert remaining(cells, cells[1:], Costs({("bc",): 1800.0})) == [
        "table1: 1 of 1 cells have a result",
        "table3: 0 of 1 cells have a result",
        "table4: 0 of 1 cells have a result",
        "1 runs are left, which serve 2 cells: 0.5 hours of one core",
    ]
    assert "and 1 runs of unknown time" in remaining(cells, cells, Costs())[-1]
    assert len(remaining(cells, [], Costs())) == 3
