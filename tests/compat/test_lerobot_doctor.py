"""`lerobot-doctor`, a judge from the registry, on our datasets: no check fails, and every warning is known.

`README.md` of this folder explains the warnings.
"""

import re
from pathlib import Path

import pytest
from lerobot_doctor.dataset_loader import load_dataset
from lerobot_doctor.merge_check import check_merge_compatibility
from lerobot_doctor.runner import Severity, run_checks

from lerobot_symview.geometry.placement import CameraSpec
from symview_sim.generate import GenerateConfig, RecordedEnv, generate
from symview_sim.settings import NewDataset

pytestmark = pytest.mark.long

EXPLAINED = (
    r"^observation\.camera\.\w+\.(intrinsics|world_from_cam)(\[\d+\])?: (zero variance|ALL \d+ dimensions constant)",
    r"shorter than (16 frames|chunk_size=\d+)|too short",
    r"^action\[\d+\]: [\d.]+% of values at (minimum|maximum)|of action frozen|identical actions \(frozen\)",
    r"^action\[\d+\]: stuck/static in",
    r"episode\(s\) flagged|more flagged episodes",
)
"""Patterns of known warnings, in the order of the table in README.md."""


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    root = tmp_path_factory.mktemp("video") / "data"
    env = RecordedEnv(camera=CameraSpec(height=64, width=64), oracle=False)
    return generate(GenerateConfig(NewDataset("test/video", root), env=env, num_episodes=2, video=True))


@pytest.mark.parametrize("dataset", ["recorded", "with_views", "video"])
def test_no_check_fails_and_every_warning_is_explained(dataset, request):
    report = run_checks(load_dataset(str(request.getfixturevalue(dataset))))
    assert len(report.results) == 11
    failed = [result.messages for result in report.results if result.severity == Severity.FAIL]
    assert not failed
    warnings = [message.message for result in report.results for message in result.messages
                if message.severity == Severity.WARN]  # fmt: skip
    unknown = [warning for warning in warnings if not any(re.search(known, warning) for known in EXPLAINED)]
    assert not unknown


def test_recordings_of_other_cameras_and_seeds_may_be_merged(recorded, tmp_path):
    env = RecordedEnv(camera=CameraSpec(azimuth_deg=30.0))
    other = generate(GenerateConfig(NewDataset("test/other", tmp_path / "other"), env=env, num_episodes=1, seed=5))
    result = check_merge_compatibility([Path(recorded), other])
    assert result.compatible, vars(result)
