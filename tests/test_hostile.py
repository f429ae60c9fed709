"""Files from strangers: datasets, checkpoints, processors and calibrations that were made to do harm.

No pickle is read, paths stay in their dataset, declared sizes are checked before memory is taken, and a processor file
imports nothing.
"""

import ast
import json
import pickle
import shutil
import struct
import sys
import zlib
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import ProcessorStepRegistry, tokenizer_processor
from safetensors import SafetensorError

from lerobot_policy_symview.configuration_symview_bc import SymviewBcConfig
from lerobot_policy_symview.configuration_symview_sacfd import SymviewSacfdConfig
from lerobot_policy_symview.demonstrations import open_dataset
from lerobot_policy_symview.modeling_symview_bc import SymviewBcPolicy
from lerobot_policy_symview.processors import make_processors
from lerobot_policy_symview.rl.replay import Replay, ReplayConfig
from lerobot_symview import keys
from lerobot_symview.add_views import add_views
from lerobot_symview.calibration import parse_workspace, read_calibration
from lerobot_symview.camera import CalibrationError
from lerobot_symview.cli import CommandError, DatasetTarget
from lerobot_symview.source_dataset import SourceDataset
from lerobot_symview.views import VIEWS, make_view
from symview_eval.contact_sheet import TILE, with_outline
from symview_eval.preview import PreviewConfig, preview
from tests.conftest import make_camera
from tests.lerobot_policy_symview.policies import make_config, make_policy
from tests.lerobot_symview.derived import views_config

ROOT = Path(__file__).parents[1]
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
RGB, DEPTH = keys.rgb("side"), keys.depth("side")


def derive(dataset, folder):
    return add_views(views_config(dataset, folder / "results" / "inner" / "views", views=["reproj"], size=32))


def look(dataset, folder):
    target = DatasetTarget("test/hostile", dataset)
    return preview(PreviewConfig(target, output_dir=folder / "preview", frames=1, rerun=False))


both_commands = pytest.mark.parametrize("command", [derive, look])


@pytest.fixture
def dataset(recorded, tmp_path):
    """A copy of a harmless dataset."""
    return shutil.copytree(recorded, tmp_path / "strangers" / "dataset")


@pytest.fixture
def outside(recorded, tmp_path):
    """A folder beside the dataset, with a table that could be one of its own."""
    folder = tmp_path / "strangers" / "private"
    (folder / "chunk-000").mkdir(parents=True)
    shutil.copy(recorded / DATA, folder / "chunk-000" / "file-000.parquet")
    (folder / "secret.txt").write_text("secret")
    return folder


@pytest.fixture(scope="module")
def harmless_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    policy = make_policy()
    for part in (policy, *make_processors(policy.config)):
        part.save_pretrained(folder)
    return folder


@pytest.fixture
def checkpoint(harmless_policy, tmp_path):
    """A copy of a harmless policy."""
    return shutil.copytree(harmless_policy, tmp_path / "checkpoint")


def change_json(file, **entries):
    file.write_text(json.dumps(json.loads(file.read_text()) | entries))


def change_info(dataset, **entries):
    change_json(dataset / "meta" / "info.json", **entries)


def change_feature(dataset, key, **entries):
    features = json.loads((dataset / "meta" / "info.json").read_text())["features"]
    change_info(dataset, features=features | {key: features.get(key, {}) | entries})


def change_columns(file, **columns):
    table = pq.read_table(file)
    for name, values in columns.items():
        table = table.drop_columns([name]) if name in table.column_names else table
        table = table.append_column(name, values if isinstance(values, pa.Array) else pa.array([values] * len(table)))
    pq.write_table(table, file, compression="zstd")


def change_image(dataset, key, encoded, path="image.png"):
    """Put something else in the place of the first image of a feature."""
    table = pq.read_table(dataset / DATA)
    cells = table[key].to_pylist()
    cells[0] = {"bytes": encoded, "path": str(path)}
    field = table.schema.field(key)
    table = table.set_column(table.column_names.index(key), field, pa.array(cells, field.type))
    pq.write_table(table, dataset / DATA, compression="zstd")


