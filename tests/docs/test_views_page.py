"""The tables and numbers in docs/views.md match the code."""

import re
from dataclasses import fields

import numpy as np
import pytest

from lerobot_symview.views import PerspectiveView, ReprojectedView
from tests.docs.pages import ROOT


@pytest.mark.parametrize("view", [ReprojectedView, PerspectiveView])
def test_every_view_option_is_listed_with_its_default(view):
    page = (ROOT / "docs" / "views.md").read_text()
    for option in fields(view):
        default = f"{option.default:g}" if isinstance(option.default, float) else str(option.default).lower()
        default = "[]" if option.default == () else default
        assert re.search(rf"^\| `{option.name}` \| `?{re.escape(default)}`? \|", page, re.MULTILINE), option.name


def test_clipping_height_matches_the_page():
    heights = np.array([0.0, 0.05, 0.07, 0.2])
    assert [ReprojectedView().ceiling(z) for z in heights] == np.maximum(heights - 0.01, 0.06).tolist()
    assert [ReprojectedView(clip_margin=0, clip_floor=0).ceiling(z) for z in heights] == heights.tolist()
