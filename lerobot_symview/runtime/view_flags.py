"""Views on a command line: `--views='[reproj, {name: persp, plane_height: 0.025}]'`, and dotted flags for our own two.

Importing this module lets draccus, LeRobot's command-line parser, read and write `ViewSpec`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import draccus
from draccus.utils import DecodingError

from lerobot_symview.views import View, ViewSpec, make_views


def _decode(raw: Any, path: Sequence[str]) -> ViewSpec:
    try:
        return ViewSpec.parse(raw)
    except ValueError as error:
        raise DecodingError(path, str(error)) from None


draccus.decode.register(ViewSpec, _decode)
draccus.encode.register(ViewSpec, lambda spec, *_: spec.plain())


def views_from_flags(specs: Iterable[ViewSpec], size: int | None, dotted: Mapping[str, View]) -> dict[str, View]:
    """Return the views that a command's flags ask for, by name.

    Args:
        specs: the views, each with options of its own.
        size: rows and columns of those that do not say theirs.
        dotted: options by dotted flags, such as `--reproj.clip=none`, for the views that have them.

    Raises:
        ValueError: if there is no view, an unknown one, or one with an unknown or invalid option.
    """
    return make_views(_merged(spec, size, dotted.get(spec.name)) for spec in map(ViewSpec.parse, specs))


def _merged(spec: ViewSpec, size: int | None, dotted: View | None) -> ViewSpec:
    """Return the specification with every option said: the list entry's, else `size`, else the dotted flags'."""
    shared: dict[str, Any] = {} if size is None else {"size": size}
    return ViewSpec(spec.name, (asdict(dotted) if dotted is not None else {}) | shared | spec.options)
