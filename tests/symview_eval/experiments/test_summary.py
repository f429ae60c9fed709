import math
from dataclasses import replace

import pytest

from symview_eval.experiments.grid import select
from symview_eval.experiments.plots import plot
from symview_eval.experiments.report import ReportConfig, report
from symview_eval.experiments.results import Checkpoint, write_result
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.summary import (
    is_current,
    method_pairs,
    order_probability,
    placement_entries,
    scales_with_results,
    table_entries,
)
from symview_eval.experiments.tables import EXPERIMENTS

from .test_results import result

TABLE, SCALE = EXPERIMENTS["table1"], SCALES["laptop"]


def write(folder, method, *seeds):
    """Write results for block picking with 10 demonstrations; each seed is a list of successes of 20 episodes."""
    for seed, successes in enumerate(seeds):
        (cell,) = select(TABLE, SCALE, ["block_picking"], [method], [10], [seed])
        write_result(folder / cell.path, result(cell.configuration_hash, successes, seed))


def test_best_last_and_mean_of_the_last_five(tmp_path):
    write(tmp_path, "reproj_equi", [20, 2, 4, 6, 8, 10], [0, 2, 4, 16, 8, 10])
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    assert entry.best.mean == pytest.approx((1.0 + 0.8) / 2)
    assert entry.last.mean == pytest.approx(0.5)
    assert entry.last_five.mean == pytest.approx((30 / 100 + 40 / 100) / 2)
    assert entry.episodes == 200
    assert entry.paper == pytest.approx(0.847)
    assert entry.difference == pytest.approx(0.9 - 0.847)


def test_a_camera_that_older_results_lack_is_shown_where_it_is_known(tmp_path):
    """The report is made of both, and says how many rows are of other settings."""
    experiment = EXPERIMENTS["robustness"]
    names = [name for name, _ in experiment.placements]
    for method, seed, known in (("reproj_equi", 0, names[1:]), ("reproj_equi", 1, names), ("persp_equi", 0, names[:3])):
        (cell,) = select(experiment, SCALE, ["block_picking"], [method], [10], [seed])
        points = [Checkpoint(2000, 15, 20, 0.7, math.nan, "", name) for name in known]
        configuration = cell.configuration_hash if known == names else "older"
        write_result(tmp_path / cell.path, replace(result(configuration, seed=seed), checkpoints=points))
    entries = placement_entries(experiment, "laptop", tmp_path)
    assert [set(entry.rates) for entry in entries] == [set(names), set(names[:3])]
    assert all(rate.mean == 0.75 for entry in entries for rate in entry.rates.values())
    page = report(ReportConfig(tmp_path, tmp_path / "report")).with_suffix(".md").read_text()
    assert "2 rows were computed with other settings" in page
    widths = {line.count("|") for line in page.splitlines() if line.startswith("|")}
    assert widths == {len(names) + 5}


def test_the_interval_over_seeds(tmp_path):
    write(tmp_path, "reproj_equi", [10], [12], [14])
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    half = 4.30265 * 0.1 / 3**0.5  # Student's, two degrees of freedom, standard deviation 0.1
    for estimate in (entry.best, entry.last, entry.last_five):
        assert (estimate.low, estimate.high) == pytest.approx((0.6 - half, 0.6 + half), abs=1e-4)


def test_the_interval_of_equal_seeds_is_that_of_their_episodes(tmp_path):
    write(tmp_path, "reproj_equi", [10], [10], [10])
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    for estimate in (entry.best, entry.last, entry.last_five):
        assert (estimate.low, estimate.high) == pytest.approx((0.3774, 0.6226), abs=1e-3)  # Wilson, 30 of 60


def test_the_interval_of_one_seed_is_that_of_its_episodes(tmp_path):
    write(tmp_path, "reproj_equi", [10, 4])
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    assert str(entry.best) == "50.0 (30 to 70)"
    assert str(entry.last) == "20.0 (8 to 42)"


def test_pairs_have_the_papers_order(tmp_path):
    write(tmp_path, "oracle_equi", [19])  # paper: 77.8
    write(tmp_path, "reproj_equi", [18])  # 84.7
    write(tmp_path, "sideview_nonequi", [4])  # 56.2
    pairs = method_pairs(table_entries(TABLE, "laptop", tmp_path))
    assert {(pair.better.row.name, pair.worse.row.name, pair.measured_difference > 0) for pair in pairs} == {
        ("reproj_equi", "oracle_equi", False),
        ("reproj_equi", "sideview_nonequi", True),
        ("oracle_equi", "sideview_nonequi", True),
    }


