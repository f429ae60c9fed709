"""Networks from image channels to a scaled action, and the registry `--policy.encoder` chooses from."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from lerobot_policy_symview.escnn_import import enn, gspaces
from lerobot_policy_symview.symmetry import ThetaRepresentation


def stage_widths(crop_size: int, width: int) -> list[int]:
    """Widths of the convolutions that each halve the image, down to 8 px; the paper's for 128 px, one fewer for 64."""
    return {128: [width // 8, width // 4, width // 2, width], 64: [width // 4, width // 2, width]}[crop_size]


class EquivariantEncoder(nn.Module):
    """D4-equivariant convolutions from trivial channels to an action (paper A.4; 1,112,680 parameters at width 64).

    Args:
        channels: input channels, each a scalar field on the table.
        crop_size: rows and columns of the input, one of the configuration's `CROP_SIZES`.
        width: regular fields of the widest but one layer (the paper's n).
        action_kinds: declaration of the action's entries, see `symmetry`.
        theta_representation: representation of yaw increments; `trivial` is the paper's text, `sign` is right.
        initialize: draw escnn's He initialisation, which takes seconds; not needed before weights are loaded.
    """

    def __init__(
        self,
        channels: int,
        crop_size: int,
        width: int,
        action_kinds: Sequence[str],
        theta_representation: ThetaRepresentation,
        initialize: bool,
    ):
        super().__init__()
        space = gspaces.flipRot2dOnR2(4)
        fields = {"vector": space.irrep(1, 1), "sign": space.irrep(1, 0), "trivial": space.trivial_repr}
        self.in_type = enn.FieldType(space, channels * [space.trivial_repr])
        layers: list[enn.EquivariantModule] = []
        current = self.in_type

        def convolution(fields: int, padding: int, pool: bool) -> None:
            nonlocal current
            out_type = enn.FieldType(space, fields * [space.regular_repr])
            layers.append(enn.R2Conv(current, out_type, 3, padding=padding, initialize=initialize))
            layers.append(enn.ReLU(out_type))
            if pool:
                layers.append(enn.PointwiseMaxPool(out_type, 2))
            current = out_type

        for fields_out in stage_widths(crop_size, width):
            convolution(fields_out, padding=1, pool=True)
        convolution(2 * width, padding=1, pool=False)
        convolution(width, padding=0, pool=True)
        convolution(width, padding=0, pool=False)
        self.encoder = enn.SequentialModule(*layers)

        order, types = _head_fields(action_kinds, theta_representation)
        out_type = enn.FieldType(space, [fields[name] for name in types])
        self.head = enn.R2Conv(current, out_type, 1, initialize=initialize)
        self.register_buffer("order", torch.tensor(order), persistent=False)
        for buffer in self.buffers():  # escnn's bases are strided views, which safetensors cannot write
            buffer.data = buffer.contiguous()

    def forward(self, images: Tensor) -> Tensor:
        """Map images (B, C, crop, crop) to scaled actions (B, A)."""
        features = self.head(self.encoder(enn.GeometricTensor(images, self.in_type))).tensor
        return features.flatten(1)[:, self.order]


def _head_fields(kinds: Sequence[str], theta: ThetaRepresentation) -> tuple[list[int], list[str]]:
    """Return which output channel each action entry is, and the field types that yield those channels."""
    types, channel_of, channels = [], {}, 0
    if "x" in kinds:
        types.append("vector")
        channel_of.update({kinds.index("x"): 0, kinds.index("y"): 1})
        channels = 2
    for entry, kind in enumerate(kinds):
        if kind not in ("x", "y"):
            types.append("sign" if kind == "yaw" and theta == "sign" else "trivial")
            channel_of[entry] = channels
            channels += 1
    return [channel_of[entry] for entry in range(len(kinds))], types


class PlainEncoder(nn.Module):
    """The same layout without symmetry; 16, 32, 64, 128, 128, 256, 256 channels, 1.13 M weights at the paper's size."""

    def __init__(
        self,
        channels: int,
        crop_size: int,
        width: int,
        action_kinds: Sequence[str],
        theta_representation: ThetaRepresentation,
        initialize: bool,
    ):
        super().__init__()
        layers: list[nn.Module] = []
        current = channels

        def convolution(out: int, padding: int, pool: bool) -> None:
            nonlocal current
            layers.extend([nn.Conv2d(current, out, 3, padding=padding), nn.ReLU()])
            if initialize:
                nn.init.xavier_normal_(layers[-2].weight)  # type: ignore[arg-type]
            if pool:
                layers.append(nn.MaxPool2d(2))
            current = out

        for out in stage_widths(crop_size, width):
            convolution(2 * out, padding=1, pool=True)
        convolution(2 * width, padding=1, pool=False)
        convolution(4 * width, padding=0, pool=True)
        convolution(4 * width, padding=0, pool=False)
        self.encoder = nn.Sequential(*layers, nn.Flatten(), nn.Linear(current, len(action_kinds)))

    def forward(self, images: Tensor) -> Tensor:
        """Map images (B, C, crop, crop) to scaled actions (B, A)."""
        actions: Tensor = self.encoder(images)
        return actions


ENCODERS: dict[str, Callable[..., nn.Module]] = {"equivariant": EquivariantEncoder, "plain": PlainEncoder}