def make_video_feature(dataset, video_path="videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"):
    """Say that the camera's colour is in a video."""
    change_feature(dataset, RGB, dtype="video")
    change_info(dataset, video_path=video_path)
    places = {"chunk_index": 0, "file_index": 0, "from_timestamp": 0.0}
    change_columns(dataset / EPISODES, **{f"videos/{RGB}/{name}": value for name, value in places.items()})


def png_of(height, width):
    """The beginning of a PNG file that says it has so many pixels, and holds none."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))


def tiff_of(height, width):
    """The same of a TIFF file, of float32."""
    tags = {256: width, 257: height, 258: 32, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: 4, 339: 3}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(8)


def encoded(extension, image):
    return cv2.imencode(extension, image)[1].tobytes()


class Traitor:
    """Creates a file when it is unpickled."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


# No pickle


def test_no_code_of_ours_reads_pickle():
    forbidden = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    calls = {"torch.load", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "pd.read_pickle", "eval", "exec"}
    for folder in ("lerobot_symview", "policies", "datasets_gen", "eval", "tools"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    modules = {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
                    assert not {module.split(".")[0] for module in modules} & forbidden, file
                elif isinstance(node, ast.Call):
                    assert ast.unparse(node.func) not in calls, f"{file}:{node.lineno}"
                    assert not any(keyword.arg == "allow_pickle" for keyword in node.keywords), f"{file}:{node.lineno}"


def test_pickled_weights_are_refused_unread(checkpoint, tmp_path):
    (checkpoint / "model.safetensors").write_bytes(pickle.dumps(Traitor(tmp_path / "run")))
    with pytest.raises(SafetensorError):
        SymviewBcPolicy.from_pretrained(checkpoint)
    (checkpoint / "model.safetensors").unlink()
    torch.save(Traitor(tmp_path / "run"), checkpoint / "pytorch_model.bin")
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors"):
        SymviewBcPolicy.from_pretrained(checkpoint)
    assert not (tmp_path / "run").exists()


def saved_replay(folder):
    frame = {"picture": np.zeros(2, np.uint8)}
    replay = Replay(ReplayConfig(), frame, 2, [2, 2], folder)
    replay.begin(0, frame)
    replay.add(0, np.zeros(2, np.float32), 0.0, True, None)
    replay.save(folder)
    return replay


def test_a_pickled_replay_is_refused_unread(tmp_path):
    replay = saved_replay(tmp_path / "replay")
    np.save(tmp_path / "replay" / "picture.npy", np.array([Traitor(tmp_path / "run")], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="Python objects"):
        replay.load(tmp_path / "replay")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("tag", ["object/apply:os.system [touch {}]", "object/new:pathlib.Path [{}]", "name:os.system"])
def test_a_calibration_cannot_name_python_objects(tmp_path, tag):
    (tmp_path / "cameras.yaml").write_text(f"units: !!python/{tag.format(tmp_path / 'run')}")
    with pytest.raises(CommandError, match="could not determine a constructor"):
        read_calibration(tmp_path / "cameras.yaml")
    assert not (tmp_path / "run").exists()


# Paths stay in the dataset

TEMPLATES = [
    "../private/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "data/../../private/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "PRIVATE/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index.__class__}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index!r}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index:0300000d}/file-{file_index:03d}.parquet",
    "data/chunk-{0}/file-{file_index:03d}.parquet",
    "data/chunk-{somewhere}/file-{file_index:03d}.parquet",
    "data/chunk-{chunk_index:03d",
    "",
    None,
    ["data"],
]


@both_commands
@pytest.mark.parametrize("template", TEMPLATES)
def test_tables_are_in_the_dataset(dataset, outside, tmp_path, command, template):
    stated = template.replace("PRIVATE", str(outside)) if isinstance(template, str) else template
    change_info(dataset, data_path=stated)
    with pytest.raises(CommandError, match="data_path"):
        command(dataset, tmp_path)


@both_commands
@pytest.mark.parametrize("template", [*TEMPLATES[:-3], "videos/{video_key.__class__}/{video_key}.mp4"])
def test_videos_are_in_the_dataset(dataset, outside, tmp_path, command, template):
    make_video_feature(dataset, template.replace("PRIVATE", str(outside)))
    with pytest.raises(CommandError, match="video_path"):
        command(dataset, tmp_path)


def test_nothing_is_written_where_a_template_leads_only_in_the_result(dataset, tmp_path):
    """With these numbers it is 77/77 in the source, and in the result, whose files are numbered from 0, ../.. ."""
    folder = "{file_index!s:.>2.{chunk_index}s}"
    change_info(dataset, data_path=f"{folder}/{folder}/stray{{file_index}}.parquet")
    change_columns(dataset / EPISODES, **{"data/chunk_index": 2, "data/file_index": 77})
    (dataset / "77" / "77").mkdir(parents=True)
    (dataset / DATA).rename(dataset / "77" / "77" / "stray77.parquet")
    with pytest.raises(CommandError, match="data_path"):
        derive(dataset, tmp_path)
    assert not list(tmp_path.rglob("stray0.parquet"))


@both_commands
@pytest.mark.parametrize("place", ["../../private/chunk-000", -1, 0.5, None])
def test_the_places_of_tables_are_numbers(dataset, outside, tmp_path, command, place):
    change_info(dataset, data_path="data/{chunk_index}/file-{file_index:03d}.parquet")
    change_columns(dataset / EPISODES, **{"data/chunk_index": place})
    with pytest.raises(CommandError, match="chunk_index"):
        command(dataset, tmp_path)


@both_commands
@pytest.mark.parametrize("name", ["../../../strangers/private", "../../private", "PRIVATE", "..", "", "a/b", "a\0b"])
def test_names_of_features_are_no_paths(dataset, outside, tmp_path, command, name):
    """The videos of a feature are copied from the folder of its name to the folder of its name."""
    (dataset / "videos").mkdir()
    video = {"dtype": "video", "shape": [8, 8, 3], "names": ["height", "width", "channels"], "info": {}}
    change_feature(dataset, name.replace("PRIVATE", str(outside)), **video)
    with pytest.raises(CommandError, match=r"info\.json: the feature"):
        command(dataset, tmp_path)
    assert list(tmp_path.rglob("secret.txt")) == [outside / "secret.txt"]


@both_commands
def test_an_image_in_a_file_elsewhere_is_not_read(dataset, tmp_path, command):
    """Hugging Face's `datasets` would open what the table names in place of an image, and download it."""
    (tmp_path / "secret.png").write_bytes(encoded(".png", np.full((152, 152, 3), 77, np.uint8)))
    change_image(dataset, RGB, None, tmp_path / "secret.png")
    with pytest.raises(ValueError, match="image"):
        command(dataset, tmp_path)


def test_an_image_in_a_file_elsewhere_is_not_demonstrated(dataset, tmp_path):
    (tmp_path / "secret.png").write_bytes(encoded(".png", np.full((152, 152, 3), 77, np.uint8)))
    change_image(dataset, RGB, None, tmp_path / "secret.png")
    with pytest.raises(CommandError, match=RGB):
        open_dataset(DatasetTarget("test/hostile", dataset))


# Sizes are checked first


@both_commands
@pytest.mark.parametrize(
    ("key", "data", "size"),
    [
        (RGB, png_of(30_000, 20_000), "30000 x 20000"),
        (RGB, encoded(".png", np.zeros((300, 290, 3), np.uint8)), "300 x 290"),
        (RGB, encoded(".jpg", np.zeros((300, 290, 3), np.uint8)), "300 x 290"),
        (DEPTH, tiff_of(9_000, 8_000), "9000 x 8000"),
        (DEPTH, encoded(".tiff", np.ones((300, 290), np.float32)), "300 x 290"),
    ],
)
def test_images_are_no_larger_than_declared(dataset, tmp_path, command, key, data, size):
    change_image(dataset, key, data)
    with pytest.raises(ValueError, match=f"{size}.*152 x 152"):
        command(dataset, tmp_path)


def test_an_image_without_bytes_is_none(dataset, tmp_path):
    change_image(dataset, RGB, b"")
    with pytest.raises(ValueError, match="no image"):
        look(dataset, tmp_path)


def test_videos_are_no_larger_than_declared(dataset, tmp_path):
    make_video_feature(dataset)
    file = dataset / "videos" / RGB / "chunk-000" / "file-000.mp4"
    file.parent.mkdir(parents=True)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=4, width=320, height=304, pix_fmt="yuv420p")
        for _ in range(16):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((304, 320, 3), np.uint8))))
        container.mux(stream.encode())
    with pytest.raises(ValueError, match=r"304 x 320.*152 x 152"):
        look(dataset, tmp_path)


