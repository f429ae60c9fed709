from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest

from lerobot_symview.errors import OptionError
from lerobot_symview.geometry.camera import Camera
from lerobot_symview.geometry.workspace import Workspace
from lerobot_symview.views import VIEWS, Frame, ViewSpec, make_view, make_views, register_view, reproject, warp_table
from lerobot_symview.views.reprojection import INFILLS
from tests.helpers.cameras import make_camera, make_frame, plane_depth

SIZE = 32
CENTRE = (0.45, 0.0)


def rotated(frame, quarter_turns):
    """The frame with camera, gripper and scene rotated about the workspace centre."""
    angle = quarter_turns * np.pi / 2
    rotation = np.eye(4)
    rotation[:2, :2] = np.rint([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([*CENTRE, 0.0])
    rotation[:3, 3] = centre - rotation[:3, :3] @ centre
    gripper = frame.gripper.copy()
    gripper[:2] = rotation[:2, :2] @ gripper[:2]
    gripper[3] += angle
    camera = Camera(frame.camera.intrinsics, rotation @ frame.camera.world_from_cam, *frame.rgb.shape[:2])
    return Frame(frame.rgb, frame.depth, camera, frame.workspace, gripper)


@pytest.mark.parametrize("name", list(VIEWS))
def test_outputs_have_the_declared_kinds_and_size(name):
    view = make_view(name, size=SIZE)
    images = view.render(make_frame())
    assert list(images) == list(view.outputs)
    for output, kind in view.outputs.items():
        assert images[output].shape == ((SIZE, SIZE, 3) if kind == "rgb" else (SIZE, SIZE))
        assert images[output].dtype == (np.uint8 if kind == "rgb" else np.float32)


@pytest.mark.parametrize("name", list(VIEWS))
def test_a_view_is_a_pure_function(name):
    frame = make_frame()
    before = frame.rgb.copy(), frame.depth.copy()
    first, second = (make_view(name, size=SIZE).render(frame) for _ in range(2))
    for output in first:
        np.testing.assert_array_equal(first[output], second[output])
    np.testing.assert_array_equal(frame.rgb, before[0])
    np.testing.assert_array_equal(frame.depth, before[1])


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
@pytest.mark.parametrize(
    ("name", "options"),
    [("reproj", {"infill": "none"}), ("reproj", {"infill": "none", "clip_radius": 0.07}), ("persp", {})],
)
def test_views_rotate_with_camera_and_gripper(name, options, quarter_turns):
    view = make_view(name, size=SIZE, **options)
    frame = make_frame(gripper=(0.05, -0.08, 0.2, 0.3, 0.8))
    for output, image in view.render(rotated(frame, quarter_turns)).items():
        expected = np.rot90(view.render(frame)[output], quarter_turns).astype(float)
        # the warp interpolates in fixed point, so a grey level may differ; a point on a bin's edge may change bins
        assert (np.abs(image.astype(float) - expected) > (3 if name == "persp" else 1e-6)).mean() < 0.01


def test_reprojection_of_a_top_down_camera_is_its_image():
    size = 40
    camera = make_camera(90.0, size=size, fov=2 * np.rad2deg(np.arctan(0.2 / 0.81)))
    frame = make_frame(camera)
    flat = Frame(frame.rgb, np.full((size, size), 0.81, dtype=np.float32), camera, frame.workspace, frame.gripper)
    images = make_view("reproj", size=size).render(flat)
    np.testing.assert_array_equal(images["reproj"], frame.rgb)
    np.testing.assert_allclose(images["reproj_height"], 0.0, atol=1e-6)


def test_points_above_the_gripper_are_removed():
    frame = make_frame(gripper=(0.0, 0.0, 0.1, 0.0, 1.0))
    free = make_view("reproj", size=SIZE, clip="none").render(frame)["reproj_height"]
    cut = make_view("reproj", size=SIZE).render(frame)["reproj_height"]
    assert free.max() > 0.09
    assert cut.max() <= 0.09 + 1e-6


def test_with_a_clip_radius_points_beside_the_gripper_are_kept():
    """Two towers are higher than the gripper: the one over it is the arm."""
    camera = make_camera(90.0, size=SIZE, fov=2 * np.rad2deg(np.arctan(0.2 / 0.81)))
    rgb = np.zeros((SIZE, SIZE, 3), np.uint8)
    depth = np.full((SIZE, SIZE), 0.81, np.float32)
    depth[4:6, 4:6], depth[24:26, 24:26] = 0.66, 0.66
    xy = Workspace().xy_from_pixel(np.array([4.5, 4.5]), SIZE) - CENTRE
    frame = Frame(rgb, depth, camera, Workspace(), np.array([*xy, 0.1, 0.0, 1.0]))
    height = make_view("reproj", size=SIZE, clip_radius=0.1, infill="none").render(frame)["reproj_height"]
    assert height[: SIZE // 2, : SIZE // 2].max() < 1e-6
    assert height[SIZE // 2 :, SIZE // 2 :].max() > 0.14
    assert make_view("reproj", size=SIZE, infill="none").render(frame)["reproj_height"].max() < 1e-6
    unknown = replace(frame, gripper=None)
    assert make_view("reproj", size=SIZE, clip_radius=0.1, infill="none").render(unknown)["reproj_height"].max() > 0.14


def test_points_below_the_clip_floor_are_kept():
    frame = make_frame(gripper=(0.0, 0.0, 0.02, 0.0, 1.0))
    assert 0.03 < make_view("reproj", size=SIZE).render(frame)["reproj_height"].max() <= 0.06 + 1e-6


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_invalid_depth_gives_an_empty_view(bad):
    frame = make_frame()
    depth = np.full_like(frame.depth, bad)
    images = make_view("reproj", size=SIZE).render(
        Frame(frame.rgb, depth, frame.camera, frame.workspace, frame.gripper)
    )
    assert images["reproj"].max() == 0
    assert images["reproj_height"].max() == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rgb": np.zeros((48, 96, 3), np.uint8)}, r"rgb must be \(96, 96, 3\) uint8 .*got \(48, 96, 3\)"),
        ({"rgb": np.zeros((96, 96, 4), np.uint8)}, r"rgb must be \(96, 96, 3\) uint8 .*got \(96, 96, 4\)"),
        ({"rgb": np.zeros((96, 96, 3), np.float32)}, "rgb must be .*uint8.*float32"),
        ({"depth": np.zeros((96, 48), np.float32)}, r"depth must be \(96, 96\) .*got \(96, 48\)"),
        ({"depth": np.zeros((96, 96, 1), np.float32)}, r"depth must be \(96, 96\) .*got \(96, 96, 1\)"),
        ({"depth": np.zeros((96, 96), bool)}, "depth must be .*float metres.*bool"),
        ({"gripper": np.array([0.0, 0.0, np.nan, 0.0, 1.0])}, "gripper.*must be finite, got .*nan"),
        ({"gripper": np.array([0.0, 0.0, 0.2, 0.0, np.inf])}, "gripper.*must be finite, got .*inf"),
        ({"gripper": np.array([450.0, 0.0, 200.0, 0.0, 1.0])}, "gripper's x is 450, expected metres relative to the w"),
        ({"gripper": np.array([0.0, 0.0, 200.0, 0.0, 1.0])}, "gripper's z is 200, expected metres above the table"),
        ({"gripper": np.array([0.0, 0.0, 0.2, 90.0, 1.0])}, "gripper's yaw is 90, expected radians"),
        ({"gripper": np.array([0.0, 0.0, 0.2, 0.0, 57.0])}, "gripper's aperture is 57, expected a fraction from 0 to"),
    ],
)
def test_frames_with_wrong_shapes_dtypes_or_gripper_states_are_rejected(wrong, message):
    with pytest.raises(ValueError, match=message):
        replace(make_frame(), **wrong)


def test_reprojection_without_depth_suggests_persp():
    frame = make_frame()
    with pytest.raises(ValueError, match="persp"):
        make_view("reproj").render(Frame(frame.rgb, None, frame.camera, frame.workspace, frame.gripper))


def test_an_unknown_view_error_suggests_the_closest_name():
    with pytest.raises(OptionError, match="did you mean 'reproj'"):
        make_view("reprojj")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("reproj", {"infill": "magic"}),
        ("reproj", {"clip": "high"}),
        ("reproj", {"size": 0}),
        ("reproj", {"source_scale": 0}),
        ("reproj", {"size": 76.5}),
        ("reproj", {"clip": np.nan}),
        ("reproj", {"clip": -np.inf}),
        ("reproj", {"clip_margin": np.nan}),
        ("reproj", {"clip_margin": np.inf}),
        ("reproj", {"clip_floor": np.nan}),
        ("reproj", {"clip_radius": -0.1}),
        ("reproj", {"clip_radius": np.inf}),
        ("reproj", {"clip_radius": 0.1, "clip": "none"}),
        ("reproj", {"clip_floor": -np.inf}),
        ("reproj", {"source_scale": 1.5}),
        ("reproj", {"source_scale": np.nan}),
        ("persp", {"plane_height": "table"}),
        ("persp", {"plane_height": np.nan}),
        ("persp", {"plane_height": np.inf}),
    ],
)
def test_invalid_options_are_rejected(name, options):
    with pytest.raises(OptionError, match=next(iter(options))):
        make_view(name, **options)


