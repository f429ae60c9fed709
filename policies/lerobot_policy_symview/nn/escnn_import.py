"""Imports escnn, also where its dependency `lie_learn` does not build.

escnn 1.0.11 imports `lie_learn` for rotations in three dimensions, which planar groups do not use; on Python 3.12 that
package has no working build. Where it is missing, this module registers a stub that raises an ImportError when called.
"""

from __future__ import annotations

import importlib.util
import sys
import types
import warnings


def _register_lie_learn_stub() -> None:
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
_register_lie_learn_stub()
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # about py3nj, which is missing and unused for the same reasons
    from escnn import gspaces
    from escnn import nn as enn

__all__ = ["enn", "gspaces"]