@pytest.mark.parametrize(
    "shape", [[10**9, 10**9, 3], [20_000, 20_000, 3], [-8, 8, 3], [0, 8, 3], [152, 152], [152.5, 152, 3], "huge", None]
)
def test_declared_shapes_of_images_are_possible(dataset, shape):
    change_feature(dataset, RGB, shape=shape)
    with pytest.raises(CommandError, match=f"{RGB}.*shape"):
        SourceDataset(dataset)


def test_there_are_no_more_episodes_than_declared(dataset):
    """Rows that are alike take next to nothing in a file."""
    table = pq.read_table(dataset / EPISODES)
    pq.write_table(table.take(pa.array(np.zeros(20_000, int))), dataset / EPISODES, compression="zstd")
    with pytest.raises(CommandError, match=r"20000.*total_episodes"):
        len(SourceDataset(dataset).episodes)


@both_commands
@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("length", 10**12),
        ("length", -5),
        ("length", 0),
        ("length", "many"),
        ("dataset_from_index", 10**15),
        ("dataset_from_index", -3),
        ("episode_index", 9),
    ],
)
def test_episodes_are_where_there_are_frames(dataset, tmp_path, command, column, value):
    values = pq.read_table(dataset / EPISODES)[column].to_pylist()
    change_columns(dataset / EPISODES, **{column: pa.array([*map(type(value), values[:-1]), value])})
    with pytest.raises(CommandError, match=column):
        command(dataset, tmp_path)


