"""The Hub server of the tests, used through the real client."""

import hashlib
import os
import subprocess
import sys

import pytest
from huggingface_hub import HfApi, hf_hub_download, hf_hub_url, snapshot_download
from huggingface_hub.errors import (
    HfHubHTTPError,
    OfflineModeIsEnabled,
    RemoteEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from tests.hub.client import online
from tests.hub.server import ALICE, BOB, HubServer
from tests.hub.storage import LFS_SIZE

FILES = {
    "README.md": b"---\nlicense: mit\n---\n# Demo\n",
    "meta/info.json": b'{"fps": 10}',
    "meta/empty.png": b"",
    "data/file 0+1.parquet": b"PAR1" * 10,
    "data/copy.parquet": b"PAR1" * 10,
    "model.safetensors": os.urandom(1000),
    "videos/large.bin": os.urandom(LFS_SIZE + 1),
}
IN_LFS = {hashlib.sha256(FILES[path]).hexdigest() for path in FILES if path.endswith(("parquet", "tensors", "bin"))}
DEMO = "alice/demo"


@pytest.fixture
def hub():
    with HubServer() as server, online(server, ALICE):
        yield server


@pytest.fixture
def folder(tmp_path):
    for path, content in FILES.items():
        (tmp_path / "folder" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "folder" / path).write_bytes(content)
    return tmp_path / "folder"


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and ".cache" not in path.parts
    }


def status(error):
    return error.value.response.status_code


def upload(folder, **options):
    return HfApi().upload_folder(repo_id=DEMO, folder_path=folder, repo_type="dataset", **options)


def create(**options):
    return HfApi().create_repo(DEMO, repo_type="dataset", **options)


def test_a_folder_round_trip(hub, folder, tmp_path):
    api, address = HfApi(), create()
    assert (address, address.repo_id) == (f"https://huggingface.co/datasets/{DEMO}", DEMO)
    commit = upload(folder, commit_message="All files")
    assert commit.repo_url == address
    info = api.repo_info(DEMO, repo_type="dataset")
    assert (info.sha, info.private) == (commit.oid, False)
    listed = set(api.list_repo_files(DEMO, repo_type="dataset"))
    assert listed == {sibling.rfilename for sibling in info.siblings} == {*FILES, ".gitattributes"}
    tree = {entry.path: entry for entry in api.list_repo_tree(DEMO, "data", repo_type="dataset")}
    assert set(tree) == {"data/file 0+1.parquet", "data/copy.parquet"}
    assert tree["data/copy.parquet"].lfs.sha256 == hashlib.sha256(FILES["data/copy.parquet"]).hexdigest()
    assert "data" in {entry.path for entry in api.list_repo_tree(DEMO, repo_type="dataset")}

    pulled = snapshot_download(DEMO, repo_type="dataset", local_dir=tmp_path / "pulled", ignore_patterns=".git*")
    assert contents(tmp_path / "pulled") == FILES
    assert pulled == str(tmp_path / "pulled")
    assert {path: hub.files(DEMO)[path] for path in FILES} == FILES
    assert (len(hub.lfs_uploads), set(hub.lfs_uploads)) == (len(IN_LFS), IN_LFS)


def test_uploaded_files_are_not_sent_again(hub, folder):
    create()
    first = upload(folder)
    assert upload(folder).oid == first.oid
    (folder / "meta" / "info.json").write_bytes(b"{}")
    second = upload(folder, delete_patterns="*.safetensors")
    assert len(hub.lfs_uploads) == len(IN_LFS)
    assert set(hub.files(DEMO)) == {*FILES, ".gitattributes"}
    (folder / "model.safetensors").unlink()
    third = upload(folder, delete_patterns="*.safetensors", parent_commit=second.oid)
    assert "model.safetensors" not in hub.files(DEMO)
    assert hub.files(DEMO, revision=first.oid)["meta/info.json"] == FILES["meta/info.json"]
    with pytest.raises(HfHubHTTPError, match="412"):
        HfApi().upload_file(
            path_or_fileobj=b"x", path_in_repo="x", repo_id=DEMO, repo_type="dataset", parent_commit=second.oid
        )
    assert HfApi().repo_info(DEMO, repo_type="dataset").sha == third.oid


