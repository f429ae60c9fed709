"""Imports escnn on machines where its optional dependency `lie_learn` does not build.

escnn 1.0.11 imports `lie_learn` for rotations in three dimensions, of which planar groups use nothing; on Python 3.12
that package has no working build. Where it is missing, a stand-in is registered that fails when used.
"""

from __future__ import annotations

import importlib.util
import sys
import types
import warnings


def _stand_in_for_lie_learn() -> None:
    if importlib.util.find_spec("lie_learn") is not None:
        return

    def unavailable(*args: object, **kwargs: object) -> None:
        raise ImportError("representations of SO(3) need lie_learn, which is not installed")

    name = "lie_learn"
    for part in ("", ".representations", ".representations.SO3", ".representations.SO3.wigner_d"):
        module = types.ModuleType(name + part)
        module.__path__ = []
        sys.modules[name + part] = module
    leaf = sys.modules["lie_learn.representations.SO3.wigner_d"]
    leaf.__dict__.update(wigner_d_matrix=unavailable, wigner_D_matrix=unavailable)


if importlib.util.find_spec("escnn") is None:
    raise ModuleNotFoundError("escnn is not installed; docs/install.md says how to install it", name="escnn")
_stand_in_for_lie_learn()
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # py3nj is missing for the same reason, and as little used
    from escnn import gspaces
    from escnn import nn as enn

__all__ = ["enn", "gspaces"]
