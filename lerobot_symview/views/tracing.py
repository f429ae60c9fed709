"""Whether a network runs only to record its operations."""

import torch


def is_exporting() -> bool:
    """Whether torch.export, torch.onnx.export or torch.jit.trace is recording operations."""
    return torch.compiler.is_exporting() or torch.jit.is_tracing()  # type: ignore[attr-defined,no-untyped-call]
