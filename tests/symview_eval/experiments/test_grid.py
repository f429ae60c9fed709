from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from symview_eval.experiments.actors import policy_config, sight
from symview_eval.experiments.grid import select
from symview_eval.experiments.results import read_result
from symview_eval.experiments.scale import SCALES
from symview_eval.experiments.summary import paper_values
from symview_eval.experiments.tables import EXPERIMENTS

LAPTOP = SCALES["laptop"]


def cells(name, scale=LAPTOP, **chosen):
    return select(EXPERIMENTS[name], scale, **chosen)


def single_cell(name, task, method, demonstrations=10):
    (cell,) = cells(name, tasks=[task], methods=[method], demos=[demonstrations], seeds=[0])
    return cell


@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_row_configures_a_policy(name, scale):
    for row in EXPERIMENTS[name].rows:
        cell = cells(name, scale, methods=[row.name])[0]
        if cell.algorithm == "sacfd":
            policy = SymviewSacfdConfig(device="cpu", **scale.policy(cell.algorithm), **row.policy)
        else:
            policy = sight(cell, "cpu")
            assert policy_config(cell, "cpu").type == cell.policy_type
        assert policy.method == row.policy["method"]
        assert policy.crop_size == scale.crop_size
        if policy.is_computed and cell.algorithm == "bc":
            options = policy.views_to_make[0].options
            assert options["size"] == policy.image_size
            assert row.policy.get("view_options", {}).items() <= options.items()


@pytest.mark.parametrize("cell", cells("transfer", seeds=[0], tasks=["block_picking"]), ids=lambda cell: cell.row.name)
def test_a_varying_camera_changes_nothing_else_of_a_row(cell):
    varying = single_cell("transfer", "block_picking", f"{cell.row.name.removesuffix('_varying')}_varying")
    assert varying.row.camera.varies
    assert (varying.policy_type, varying.steps) == (cell.policy_type, cell.steps)
    assert varying.row.policy == cell.row.policy


def test_what_lerobots_policies_see_is_part_of_their_configuration():
    (cell,) = cells("chunks", methods=["act_reproj"], tasks=["block_picking"], seeds=[0], demos=[25])
    larger = replace(cell, scale=replace(cell.scale, crop_size=128))
    assert larger.configuration_hash != cell.configuration_hash


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_result_paths_are_unique(name):
    chosen = cells(name)
    assert len({cell.path for cell in chosen}) == len(chosen)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_tables_tell_the_rows_apart(name):
    rows = EXPERIMENTS[name].rows
    assert len({row.label for row in rows}) == len(rows)


OWN_ROWS = {"reproj_equi_occlusion", "reproj_equi_splat"}  # in a table of the paper's, but not in the paper


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if paper_values(name)])
def test_every_row_has_a_paper_value(name):
    in_paper = set(paper_values(name))
    in_table = {(cell.task, cell.demonstrations, cell.row.name) for cell in cells(name, seeds=[0])}
    missing = {("block_stacking", 50, "voxel_equi")} if name == "table1" else set()  # the paper prints a dash
    assert in_paper == {cell for cell in in_table - missing if cell[2] not in OWN_ROWS}


def test_paper_values():
    assert paper_values("table1")["block_picking", 10, "reproj_equi"] == pytest.approx(0.847)
    assert paper_values("table1")["block_in_bowl", 50, "sideview_nonequi"] == pytest.approx(0.45)
    assert paper_values("table2")["block_stacking", 50, "persp_equi"] == pytest.approx(0.567)
    assert paper_values("table3")["drawer_opening", 10, "persp_equi_relaxed"] == pytest.approx(0.631)
    assert paper_values("table4")["block_stacking", 5, "reproj_equi_local"] == pytest.approx(0.06)
    assert paper_values("table5")["block_in_bowl", 10, "persp_equi_broken_dynamic"] == pytest.approx(0.005)
    assert not paper_values("figure7")


def test_equal_cells_of_two_tables_share_a_configuration():
    shared = single_cell("table1", "block_stacking", "reproj_equi").configuration_hash
    assert shared == single_cell("table3", "block_stacking", "reproj_equi").configuration_hash
    assert shared == single_cell("table4", "block_stacking", "reproj_equi").configuration_hash
    assert shared == single_cell("figure7", "block_stacking", "reproj_equi_45deg").configuration_hash
    assert shared != single_cell("figure7", "block_stacking", "reproj_equi_30deg").configuration_hash
    assert shared != single_cell("table4", "block_stacking", "reproj_equi_local").configuration_hash


def test_a_setting_that_pinhole_cameras_do_not_have_leaves_finished_results_valid():
    """A new option of cameras must not make the evaluations of other placements run again."""
    cell = single_cell("transfer", "block_picking", "persp_equi")
    finished = read_result(Path(__file__).parents[3] / "results" / cell.path)
    assert cell.configuration_hash == finished.origin.configuration


def test_methods_share_demonstrations():
    chosen = cells("table1", tasks=["block_picking"], demos=[10], seeds=[0])
    assert len(chosen) == 6
    assert len({cell.recording for cell in chosen}) == 1


def test_chunks_are_of_fine_control_and_share_demonstrations_and_policies():
    chunks, planned, moved, single = (
        single_cell(*chosen, "block_picking", method, 25)
        for *chosen, method in (
            ("chunks", "flow_reproj_equi"),
            ("chunks_planner", "flow_reproj_equi"),
            ("chunks_moved", "flow_reproj_equi"),
            ("table1", "reproj_equi"),
        )
    )
    assert chunks.recording == moved.recording == "block_picking_fine_human_45deg_25_seed0"
    assert planned.recording == "block_picking_fine_45deg_25_seed0"
    assert chunks.training_hash == moved.training_hash
    assert chunks.configuration_hash != moved.configuration_hash
    assert len({cell.training_hash for cell in (chunks, planned, single)}) == 3
    assert (chunks.max_steps, single.max_steps) == (200, 50)
    assert single_cell("chunks", "block_stacking", "flow_reproj_equi").steps == 2 * chunks.steps


def test_rl_uses_the_papers_demonstrations_and_steps():
    paper = {cell.task: cell for cell in cells("figure5", SCALES["paper"], seeds=[0])}
    assert {task: (cell.demonstrations, cell.steps) for task, cell in paper.items()} == {
        "block_picking": (20, 5000),
        "block_pushing": (20, 5000),
        "block_pulling": (20, 5000),
        "drawer_opening": (20, 5000),
        "block_stacking": (50, 10000),
        "block_in_bowl": (50, 10000),
    }


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"tasks": ["block_piking"]}, "did you mean 'block_picking'"),
        ({"methods": ["persp_equi"]}, "--methods entry 'persp_equi'"),
    ],
)
def test_an_unknown_task_or_method_is_refused(chosen, message):
    with pytest.raises(ValueError, match=message):
        cells("table1", **chosen)
