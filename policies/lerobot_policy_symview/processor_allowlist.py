"""Restricts the processor steps that an untrusted processor file can load.

LeRobot (0.6.1) imports the class of each step that a `policy_preprocessor.json` names and calls it with the options of
the file before it checks that the class is a step. A malicious file can name `subprocess.Popen`. Some of LeRobot's
registered steps also load code from the Hub.
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


def check_processor_files(
    config: SymviewConfig, model: str, options: dict[str, Any]
) -> dict[str, dict[str, Any]] | None:
    """Check that the processor files of a policy name only the steps of the policy's own pipelines.

    Return the options of the preprocessor's steps by name; None where there is no step that makes views.

    Args:
        config: the policy's configuration.
        model: the policy's folder, or its repository on the Hub.
        options: options of the download from the Hub.

    Raises:
        ValueError: if a file names another step, or a state file outside its folder.
    """
    from lerobot_policy_symview.processor_pipelines import make_processors

    saved: dict[str, dict[str, Any]] = {}
    names = (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)
    for name, pipeline in zip(names, make_processors(config), strict=True):
        file = _file(model, f"{name}.json", options)
        if file is None:
            continue
        allowed = [step["registry_name"] for step in pipeline.get_config()["steps"]]
        for step in json.loads(file.read_text())["steps"]:
            step_name = step.get("registry_name", step.get("class"))
            if step_name not in allowed or "registry_name" not in step:
                raise ValueError(
                    f"{file} names the processor step {step_name!r}, expected one of: {', '.join(allowed)}"
                )
            state = step.get("state_file", "")
            if Path(state).name != state:
                raise ValueError(f"{file}: the state_file of {step_name} must be in the same folder, got {state!r}")
            saved[step_name] = step.get("config", {})
    return saved if "symview_views" in saved else None


def _file(model: str, name: str, options: dict[str, Any]) -> Path | None:
    if Path(model).is_dir():
        file = Path(model) / name
        return file if file.is_file() else None
    try:
        return Path(hf_hub_download(model, name, **{key: options[key] for key in HUB_OPTIONS if key in options}))
    except EntryNotFoundError:
        return None


def restrict_processor_steps() -> None:
    """Make LeRobot load processor steps only by registry name or from step classes that are already imported.

    It replaces LeRobot's `DataProcessorPipeline._resolve_step_class`, which would import any class or function.
    """
    resolve = DataProcessorPipeline._resolve_step_class

    def resolve_imported(step_entry: dict[str, Any]) -> tuple[type[ProcessorStep], str]:
        if "registry_name" in step_entry:
            return resolve(step_entry)
        path = step_entry["class"]
        for step_class in _subclasses(ProcessorStep):
            if f"{step_class.__module__}.{step_class.__qualname__}" == path:
                return step_class, step_class.__name__
        raise ImportError(f"a processor file names {path!r}, expected a registered or already imported processor step")

    DataProcessorPipeline._resolve_step_class = staticmethod(resolve_imported)


def _subclasses(step_class: type[ProcessorStep]) -> Iterator[type[ProcessorStep]]:
    yield step_class
    for subclass in step_class.__subclasses__():
        yield from _subclasses(subclass)
