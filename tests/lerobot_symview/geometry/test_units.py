import numpy as np
import pytest
import torch

from lerobot_symview.geometry.units import METRES, MILLIMETRES, infer_depth_unit


@pytest.mark.parametrize("array", [np.asarray, torch.from_numpy], ids=["numpy", "torch"])
@pytest.mark.parametrize(("valid", "unit"), [(700.0, MILLIMETRES), (0.7, METRES)])
@pytest.mark.parametrize("minimum", [0.0, 0.01, 10.0])
def test_pixels_that_a_depth_video_has_lost_do_not_decide_the_unit(array, valid, unit, minimum):
    depth = np.full((10, 10), minimum, np.float32)
    depth[0, :3] = valid
    assert infer_depth_unit(array(depth)) == unit


def test_integers_are_millimetres():
    assert infer_depth_unit(np.full((2, 2), 3, np.uint16)) == MILLIMETRES