@pytest.mark.parametrize(
    ("better", "worse", "probability"),
    [
        (["1111100000"], ["0000000000"], 1.0),
        (["0000000000"], ["1111100000"], 0.0),
        (["1010101010"], ["1010101010"], 0.5),  # no scene tells them apart
        (["1111100000"], ["0000011111"], 0.5),
        (["1111111000", "11"], ["1111000000"], 0.985),  # three scenes of ten: at least one is drawn, 1 - 0.7^10 + half
        (["1100"], ["0000", "0000"], 0.969),  # 1 - 2^-4 + half of it
        ([""], [""], None),
        ([], ["1"], None),
    ],
)
def test_the_probability_of_an_order_is_paired_over_scenes(better, worse, probability):
    def results(outcomes):
        return [
            replace(result(seed=seed), checkpoints=[Checkpoint(1, text.count("1"), len(text), 0.0, 0.0, text)])
            for seed, text in enumerate(outcomes)
        ]

    measured = order_probability(results(better), results(worse))
    assert math.isnan(measured) if probability is None else measured == pytest.approx(probability, abs=0.01)


def test_seeds_that_disagree_lower_the_probability():
    def results(*outcomes):
        return [
            replace(result(seed=seed), checkpoints=[Checkpoint(1, text.count("1"), len(text), 0.0, 0.0, text)])
            for seed, text in enumerate(outcomes)
        ]

    agree = order_probability(results("1" * 9 + "0" * 11, "1" * 9 + "0" * 11), results("0" * 20, "0" * 20))
    disagree = order_probability(results("1" * 19 + "0", "0" * 20), results("0" * 20, "1" + "0" * 19))
    assert agree == 1.0
    assert disagree == pytest.approx(0.75 + 0.25 * 0.95**40 / 2, abs=0.01)  # a quarter draws the second seed twice


def test_a_missing_seed_is_ignored(tmp_path):
    (cell,) = select(TABLE, SCALE, ["block_picking"], ["reproj_equi"], [10], [1])
    write_result(tmp_path / cell.path, result(cell.configuration_hash, seed=1))
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    assert is_current(entry, TABLE, "laptop")


def test_learning_curves_end_with_the_shortest_seed(tmp_path):
    figure5 = EXPERIMENTS["figure5"]
    for seed, successes in enumerate([[1, 2, 3], [1, 2]]):
        (cell,) = select(figure5, SCALE, ["block_picking"], ["reproj_equi"], (), [seed])
        write_result(tmp_path / cell.path, result(cell.configuration_hash, successes, seed))
    figure = plot(figure5, "laptop", table_entries(figure5, "laptop", tmp_path))
    assert list(figure.axes[0].lines[0].get_xdata()) == [200, 400]
    assert "scale laptop" in figure.get_suptitle()
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["2 seeds"]
    assert legend(figure) == ["Reproj. Equi", "standard deviation of the seeds"]


def test_a_learning_curve_of_one_seed_has_no_band(tmp_path):
    figure5 = EXPERIMENTS["figure5"]
    (cell,) = select(figure5, SCALE, ["block_picking"], ["reproj_equi"], (), [0])
    write_result(tmp_path / cell.path, result(cell.configuration_hash, [1, 2, 3], 0))
    assert legend(plot(figure5, "laptop", table_entries(figure5, "laptop", tmp_path))) == ["Reproj. Equi"]


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


@pytest.mark.parametrize(
    ("experiment", "successes", "shown"),
    [
        ("table1", [10], ["mean and 95 % interval", "paper, best checkpoint"]),
        (
            "table1",
            [10, 12],
            ["last five checkpoints, mean and 95 % interval", "best checkpoint", "paper, best checkpoint"],
        ),
        ("hidden", [10], ["mean and 95 % interval"]),
        ("figure7", [10], ["Oracle Equi", "Oracle Equi (RGB)"]),
    ],
)
def test_a_legend_names_what_is_drawn(experiment, successes, shown, tmp_path):
    """One evaluation has no best checkpoint, and the paper has no value of our own experiments."""
    experiment = EXPERIMENTS[experiment]
    methods = [row.name for row in experiment.rows if row.name.startswith("oracle")]
    for cell in select(experiment, SCALE, ["block_picking"], methods, [10], [0]):
        write_result(tmp_path / cell.path, result(cell.configuration_hash, successes))
    assert legend(plot(experiment, "laptop", table_entries(experiment, "laptop", tmp_path))) == shown


def test_results_with_other_settings_are_not_current(tmp_path):
    write(tmp_path, "reproj_equi", [10])
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    assert is_current(entry, TABLE, "laptop")
    (cell,) = select(TABLE, SCALE, ["block_picking"], ["reproj_equi"], [10], [0])
    write_result(tmp_path / cell.path, result("another"))
    (entry,) = table_entries(TABLE, "laptop", tmp_path)
    assert not is_current(entry, TABLE, "laptop")
    assert scales_with_results(TABLE, tmp_path) == ["laptop"]
