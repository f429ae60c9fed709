"""Uploads of datasets to the Hugging Face Hub."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_symview.runtime.cli import CommandError, DatasetLocation

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class HubOptions:
    """Whether and how a dataset is uploaded to the Hugging Face Hub."""

    push_to_hub: bool = False
    """Upload the finished dataset to the Hugging Face Hub; run `hf auth login` first."""
    private: bool = False
    """Make the repository private."""
    tags: list[str] = field(default_factory=list)
    """Additional tags of the dataset card."""
    branch: str | None = None
    """Branch to upload to, created if it does not exist; by default `main`."""


@dataclass(frozen=True)
class HubDataset(HubOptions, DatasetLocation):
    """A dataset's location, and whether and how the result is uploaded to the Hub."""


def push_dataset(target: DatasetLocation, options: HubOptions) -> str:
    """Upload a dataset with its card, and return its URL. Files that are already on the Hub are not sent again.

    Raises:
        CommandError: if the upload fails; the local dataset is not modified.
    """
    from huggingface_hub import DatasetCard, HfApi
    from huggingface_hub.errors import RevisionNotFoundError

    from lerobot_symview.datasets.card import (  # simulators use the options above without pyarrow
        CARD,
        write_card,
    )
    from lerobot_symview.datasets.metadata import FORMAT

    folder, repo_id = target.folder(), target.repo_id
    write_card(folder, repo_id, options.tags)
    api = HfApi()
    with hub_errors(repo_id, "--dataset.repo_id", folder):
        DatasetCard.load(folder / CARD).validate()
        address = api.create_repo(repo_id, repo_type="dataset", private=options.private, exist_ok=True)
        if options.branch:
            api.create_branch(repo_id, branch=options.branch, repo_type="dataset", exist_ok=True)
        api.upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            repo_type="dataset",
            revision=options.branch,
            ignore_patterns=["*.part"],
        )
        with suppress(RevisionNotFoundError):  # LeRobot loads the revision tagged with the version of the format
            api.delete_tag(repo_id, tag=FORMAT, repo_type="dataset")
        api.create_tag(repo_id, tag=FORMAT, revision=options.branch, repo_type="dataset")
    logger.info("pushed to %s", address)
    return str(address)


@contextmanager
def hub_errors(repo_id: str, flag: str, folder: Path) -> Iterator[None]:
    """Convert errors of the Hub client to errors that name the cause and the remedy.

    Args:
        repo_id: repository that is uploaded to.
        flag: command-line flag that sets `repo_id`.
        folder: local folder that is uploaded.

    Raises:
        CommandError: for every error of the client or the network.
    """
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, LocalTokenNotFoundError, OfflineModeIsEnabled

    kept = f"Nothing is lost: {folder} is complete; the same command with --resume=true uploads it."
    try:
        yield
    except OfflineModeIsEnabled:
        raise CommandError(f"HF_HUB_OFFLINE=1 blocks the upload of {repo_id} to the Hub: unset it. {kept}") from None
    except LocalTokenNotFoundError:
        raise CommandError(f"no token for the Hub found: run `hf auth login`, or set HF_TOKEN. {kept}") from None
    except HfHubHTTPError as error:
        status = error.response.status_code
        reasons = {
            401: "the Hub rejects the token: run `hf auth login` again, or set HF_TOKEN",
            403: f"the token has no write access to {repo_id}: "
            f"set {flag} to a repository of yours, or use a token with write access",
        }
        raise CommandError(f"{reasons.get(status, f'the Hub returned status {status}: {error}')}. {kept}") from None
    except (httpx.HTTPError, OSError) as error:
        raise CommandError(f"the Hub cannot be reached ({type(error).__name__}: {error}): try again. {kept}") from None
    except RuntimeError as error:  # the client wraps errors of single files in a RuntimeError
        if not isinstance(error.__cause__, (httpx.HTTPError, OSError)):
            raise
        reason = f"{error} {type(error.__cause__).__name__}: {error.__cause__}"
        raise CommandError(
            f"the upload was interrupted ({reason}): try again, uploaded files are not sent again. {kept}"
        ) from None