@pytest.mark.parametrize("name", list(VIEWS))
def test_rendered_outputs_are_the_declared_outputs(name):
    switches = [field.name for field in fields(VIEWS[name]) if isinstance(field.default, bool)]
    for values in product([False, True], repeat=len(switches)):
        options = dict(zip(switches, values, strict=True))
        if options.get("age") and not options["memory"]:  # refused
            continue
        view = make_view(name, size=SIZE, **options)
        assert list(view.render(make_frame())) == list(view.outputs)


@pytest.mark.parametrize("name", list(VIEWS))
def test_without_gripper_state_views_are_unclipped_and_have_no_gripper_image(name):
    view = make_view(name, size=SIZE)
    assert view.uses_gripper
    without = view.without_gripper()
    assert not without.uses_gripper
    frame = make_frame()
    expected = without.render(frame)
    assert list(expected) == list(without.outputs)
    for images in (view.render(replace(frame, gripper=None)), without.render(replace(frame, gripper=None))):
        assert images.keys() == expected.keys()
        for output, image in images.items():
            np.testing.assert_array_equal(image, expected[output])


def test_a_plane_that_follows_the_gripper_requires_its_state():
    view = make_view("persp", size=SIZE, plane_height="gripper")
    with pytest.raises(ValueError, match="plane_height=gripper needs the gripper's state"):
        view.render(replace(make_frame(), gripper=None))
    with pytest.raises(ValueError, match="plane_height=gripper needs the gripper's state"):
        view.without_gripper()