def test_branches_and_tags(hub):
    api = HfApi()
    api.create_repo("alice/model")
    start = api.repo_info("alice/model").sha
    api.create_branch("alice/model", branch="tried/out")
    with pytest.raises(HfHubHTTPError, match="409"):
        api.create_branch("alice/model", branch="tried/out")
    api.create_branch("alice/model", branch="tried/out", exist_ok=True)
    commit = api.upload_file(
        path_or_fileobj=b"{}", path_in_repo="config.json", repo_id="alice/model", revision="tried/out"
    )
    api.create_tag("alice/model", tag="v1", revision="tried/out")
    with pytest.raises(HfHubHTTPError, match="409"):
        api.create_tag("alice/model", tag="v1", revision="main")
    refs = api.list_repo_refs("alice/model")
    assert {ref.name: ref.target_commit for ref in refs.branches} == {"main": start, "tried/out": commit.oid}
    assert [(ref.name, ref.ref, ref.target_commit) for ref in refs.tags] == [("v1", "refs/tags/v1", commit.oid)]
    assert api.file_exists("alice/model", "config.json", revision="v1")
    assert not api.file_exists("alice/model", "config.json")
    with open(hf_hub_download("alice/model", "config.json", revision="v1")) as file:
        assert file.read() == "{}"

    api.delete_tag("alice/model", tag="v1")
    with pytest.raises(RevisionNotFoundError):
        api.delete_tag("alice/model", tag="v1")
    with pytest.raises(RevisionNotFoundError):
        snapshot_download("alice/model", revision="v1")
    with pytest.raises(RemoteEntryNotFoundError):
        hf_hub_download("alice/model", "weights.bin")
    with pytest.raises(RepositoryNotFoundError):
        hf_hub_download("alice/other", "config.json")


def test_private_repositories_are_hidden_from_others(hub, folder):
    create(private=True)
    upload(folder)
    assert HfApi().repo_info(DEMO, repo_type="dataset").private
    for token, code in ((BOB, 404), (False, 401)):
        other = HfApi(token=token)
        with pytest.raises(RepositoryNotFoundError) as error:
            other.repo_info(DEMO, repo_type="dataset")
        assert status(error) == code
        with pytest.raises(RepositoryNotFoundError):
            other.upload_folder(repo_id=DEMO, folder_path=folder, repo_type="dataset")
        with pytest.raises(RepositoryNotFoundError):
            snapshot_download(DEMO, repo_type="dataset", token=token)
        assert not other.file_exists(DEMO, "README.md", repo_type="dataset")
    assert hf_hub_download(DEMO, "model.safetensors", repo_type="dataset")
    with pytest.raises(RepositoryNotFoundError):  # a dataset is not a model
        HfApi().repo_info(DEMO)


def test_token_permissions(hub, folder):
    assert HfApi().whoami()["name"] == "alice"
    hub.users["hf_read"] = ("alice", set())
    hub.users["hf_team"] = ("carol", {"carol", "alice"})
    create()
    api = HfApi(token="hf_wrong")
    for call in (api.whoami, lambda: api.repo_info(DEMO, repo_type="dataset"), lambda: api.create_repo(DEMO)):
        with pytest.raises(HfHubHTTPError) as error:
            call()
        assert (status(error), type(error.value)) == (401, HfHubHTTPError)
    for token in (BOB, "hf_read"):
        api = HfApi(token=token)
        assert api.create_repo(DEMO, repo_type="dataset", exist_ok=True).repo_id == DEMO
        api.create_branch(DEMO, branch="main", repo_type="dataset", exist_ok=True)
        for call in (
            lambda api=api: api.create_repo("alice/new"),
            lambda api=api: api.create_tag(DEMO, tag="v1", repo_type="dataset"),
            lambda api=api: api.upload_folder(repo_id=DEMO, folder_path=folder, repo_type="dataset"),
        ):
            with pytest.raises(HfHubHTTPError, match="403 Forbidden") as error:
                call()
            assert status(error) == 403
    assert hub.lfs_uploads == []
    HfApi(token="hf_team").create_tag(DEMO, tag="v1", repo_type="dataset")
    with pytest.raises(HfHubHTTPError, match="401"):
        HfApi(token=False).create_repo("alice/new")


