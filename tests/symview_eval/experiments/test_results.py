import math

import pytest

from symview_eval.experiments.grid import select
from symview_eval.experiments.results import (
    Checkpoint,
    Origin,
    Result,
    Times,
    copy_shared,
    finished_results,
    read_result,
    unfinished_cells,
    write_result,
)
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.tables import EXPERIMENTS

SCALE = SCALES["laptop"]


def result(configuration="0123456789abcdef", successes=(3, 17), seed=0):
    checkpoints = [
        Checkpoint(200 * i, count, 20, 0.125 * i, 0.5, "1" * count + "0" * (20 - count))
        for i, count in enumerate(successes, start=1)
    ]
    return Result(
        Origin(configuration, seed, "0.1.0", "Linux x86_64, 2 cores", 101.5, "cpu"), Times(1.0, 90.0), checkpoints
    )


def cells(name):
    return select(EXPERIMENTS[name], SCALE, ["block_stacking"], ["reproj_equi"], [10], [0])


def test_a_result_file_round_trip(tmp_path):
    path = tmp_path / "table1" / "0.csv"
    write_result(path, result())
    read = read_result(path)
    assert (read.origin, read.checkpoints) == (result().origin, result().checkpoints)
    assert read.times.training_s == 90.0
    assert math.isnan(read.times.cpu_s)
    assert [file.name for file in path.parent.iterdir()] == ["0.csv"]


@pytest.mark.parametrize("text", ["", "step,successes\n1,2\n", "# configuration: a\nstep\nx\n"])
def test_a_file_without_results_is_refused(text, tmp_path):
    (tmp_path / "0.csv").write_text(text)
    with pytest.raises(ValueError, match=r"0.csv is not a result of symview-experiment"):
        read_result(tmp_path / "0.csv")


def test_a_finished_cell_is_not_run_again(tmp_path):
    (cell,) = cells("table1")
    assert unfinished_cells([cell], finished_results(tmp_path, SCALE.name)) == [cell]
    write_result(tmp_path / cell.path, result(cell.configuration_hash))
    assert unfinished_cells([cell], finished_results(tmp_path, SCALE.name)) == []


def test_a_cell_with_other_settings_is_run_again(tmp_path):
    (cell,) = cells("table1")
    write_result(tmp_path / cell.path, result("another"))
    finished = finished_results(tmp_path, SCALE.name)
    assert unfinished_cells([cell], finished) == [cell]
    copy_shared([cell], tmp_path, finished)
    assert read_result(tmp_path / cell.path).origin.configuration == "another"


def test_a_result_of_another_table_is_copied(tmp_path):
    (cell,), (equal_cell,) = cells("table1"), cells("table4")
    write_result(tmp_path / cell.path, result(cell.configuration_hash))
    finished = finished_results(tmp_path, SCALE.name)
    assert unfinished_cells([equal_cell], finished) == []
    copy_shared([equal_cell], tmp_path, finished)
    assert read_result(tmp_path / equal_cell.path).checkpoints == result().checkpoints