@pytest.mark.parametrize("gripper", [None, (0.05, -0.08, 0.2, 0.3, 0.8)])
def test_reproject_and_warp_table_equal_the_views(gripper):
    frame = replace(make_frame(), gripper=None if gripper is None else np.array(gripper))
    top = reproject(frame.rgb, frame.depth, frame.camera, frame.workspace, frame.gripper, size=SIZE)
    images = make_view("reproj", size=SIZE, mask=True).render(frame)
    np.testing.assert_array_equal(top.rgb, images["reproj"])
    np.testing.assert_array_equal(top.height, images["reproj_height"])
    np.testing.assert_array_equal(top.seen, images["reproj_seen"][..., 0] == 255)
    warped = warp_table(frame.rgb, frame.camera, frame.workspace, size=SIZE, plane_height=0.03)
    expected = make_view("persp", size=SIZE, plane_height=0.03, gripper=False).render(frame)["persp"]
    np.testing.assert_array_equal(warped, expected)


def test_integer_depth_is_millimetres():
    frame = make_frame()
    millimetres = np.rint(1000 * frame.depth).astype(np.uint16)
    views = [
        reproject(frame.rgb, depth, frame.camera, frame.workspace, size=SIZE)
        for depth in (millimetres, millimetres.astype(np.float32) / np.float32(1000))
    ]
    np.testing.assert_array_equal(views[0].height, views[1].height)


def test_an_unknown_option_error_lists_the_known_options():
    frame = make_frame()
    with pytest.raises(OptionError, match="the view 'reproj' has no option infil; it has size, infill"):
        reproject(frame.rgb, frame.depth, frame.camera, frame.workspace, infil="none")


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("reproj", ViewSpec("reproj")),
        ({"name": "persp", "plane_height": 0.025}, ViewSpec("persp", {"plane_height": 0.025})),
        (ViewSpec("persp"), ViewSpec("persp")),
    ],
)
def test_a_view_is_specified_by_name_or_mapping(entry, expected):
    assert ViewSpec.parse(entry) == expected
    assert ViewSpec.parse(expected.plain()) == expected


