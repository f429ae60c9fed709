"""Connects the real Hub client of this process to a Hub server on loopback."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import httpx
from huggingface_hub import constants, set_client_factory
from huggingface_hub.utils import _http

from tests.hub.server import HubServer


@contextmanager
def online(hub: HubServer, token: str | None, cache: Path | None = None) -> Iterator[None]:
    """Redirect all requests of this process' Hub client, and of LeRobot, to `hub`.

    Downloads use a separate cache, since the client falls back to the cache when the Hub refuses a request. It is
    deleted at the end unless `cache` names its folder. Retries do not wait. The context may be nested, with another
    user's token.
    """

    class RedirectTransport(httpx.HTTPTransport):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            url = hub.url + request.url.raw_path.decode()
            return super().handle_request(
                httpx.Request(
                    request.method, url, headers=request.headers, stream=request.stream, extensions=request.extensions
                )
            )

    def client() -> httpx.Client:
        hooks = {"request": [_http.hf_request_event_hook]}
        return httpx.Client(transport=RedirectTransport(), event_hooks=hooks, follow_redirects=True, timeout=None)

    with ExitStack() as stack:
        folder = cache or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="symview-hub-")))
        stack.enter_context(mock.patch.dict(os.environ, {"HF_TOKEN": token or "", "HUGGING_FACE_HUB_TOKEN": ""}))
        changed = {"HF_HUB_OFFLINE": False, "HF_HUB_DISABLE_XET": True, "HF_HUB_DISABLE_TELEMETRY": True}
        changed |= {"HF_HUB_CACHE": str(folder / "hub"), "HF_TOKEN_PATH": str(folder / "token")}
        stack.enter_context(mock.patch.multiple(constants, **changed))
        for module in ("dataset_metadata", "lerobot_dataset"):  # these modules have copies of the constant
            stack.enter_context(mock.patch(f"lerobot.datasets.{module}.HF_LEROBOT_HUB_CACHE", folder / "lerobot"))
        stack.enter_context(mock.patch.object(_http, "time", SimpleNamespace(sleep=lambda seconds: None)))
        stack.callback(set_client_factory, _http._GLOBAL_CLIENT_FACTORY)  # also closes the connections
        set_client_factory(client)
        yield