@both_commands
def test_rows_are_no_larger_than_declared(dataset, tmp_path, command):
    """64 MiB of zeros that a table of a few kilobytes unpacks to."""
    change_image(dataset, RGB, bytes(2**26))
    with pytest.raises(CommandError, match=r"file-000\.parquet.*bytes"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("view", VIEWS)
def test_views_are_of_a_possible_size(view):
    with pytest.raises(ValueError, match="size must"):
        make_view(view, size=10**6)


@pytest.mark.parametrize(
    "facts",
    [
        {"options": {"size": 10**6}},
        {"options": {"size": 76, "command": "rm"}},
        {"options": "size"},
        {"workspace": {"size": float("nan")}},
        {"workspace": "here"},
        {"calibration": {"cameras": "front"}},
    ],
)
def test_a_policy_takes_over_only_what_can_be_a_view(with_views, facts):
    features = json.loads((with_views / "meta" / "info.json").read_text())["features"]
    features[keys.view("side", "reproj")]["info"]["symview"] |= facts
    with pytest.raises(ValueError, match=keys.view("side", "reproj")):
        make_config().set_dataset_feature_metadata(features)


@both_commands
@pytest.mark.parametrize("workspace", [{"size": 1e400}, {"size": 0.4, "command": "rm"}, {"center": "ab"}, "here"])
def test_a_dataset_states_a_possible_workspace(dataset, tmp_path, command, workspace):
    change_feature(dataset, RGB, info={"symview": {"workspace": workspace}})
    with pytest.raises(ValueError, match="workspace"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("entries", [{"size": float("nan")}, {"height_limit": 1e400}, {"center": [float("nan"), 0]}])
def test_a_workspace_is_finite(entries):
    with pytest.raises(CalibrationError, match="finite"):
        parse_workspace(entries)


def test_networks_are_of_a_possible_width():
    with pytest.raises(ValueError, match=r"--policy\.width"):
        SymviewBcConfig(device="cpu", width=16 * 10**5)


def test_saved_arrays_are_no_larger_than_their_files(checkpoint, tmp_path):
    shape = [10**12]
    header = json.dumps({"x": {"dtype": "F32", "shape": shape, "data_offsets": [0, 4 * shape[0]]}}).encode()
    (checkpoint / "model.safetensors").write_bytes(struct.pack("<Q", len(header)) + header)
    with pytest.raises(SafetensorError, match="not fully covered"):
        SymviewBcPolicy.from_pretrained(checkpoint)
    replay = saved_replay(tmp_path / "replay")
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({shape[0]}, 2), }}".ljust(117).encode() + b"\n"
    (tmp_path / "replay" / "picture.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header + bytes(8))
    with pytest.raises(ValueError, match="greater than file size"):
        replay.load(tmp_path / "replay")


def test_a_narrow_image_is_not_enlarged_without_limit(workspace):
    camera = make_camera(size=152)
    picture = with_outline(np.zeros((1, 400, 3), np.uint8), camera, workspace)
    assert max(picture.shape) <= 4 * TILE


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [0, 0, 0]\nb: &b [*a, *a, *a]\nunits: m\ncameras: {front: *b}", "has an alias"),
        ("[" * 3000, "cannot read"),
        ("units: [m]\ncameras: {front: 1}", "units must be"),
    ],
)
def test_a_calibration_that_grows_or_ends_in_a_traceback_is_refused(tmp_path, text, message):
    """Every line of aliases multiplies what arrays and messages are made of."""
    (tmp_path / "cameras.yaml").write_text(text)
    with pytest.raises((CommandError, CalibrationError), match=message):
        read_calibration(tmp_path / "cameras.yaml")