@pytest.mark.parametrize("entry", [3, None, {}, {"plane_height": 0.025}, {"name": 3}])
def test_invalid_view_specifications_are_rejected(entry):
    with pytest.raises(OptionError, match="a view must be a name or a mapping with a name and options"):
        ViewSpec.parse(entry)


@pytest.mark.parametrize(
    ("specs", "message"),
    [
        ([], "expected at least one view, got none"),
        ([ViewSpec("persp"), ViewSpec("persp")], "the view 'persp' is given twice"),
    ],
)
def test_empty_lists_and_repeated_views_are_rejected(specs, message):
    with pytest.raises(OptionError, match=message):
        make_views(specs)


def test_a_fixed_clip_height_ignores_the_gripper():
    for gripper_height in (0.02, 0.2):
        frame = make_frame(gripper=(0.0, 0.0, gripper_height, 0.0, 1.0))
        heights = make_view("reproj", size=SIZE, clip=0.03).render(frame)["reproj_height"]
        assert 0.02 < heights.max() <= 0.03 + 1e-6


def test_an_infinite_clip_height_removes_no_point():
    frame = make_frame()
    expected = make_view("reproj", size=SIZE, clip="none").render(frame)
    for output, image in make_view("reproj", size=SIZE, clip=np.inf).render(frame).items():
        np.testing.assert_array_equal(image, expected[output])


def test_the_plane_follows_the_gripper_with_plane_height_gripper():
    frame = make_frame(gripper=(0.0, 0.0, 0.07, 0.0, 1.0))
    following = make_view("persp", size=SIZE, plane_height="gripper").render(frame)["persp"]
    np.testing.assert_array_equal(
        following, make_view("persp", size=SIZE, plane_height=float(frame.gripper[2])).render(frame)["persp"]
    )
    assert (following != make_view("persp", size=SIZE).render(frame)["persp"]).any()


def table_frame(camera, dtype=np.float32):
    """The empty table, with a random colour at each pixel."""
    rgb = np.random.default_rng(0).integers(1, 256, (camera.height, camera.width, 3), dtype=np.uint8)
    return Frame(rgb, plane_depth(camera).astype(dtype), camera, Workspace(), np.array([0.0, 0.0, 0.3, 0.0, 1.0]))


def test_upsampling_the_source_closes_gaps_in_surfaces():
    frame = table_frame(make_camera(45.0))
    shares = [
        (make_view("reproj", source_scale=scale, mask=True).render(frame)["reproj_seen"] > 0).mean()
        for scale in (1, 2, 4)
    ]
    assert shares[0] < 0.5  # at 45 degrees an image of the same size has fewer points than the view has pixels
    assert shares[0] < shares[1] < shares[2]
    assert shares[2] == 1.0


@pytest.mark.parametrize("scale", [1, 3])
def test_the_mask_separates_measured_from_infilled_pixels(scale):
    frame = make_frame()
    options = {"size": SIZE, "source_scale": scale, "mask": True}
    bare = make_view("reproj", infill="none", **options).render(frame)
    filled = make_view("reproj", **options).render(frame)
    seen = filled["reproj_seen"][..., 0] > 0
    np.testing.assert_array_equal(filled["reproj_seen"], bare["reproj_seen"])
    np.testing.assert_array_equal(filled["reproj"][seen], bare["reproj"][seen])
    assert not bare["reproj"][~seen].any()
    assert set(np.unique(filled["reproj_seen"])) <= {0, 255}


@pytest.mark.parametrize("infill", INFILLS)
def test_a_frame_without_valid_depth_gives_black_images(infill):
    frame = replace(make_frame(), depth=np.zeros((96, 96), np.float32))
    images = make_view("reproj", size=SIZE, infill=infill, mask=True).render(frame)
    assert not any(image.any() for image in images.values())


def test_a_name_cannot_be_registered_twice():
    with pytest.raises(ValueError, match="already"):
        register_view("reproj")(object)
