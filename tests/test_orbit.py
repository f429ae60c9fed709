"""The script that renders the README's animation."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytestmark = pytest.mark.long

SCRIPT = Path(__file__).parent.parent / "tools" / "orbit.py"


@pytest.fixture(scope="module")
def orbit():
    spec = importlib.util.spec_from_file_location("orbit", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def frames_of(path):
    with Image.open(path) as animation:
        for index in range(animation.n_frames):
            animation.seek(index)
            yield np.asarray(animation.convert("RGB"), dtype=int)


def test_side_image_changes_more_than_the_topdown_view(orbit, tmp_path):
    size = 96
    orbit.main(tmp_path / "orbit.gif", frames=4, size=size, frames_per_second=10)
    first, second, *_ = frames = list(frames_of(tmp_path / "orbit.gif"))
    assert len(frames) == 4
    rows, left = slice(orbit.MARGIN, orbit.MARGIN + size), size + 2 * orbit.MARGIN
    changed = (np.abs(first - second).max(axis=-1) > 24)[rows]
    assert changed[:, orbit.MARGIN : left - orbit.MARGIN].mean() > 2 * changed[:, left : left + size].mean()


def test_animation_is_deterministic(orbit, tmp_path):
    for name in ("first.gif", "second.gif"):
        orbit.main(tmp_path / name, frames=2, size=48, frames_per_second=10)
    assert (tmp_path / "first.gif").read_bytes() == (tmp_path / "second.gif").read_bytes()
