"""Processor files of strangers.

LeRobot (0.6.1) imports what a `policy_preprocessor.json` names as the class of a step and calls it with the options
there, before it checks that it is a step: `subprocess.Popen` will do. Some of its registered steps load code from the
Hub as well.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError
from lerobot.processor import DataProcessorPipeline, ProcessorStep
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_policy_symview.configuration import SymviewConfig

HUB_OPTIONS = ("force_download", "proxies", "token", "cache_dir", "local_files_only", "revision")


def check_processor_files(config: SymviewConfig, model: str, options: dict[str, Any]) -> None:
    """Check that the files beside a policy name no steps but the policy's own.

    Args:
        config: of the policy.
        model: folder or name on the Hub.
        options: of the download.

    Raises:
        ValueError: if they do.
    """
    from lerobot_policy_symview.processor_pipelines import make_processors

    names = (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)
    for name, pipeline in zip(names, make_processors(config), strict=True):
        file = _file(model, f"{name}.json", options)
        if file is None:
            continue
        known = [step["registry_name"] for step in pipeline.get_config()["steps"]]
        for step in json.loads(file.read_text())["steps"]:
            asked = step.get("registry_name", step.get("class"))
            if asked not in known or "registry_name" not in step:
                raise ValueError(f"{file} asks for the step {asked!r}, expected {', '.join(known)}")
            state = step.get("state_file", "")
            if Path(state).name != state:
                raise ValueError(f"{file}: the state_file of {asked} must lie beside it, got {state!r}")


def _file(model: str, name: str, options: dict[str, Any]) -> Path | None:
    if Path(model).is_dir():
        file = Path(model) / name
        return file if file.is_file() else None
    try:
        return Path(hf_hub_download(model, name, **{key: options[key] for key in HUB_OPTIONS if key in options}))
    except EntryNotFoundError:
        return None


def import_no_steps() -> None:
    """Let LeRobot make steps of processor files only of classes that are steps and were imported by somebody else."""
    resolve = DataProcessorPipeline._resolve_step_class

    def resolve_imported(step_entry: dict[str, Any]) -> tuple[type[ProcessorStep], str]:
        if "registry_name" in step_entry:
            return resolve(step_entry)
        path = step_entry["class"]
        for kind in _kinds(ProcessorStep):
            if f"{kind.__module__}.{kind.__qualname__}" == path:
                return kind, kind.__name__
        raise ImportError(f"a processor file names {path!r}, which is no step that is registered or was imported")

    DataProcessorPipeline._resolve_step_class = staticmethod(resolve_imported)


def _kinds(kind: type[ProcessorStep]) -> Iterator[type[ProcessorStep]]:
    yield kind
    for one in kind.__subclasses__():
        yield from _kinds(one)
