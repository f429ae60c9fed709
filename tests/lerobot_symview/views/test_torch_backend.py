"""Batched views are bit-identical to the compiled kernels, on the CPU and, if there is one, on a GPU."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_symview.geometry.infill import nearest_known
from lerobot_symview.geometry.lens import Lens
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import Frame, make_view
from lerobot_symview.views.torch_backend import FrameBatch, can_batch, nearest_known_batch, render_batch
from tests.helpers.cameras import MASKS, SHAPE, cameras, make_camera, random_depth

SIZE = 24
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
OPTIONS = [
    ("reproj", {"infill": "nearest", "mask": True}),
    ("reproj", {"infill": "none", "clip": "none"}),
    ("reproj", {"infill": "none", "clip": 0.05, "height": False}),
    ("persp", {}),
    ("persp", {"plane_height": "gripper", "gripper": False}),
    ("reproj", {"flying_limit": 0.05}),
    ("reproj", {"lowest": 0.02, "clip": 0.3}),
    ("reproj", {"cameras": ["left", "back"]}),
    ("persp", {"cameras": ["left", "back"]}),
]
OTHERS = {"left": make_camera(azimuth=80, size=40), "back": make_camera(azimuth=190, elevation=30, size=56)}


def frames_of(views, seed):
    """One frame per camera, with those of `OTHERS`; half of the rows are rounded, so that many heights are equal.

    In every other frame, the camera `left` delivers nothing.
    """
    rng = np.random.default_rng(seed)
    for index, camera in enumerate(views):
        gripper = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.0, 0.1), rng.uniform(-2, 2), rng.random()])
        gripper = gripper.astype(np.float32)
        others = {name: random_frame(other, gripper, rng) for name, other in OTHERS.items()}
        if index % 2:
            left = others["left"]
            others["left"] = replace(left, rgb=np.zeros_like(left.rgb), depth=np.zeros_like(left.depth))
        yield replace(random_frame(camera, gripper, rng), others=others)


def random_frame(camera, gripper, rng):
    shape = (camera.height, camera.width)
    depth = random_depth(int(rng.integers(2**31)), shape).astype(np.float32)
    depth[::2] = np.round(depth[::2], 1)
    return Frame(rng.integers(0, 256, (*shape, 3), dtype=np.uint8), depth, camera, Workspace(), gripper)


def batch_of(frames, device):
    others = {name: batch_of([frame.others[name] for frame in frames], device) for name in frames[0].others}
    return FrameBatch(
        torch.from_numpy(np.stack([frame.rgb for frame in frames])).permute(0, 3, 1, 2).contiguous().to(device),
        torch.from_numpy(np.stack([frame.depth for frame in frames])).to(device),
        [frame.camera for frame in frames],
        frames[0].workspace,
        torch.from_numpy(np.stack([frame.gripper for frame in frames])).to(device),
        others,
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("name", "options"), OPTIONS)
@given(views=st.lists(cameras(), min_size=2, max_size=2), seed=st.integers(0, 2**32 - 1))
def test_batches_are_bit_identical_to_single_frames(name, options, device, views, seed):
    view, frames = make_view(name, size=SIZE, **options), list(frames_of(views, seed))
    try:
        expected = [view.render(frame) for frame in frames]
    except ValueError:  # the plane is behind the camera or edge-on: the batch raises the same error
        with pytest.raises(ValueError, match=r"workspace|plane"):
            render_batch(view, batch_of(frames, device))
        return
    images = render_batch(view, batch_of(frames, device))
    assert list(images) == list(view.outputs)
    for output, stacked in images.items():
        for single, image in zip(expected, stacked.cpu().numpy(), strict=True):
            np.testing.assert_array_equal(image.transpose(1, 2, 0) if image.ndim == 3 else image, single[output])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("name", "options"), OPTIONS)
@pytest.mark.parametrize("coefficients", [((-0.2, 0.05, 0.001, 0.0),) * 2, ((-0.2, 0.05, 0.001, 0.0), None)])
def test_batches_through_lenses_are_bit_identical_to_single_frames(name, options, device, coefficients):
    """Of one lens, and of a camera with and one without."""
    view, camera = make_view(name, size=SIZE, **options), make_camera(elevation=60)
    camera = replace(camera.resized(SHAPE[0], SHAPE[0]), width=SHAPE[1])
    lenses = [values and Lens("plumb_bob", values) for values in coefficients]
    frames = list(frames_of([replace(camera, lens=lens) for lens in lenses], 0))
    images = render_batch(view, batch_of(frames, device))
    for index, frame in enumerate(frames):
        for output, single in view.render(frame).items():
            image = images[output][index].cpu().numpy()
            np.testing.assert_array_equal(image.transpose(1, 2, 0) if image.ndim == 3 else image, single)


@pytest.mark.parametrize("device", DEVICES)
@given(known=MASKS.filter(np.any))
def test_batched_nearest_pixels_equal_the_compiled_kernel(device, known):
    batch = torch.from_numpy(np.stack([known, np.zeros_like(known)])).to(device)
    found = nearest_known_batch(batch).cpu().numpy()
    np.testing.assert_array_equal(found[0], nearest_known(known))
    assert not found[1].any()


def colored_batch(**changes):
    """Two small black frames without depth."""
    images = {"rgb": torch.zeros(2, 3, 8, 8, dtype=torch.uint8), "depth": None}
    return FrameBatch(**{**images, "cameras": [make_camera(size=8)] * 2, "workspace": Workspace(), **changes})


@pytest.mark.parametrize("options", [{"infill": "local"}, {"source_scale": 2}])
def test_views_that_cannot_be_batched_raise_an_error(options):
    view = make_view("reproj", **options)
    assert not can_batch(view)
    batch = colored_batch()
    with pytest.raises(ValueError, match="frame by frame"):
        render_batch(view, batch)


def test_missing_depth_or_gripper_state_raises_an_error():
    batch = colored_batch()
    with pytest.raises(ValueError, match="needs depth"):
        render_batch(make_view("reproj"), batch)
    with pytest.raises(ValueError, match="gripper"):
        render_batch(make_view("persp", plane_height="gripper"), batch)


def test_without_gripper_state_there_is_no_gripper_image():
    batch = colored_batch()
    images = render_batch(make_view("persp"), batch)
    assert list(images) == ["persp"]
    assert torch.equal(images["persp"], render_batch(make_view("persp", gripper=False), batch)["persp"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rgb": torch.zeros(2, 8, 8, 3, dtype=torch.uint8)}, r"rgb must be \(B, 3, H, W\) uint8, got \(2, 8, 8, 3\)"),
        ({"rgb": torch.zeros(2, 3, 8, 8)}, "rgb must be .*uint8.*float32"),
        ({"rgb": torch.zeros(2, 3, 6, 8, dtype=torch.uint8)}, r"rgb has 6 x 8 pixels, the cameras have \[\(8, 8\)\]"),
        ({"cameras": [make_camera(size=8)]}, "2 frames need 2 cameras, got 1"),
        ({"cameras": [make_camera(size=8), make_camera(size=6)]}, r"8 x 8 pixels, .*\(6, 6\)"),
        ({"depth": torch.zeros(2, 1, 8, 8)}, r"depth must be \(2, 8, 8\) .*got \(2, 1, 8, 8\)"),
        ({"depth": torch.zeros(2, 8, 8, dtype=torch.int32)}, "depth must be .*float metres.*int32"),
    ],
)
def test_batches_with_wrong_shapes_or_dtypes_are_rejected(changes, message):
    with pytest.raises(ValueError, match=message):
        colored_batch(**changes)


@pytest.mark.parametrize("options", [{}, {"plane_height": "gripper"}])
def test_a_non_finite_gripper_state_is_rejected(options):
    gripper = torch.tensor([[0.0, 0.0, 0.2, 0.0, 1.0], [0.0, 0.0, torch.nan, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"gripper.*must be finite, got .*nan"):
        render_batch(make_view("persp", **options), colored_batch(gripper=gripper))