@both_commands
@pytest.mark.parametrize("content", [b"[1]", b"\xff\xfe", b"[" * 100_000, b"{", b'{"codebase_version": "v3.0"}'])
def test_metadata_that_is_none_is_refused(dataset, tmp_path, command, content):
    (dataset / "meta" / "info.json").write_bytes(content)
    with pytest.raises(CommandError, match=r"info\.json"):
        command(dataset, tmp_path)


@both_commands
@pytest.mark.parametrize("feature", ["image", [], {}, {"dtype": "image", "shape": [8, 8, 3], "info": "mine"}])
def test_features_that_are_none_are_refused(dataset, tmp_path, command, feature):
    features = json.loads((dataset / "meta" / "info.json").read_text())["features"]
    change_info(dataset, features=features | {"strange": feature})
    with pytest.raises(CommandError, match="strange"):
        command(dataset, tmp_path)


@pytest.mark.parametrize("entries", [{"chunks_size": 0}, {"chunks_size": "x"}, {"total_frames": "many"}])
def test_counts_in_metadata_are_counts(dataset, tmp_path, entries):
    change_info(dataset, **entries)
    with pytest.raises(CommandError, match=next(iter(entries))):
        derive(dataset, tmp_path)


# A processor file imports nothing


def load_with_processors(folder):
    """In the order of LeRobot's commands."""
    policy = SymviewBcPolicy.from_pretrained(folder)
    return make_pre_post_processors(policy.config, str(folder))


def add_step(folder, step, name="policy_preprocessor.json"):
    steps = json.loads((folder / name).read_text())["steps"]
    change_json(folder / name, steps=[step, *steps])


@pytest.fixture
def strange_step(tmp_path, monkeypatch):
    """A module that is on the path and not ours to import; it and its step leave a file."""
    code = f"from pathlib import Path\nPath({str(tmp_path / 'run')!r}).touch()\ndef Step(): return None\n"
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "strange_steps.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path / "modules")
    yield "strange_steps.Step"
    sys.modules.pop("strange_steps", None)


