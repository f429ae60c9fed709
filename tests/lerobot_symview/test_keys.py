import pytest

from lerobot_symview import keys

RAW = [keys.rgb("side"), keys.depth("side"), keys.intrinsics("side"), keys.world_from_cam("side")]
VIEW = [keys.view("side", "reproj"), keys.view("side", "reproj_height")]


def features(camera, *left_out, of=(*RAW, *VIEW)):
    return {keys.of_camera(key, "side", camera) for key in of if key not in left_out}


def test_features_of_another_camera():
    assert features("front") == {
        "observation.images.front",
        "observation.images.front_depth",
        "observation.camera.front.intrinsics",
        "observation.camera.front.world_from_cam",
        "observation.images.front_reproj",
        "observation.images.front_reproj_height",
    }


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (features("side"), []),
        (features("side", *VIEW) | features("front"), []),  # the view can be made
        (features("front"), ["front"]),
        (features("front", of=VIEW), ["front"]),
        (features("front", *VIEW), ["front"]),
        (features("front", RAW[0]) | {RAW[0]}, ["front"]),  # the image was renamed
        (features("front", VIEW[0], of=VIEW) | {VIEW[0]}, ["front"]),  # the view's colour was renamed
        (features("front", RAW[0]) | {RAW[0]} | features("left"), ["front"]),  # and the robot has another camera
        (features("front", *VIEW) | {keys.rgb("wrist")}, ["front"]),
        (features("front") | features("top"), ["front"]),  # the simulator's oracle
        (features("front") | features("left"), ["front", "left"]),
        ({RAW[0], keys.rgb("front"), keys.depth("front")}, []),  # the camera has no depth
        ({keys.STATE}, []),
    ],
    ids=lambda value: ", ".join(sorted(value)) if isinstance(value, set) else str(value),
)
def test_substitutes(names, expected):
    assert keys.substitutes(names, "side", VIEW, RAW) == expected


def test_an_image_of_a_camera_is_no_camera():
    names = {keys.rgb("front"), keys.view("front", "reproj"), keys.depth("front")}
    assert keys.substitutes(names, "side", [keys.rgb("side")]) == ["front"]


def test_features_are_renamed_where_they_are_missing():
    renamed = keys.as_camera({"observation.images.side": 1, "observation.images.front_depth": 2}, "side", "front", RAW)
    assert renamed == {"observation.images.side": 1, "observation.images.side_depth": 2}
    assert keys.as_camera({RAW[0]: 1, keys.rgb("front"): 2}, "side", "front", RAW) == {RAW[0]: 1, keys.rgb("front"): 2}
