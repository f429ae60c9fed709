"""The demo at its full size: what a newcomer is promised."""

import pytest

from symview_eval.demo import DemoConfig, demo
from symview_eval.report import read_success


@pytest.mark.slow
def test_the_demo_solves_its_task(tmp_path):
    config = DemoConfig(output_dir=tmp_path)
    demo(config)
    success = read_success(tmp_path / "evaluation")
    assert success.episodes == 50
    assert success.rate >= 0.6