@pytest.mark.parametrize("name", ["policy_preprocessor.json", "policy_postprocessor.json"])
def test_a_processor_file_imports_nothing(checkpoint, strange_step, tmp_path, name):
    add_step(checkpoint, {"class": strange_step}, name)
    with pytest.raises((ImportError, ValueError), match="strange_steps"):
        load_with_processors(checkpoint)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("called", "options"),
    [
        ("os.system", {"command": "touch RUN"}),
        ("subprocess.check_call", {"args": ["touch", "RUN"]}),
        ("builtins.open", {"file": "RUN", "mode": "w"}),
    ],
)
def test_a_processor_file_calls_nothing(checkpoint, tmp_path, called, options):
    config = json.loads(json.dumps(options).replace("RUN", str(tmp_path / "run")))
    add_step(checkpoint, {"class": called, "config": config})
    with pytest.raises((ImportError, ValueError), match=called):
        load_with_processors(checkpoint)
    assert not (tmp_path / "run").exists()


def test_processors_alone_import_nothing_either(checkpoint, strange_step, tmp_path):
    """As a robot's own program loads them, without or before the policy."""
    add_step(checkpoint, {"class": strange_step})
    with pytest.raises((ImportError, ValueError), match="strange_steps"):
        make_pre_post_processors(make_config(), str(checkpoint))
    assert not (tmp_path / "run").exists()


def test_a_registered_step_that_runs_code_from_the_hub_is_not_made(checkpoint, monkeypatch):
    """LeRobot's `action_tokenizer_processor` trusts what the repository that it is told to load brings along."""
    loaded = []

    class Recorder:
        @staticmethod
        def from_pretrained(name, **options):
            loaded.append((name, options))

    monkeypatch.setattr(tokenizer_processor, "_transformers_available", True)
    for name in ("AutoProcessor", "AutoTokenizer"):
        monkeypatch.setattr(tokenizer_processor, name, Recorder, raising=False)
    config = {"action_tokenizer_name": "stranger/code"}
    add_step(checkpoint, {"registry_name": "action_tokenizer_processor", "config": config})
    with pytest.raises((ImportError, ValueError), match="action_tokenizer_processor"):
        load_with_processors(checkpoint)
    assert not loaded


@pytest.mark.parametrize("file", ["../weights.safetensors", "WEIGHTS"])
def test_the_state_of_a_step_is_in_the_policys_folder(checkpoint, tmp_path, file):
    shutil.copy(checkpoint / "model.safetensors", tmp_path / "weights.safetensors")
    stated = file.replace("WEIGHTS", str(tmp_path / "weights.safetensors"))
    add_step(checkpoint, {"registry_name": "device_processor", "config": {"device": "cpu"}, "state_file": stated})
    with pytest.raises(ValueError, match="state_file"):
        load_with_processors(checkpoint)


def test_a_processor_file_makes_views_of_a_possible_size(checkpoint):
    add_step(checkpoint, {"registry_name": "symview_views", "config": {"views": {"persp": {"size": 10**6}}}})
    with pytest.raises(ValueError, match="size must"):
        load_with_processors(checkpoint)


@pytest.mark.parametrize("kind", [SymviewBcConfig, SymviewSacfdConfig])
def test_our_own_processors_name_registered_steps_only(kind):
    for pipeline in make_processors(make_config(kind)):
        for step in pipeline.get_config()["steps"]:
            assert "class" not in step
            assert step["registry_name"] in ProcessorStepRegistry.list()


def test_harmless_files_are_read(dataset, checkpoint, tmp_path):
    """The same commands on what was not changed."""
    for command in (derive, look):
        assert command(dataset, tmp_path).is_dir()
    assert len(open_dataset(DatasetTarget("test/harmless", dataset))) == 14
    assert load_with_processors(checkpoint)
