"""View flags: `--views='[reproj, {name: persp, plane_height: 0.025}]'`, and dotted flags of the built-in views.

Importing this module registers `ViewSpec` with draccus, LeRobot's command-line parser.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import draccus
from draccus.utils import DecodingError

from lerobot_symview.errors import OptionError
from lerobot_symview.views import View, ViewSpec, make_views
from lerobot_symview.views.base import CameraNames, checked_cameras


def _decode(raw: Any, path: Sequence[str]) -> ViewSpec:
    try:
        return ViewSpec.parse(raw)
    except OptionError as error:
        raise DecodingError(path, str(error)) from None


draccus.decode.register(ViewSpec, _decode)
draccus.encode.register(ViewSpec, lambda spec, *_: spec.plain())
draccus.decode.register(CameraNames, lambda raw, *_: checked_cameras(raw))
draccus.encode.register(CameraNames, lambda names, *_: list(names))


def views_from_flags(specs: Iterable[ViewSpec], size: int | None, dotted: Mapping[str, View]) -> dict[str, View]:
    """Return the views given by a command's flags, by name.

    Args:
        specs: entries of `--views`, with their own options.
        size: rows and columns of the views whose entries give no size.
        dotted: view name -> view with the options of dotted flags, such as `--reproj.clip=none`.

    Raises:
        OptionError: if there is no view, or a view or an option is unknown or invalid.
    """
    return make_views(_merged(spec, size, dotted.get(spec.name)) for spec in map(ViewSpec.parse, specs))


def _merged(spec: ViewSpec, size: int | None, dotted: View | None) -> ViewSpec:
    """Merge options: those of the list entry override `size`, which overrides the dotted flags."""
    shared: dict[str, Any] = {} if size is None else {"size": size}
    return ViewSpec(spec.name, (asdict(dotted) if dotted is not None else {}) | shared | spec.options)