def test_a_broken_upload_resumes(hub, folder):
    create()
    hub.fail_uploads_after = 2
    with pytest.raises(RuntimeError, match="Error while uploading"):
        upload(folder)
    assert len(hub.lfs_uploads) == 2
    assert set(hub.files(DEMO)) == {".gitattributes"}
    hub.fail_uploads_after = None
    upload(folder)
    assert (len(hub.lfs_uploads), set(hub.lfs_uploads)) == (len(IN_LFS), IN_LFS)
    assert hub.files(DEMO)["videos/large.bin"] == FILES["videos/large.bin"]


def test_requests_stay_local_and_the_client_is_offline_afterwards(tmp_path):
    with HubServer() as hub:
        with online(hub, ALICE, tmp_path):
            with online(hub, None), pytest.raises(HfHubHTTPError, match="401"):
                create()
            create()
            hf_hub_download(DEMO, ".gitattributes", repo_type="dataset")
            with pytest.raises(HfHubHTTPError, match="501"):
                HfApi(endpoint="https://example.com").list_repo_commits(DEMO)
            assert hub.requests[-1] == ("GET", f"/api/models/{DEMO}/commits/main")
        with pytest.raises(OfflineModeIsEnabled):
            HfApi().repo_info(DEMO)
    assert list(tmp_path.rglob(".gitattributes"))


def test_another_process_connects_through_its_environment(hub, folder, tmp_path):
    code = f"""
from huggingface_hub import create_repo, snapshot_download, upload_folder
print(create_repo({DEMO!r}, private=True))
upload_folder(repo_id={DEMO!r}, folder_path={str(folder)!r})
snapshot_download({DEMO!r}, local_dir={str(tmp_path / "pulled")!r}, ignore_patterns=".git*")
"""
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, env=os.environ | hub.environment(ALICE), capture_output=True, text=True, check=True)
    assert done.stdout.split() == [f"{hub.url}/{DEMO}"]
    assert contents(tmp_path / "pulled") == FILES
    assert HfApi(endpoint=hub.url).repo_info(DEMO).private
    assert hf_hub_url(DEMO, "x").startswith("https://huggingface.co/")


@pytest.mark.long
def test_lerobot_pushes_and_pulls_datasets(hub, recorded):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    LeRobotDataset(DEMO, recorded).push_to_hub(private=True)
    assert set(hub.repos["dataset", DEMO].tags) == {"v3.0"}
    hub.requests.clear()
    pulled = LeRobotDataset(DEMO)
    assert ("GET", f"/api/datasets/{DEMO}/refs") in hub.requests
    assert len(pulled) == len(LeRobotDataset("test/recorded", recorded))
    assert pulled[0].keys() == LeRobotDataset("test/recorded", recorded)[0].keys()
    with online(hub, BOB), pytest.raises(RepositoryNotFoundError):
        LeRobotDataset(DEMO)


def test_lerobot_pushes_and_pulls_policies(hub):
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (4,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (4,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        dim_model=16,
        n_heads=2,
        dim_feedforward=16,
        device="cpu",
    )
    policy = ACTPolicy(config)
    statistics = {key: {"mean": torch.zeros(4), "std": torch.ones(4)} for key in config.input_features}
    statistics["action"] = {"mean": torch.zeros(2), "std": torch.ones(2)}
    processors = make_pre_post_processors(config, dataset_stats=statistics)
    for part in (policy, *processors):
        part.push_to_hub("alice/policy", private=True)
    pulled = ACTPolicy.from_pretrained("alice/policy")
    for key, value in policy.state_dict().items():
        assert torch.equal(pulled.state_dict()[key], value)
    before, _ = make_pre_post_processors(pulled.config, pretrained_path="alice/policy")
    batch = {"observation.state": torch.ones(4), "observation.environment_state": torch.ones(4)}
    assert before(batch)["observation.state"].tolist() == processors[0](batch)["observation.state"].tolist()
    with online(hub, BOB), pytest.raises(FileNotFoundError):
        ACTPolicy.from_pretrained("alice/policy")
