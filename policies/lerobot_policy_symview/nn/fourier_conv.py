"""Group convolution of D4 on a CPU, by the Fourier transform over the group.

A dense filter has 64 numbers for every pair of fields and steerable function, of which 8 are free. In the basis of the
irreps of D4 a convolution is block-diagonal and takes 8 times fewer multiplications; the transform costs much less than
that. The computation runs in blocks of pixels that fit in the cache. The backward pass expands the input again, because
storing the expanded input would take 6 times its memory.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from lerobot_policy_symview.nn.fourier_kernels import ORDER, PIXELS, PLANE, STRIDE, collect, expand, gather, spread
from lerobot_policy_symview.nn.layers import FieldConv2d, steerable_basis
from lerobot_policy_symview.nn.threads import in_threads
from lerobot_policy_symview.symmetry.groups import DECIMALS, PlanarGroup, make_group
from lerobot_symview.views.tracing import is_exporting

FUNCTIONS = 6  # of the steerable basis
DIM1_ROWS, DIM2_ROWS = {ORDER: 6, 1: 4}, {ORDER: 12, 1: 1}  # per irrep, of a regular field and of a scalar
BLOCK_BYTES = 2**20  # of expanded pixels of a block; a core's share of the cache
FEW_PIXELS = 128  # matrix products of fewer columns are slow


class Block(NamedTuple):
    """The rows `row` to `row + rows` of the images `first` to `first + images`."""

    first: int
    images: int
    row: int
    rows: int


class Plan:
    """Sizes of a layer, and the partition of its output into blocks.

    Args:
        images: (B, channels, H, W).
        elements: 8 if the channels are regular fields, 1 if they are scalars.
        outputs: number of output fields.
        padding: of the images, pixels.
        pool: whether 2 x 2 max pooling follows.
    """

    def __init__(self, images: Tensor, elements: int, outputs: int, padding: int, pool: bool):
        self.batch, channels, height, width = images.shape
        inputs, self.elements = channels // elements, elements
        self.outputs, self.padding, self.pool, self.dtype = outputs, padding, pool, images.dtype
        self.dim1_rows, self.dim2_rows = inputs * DIM1_ROWS[self.elements], inputs * DIM2_ROWS[self.elements]
        self.height, self.width = height + 2 * padding - 2, width + 2 * padding - 2
        threads, step = torch.get_num_threads(), 2 if pool else 1
        pixels = BLOCK_BYTES // ((4 * self.dim1_rows + 2 * self.dim2_rows) * images.element_size())
        pixels = min(max(pixels, FEW_PIXELS), PIXELS)
        rows = min(pixels // self.width, PLANE // (self.width + 2) - 2, self.height)
        if self.batch < threads:  # threads share an image
            rows = min(rows, max(-(-self.height // threads), FEW_PIXELS // (2 * self.width)))
        self.rows = max(rows // step, 1) * step
        padded = (self.rows + 2) * (self.width + 2)
        self.fits = self.rows * self.width <= PIXELS and padded <= PLANE  # False if even a single row is too large
        self.count = 1
        if self.rows == self.height and self.fits:
            self.count = max(1, min(pixels // (self.rows * self.width), PLANE // padded, -(-self.batch // threads)))

    def blocks(self) -> list[list[Block]]:
        """Return, for every batch of `count` images, its blocks."""
        rows = [(row, min(self.rows, self.height - row)) for row in range(0, self.height, self.rows)]
        starts = range(0, self.batch, self.count)
        return [[Block(first, min(self.count, self.batch - first), *span) for span in rows] for first in starts]

    def pixels(self, block: Block) -> int:
        """Return the number of pixels of a block."""
        return block.images * block.rows * self.width


class Buffers:
    """Work space of one thread: flat arrays for the kernels, and the same memory as matrices for torch."""

    def __init__(self, plan: Plan):
        def make(*shape: int) -> Tensor:
            return torch.empty(shape, dtype=plan.dtype)

        dim1, dim2 = make(plan.dim1_rows, 4, STRIDE), make(plan.dim2_rows, 2, STRIDE)
        out_dim1, out_dim2 = make(plan.outputs, 4, STRIDE), make(2 * plan.outputs, 2, STRIDE)
        self._whole = [part.transpose(0, 1) for part in (dim1, dim2, out_dim1, out_dim2)]
        self._parts: dict[int, list[Tensor]] = {}
        self.expanded = dim1.view(-1).numpy(), dim2.view(-1).numpy()
        self.products = out_dim1.view(-1).numpy(), out_dim2.view(-1).numpy()
        self.planes, self.taps = make(ORDER * PLANE).numpy(), make(9 * PLANE).numpy()
        self.gradients = (
            torch.zeros(4, plan.outputs, plan.dim1_rows, dtype=plan.dtype),
            torch.zeros(2, 2 * plan.outputs, plan.dim2_rows, dtype=plan.dtype),
            torch.zeros(plan.outputs, dtype=plan.dtype),
        )

    def matrices(self, pixels: int) -> list[Tensor]:
        """Return the matrices of dim1 and dim2 inputs and of dim1 and dim2 products, (4 or 2, rows, pixels) each."""
        if pixels not in self._parts:
            self._parts[pixels] = [part[..., :pixels] for part in self._whole]
        return self._parts[pixels]


class _Convolution(torch.autograd.Function):
    """Map images (B, 8, fields, H, W) to images (B, 8, outputs, H', W') with weights per irrep and a bias.

    `dim1` (4, outputs, rows) has the weights of the irreps of dimension 1, `dim2` (2 outputs, rows) those of the irrep
    of dimension 2, `bias` is (outputs,). Images of scalars get no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, images: Tensor, dim1: Tensor, dim2: Tensor, bias: Tensor, plan: Plan, values: tuple[Any, ...]
    ) -> Tensor:
        step = 2 if plan.pool else 1
        out = images.new_empty(plan.batch, ORDER, plan.outputs, plan.height // step, plan.width // step)
        chosen = torch.empty(out.shape if plan.pool else (0,) * out.ndim, dtype=torch.uint8)
        dim2 = dim2.expand(2, -1, -1)
        source, biases, target, which = images.numpy(), bias.numpy(), out.numpy(), chosen.numpy()

        def work(buffers: Buffers, block: Block) -> None:
            expand(source, *block, plan.padding, values, buffers.planes, *buffers.expanded)
            dim1_inputs, dim2_inputs, dim1_outputs, dim2_outputs = buffers.matrices(plan.pixels(block))
            torch.bmm(dim1, dim1_inputs, out=dim1_outputs)
            torch.bmm(dim2, dim2_inputs, out=dim2_outputs)
            collect(*buffers.products, biases, *block, plan.width, buffers.planes, plan.pool, target, which)

        in_threads(work, list(chain.from_iterable(plan.blocks())), lambda: Buffers(plan))
        ctx.save_for_backward(images, dim1, dim2, chosen)
        ctx.plan, ctx.values = plan, values
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, dim1, dim2, chosen = ctx.saved_tensors
        plan, values = ctx.plan, ctx.values
        image_gradient = torch.zeros_like(images) if ctx.needs_input_grad[0] else None
        source, given, which = images.numpy(), gradient.contiguous().numpy(), chosen.numpy()
        dim1, dim2 = dim1.transpose(1, 2), dim2.transpose(1, 2)

        def work(buffers: Buffers, blocks: list[Block]) -> None:
            for block in blocks:
                spread(given, which, plan.pool, *block, plan.width, buffers.planes, *buffers.products)
                expand(source, *block, plan.padding, values, buffers.planes, *buffers.expanded)
                dim1_inputs, dim2_inputs, dim1_outputs, dim2_outputs = buffers.matrices(plan.pixels(block))
                dim1_gradient, dim2_gradient, bias_gradient = buffers.gradients
                dim1_gradient.baddbmm_(dim1_outputs, dim1_inputs.transpose(1, 2))
                dim2_gradient.baddbmm_(dim2_outputs, dim2_inputs.transpose(1, 2))
                bias_gradient += dim1_outputs[0].sum(1)  # the trivial irrep is the sum over the group
                if image_gradient is not None:
                    torch.bmm(dim1, dim1_outputs, out=dim1_inputs)
                    torch.bmm(dim2, dim2_outputs, out=dim2_inputs)
                    target = image_gradient.numpy()
                    gather(*buffers.expanded, *block, plan.padding, values, buffers.taps, buffers.planes, target)

        parts = in_threads(work, plan.blocks(), lambda: Buffers(plan))
        dim1_gradient, dim2_gradient, bias_gradient = (
            torch.stack(gradients).sum(0) for gradients in zip(*(part.gradients for part in parts), strict=True)
        )
        return image_gradient, dim1_gradient, dim2_gradient.sum(0), bias_gradient, None, None


@lru_cache
def irreps_from_functions(elements: int, dtype: torch.dtype) -> NDArray[np.floating]:
    """Return the matrix from a filter's free weights (8 or 1, 6) to weights per irrep, (rows, 4) and (rows, 2).

    A filter's output is a weighted sum of the outputs of `expand`. These are orthogonal, so that the weights are scalar
    products with the outputs for every steerable function and group element.
    """
    functions = steerable_basis(make_group("D4"))[0]
    inputs = elements * FUNCTIONS
    images = np.zeros((1, elements, inputs, 3, 3), str(dtype).removeprefix("torch."))
    for i in range(inputs):
        images[0, i // FUNCTIONS, i] = functions[i % FUNCTIONS].reshape(3, 3)
    buffers = Buffers(Plan(torch.from_numpy(images).flatten(1, 2), elements, 1, 0, False))
    expand(images, 0, 1, 0, 1, 0, _values(functions, images.dtype), buffers.planes, *buffers.expanded)
    dim1, dim2 = (part.reshape(inputs, -1, STRIDE)[..., 0].round() for part in buffers.expanded)  # integers
    table = np.concatenate([dim1, dim2], axis=1)
    return table / np.maximum((table**2).sum(0), 1)


def _values(functions: NDArray[np.floating], dtype: np.dtype) -> tuple[Any, ...]:
    """Return the distinct values of the steerable functions (6, 9), as `expand` takes them."""
    centre, ring, x, cross, _, saddle = functions
    return tuple(np.array([centre[4], ring[1], ring[0], x[7], x[8], cross[1], saddle[8]], dtype))


class FourierConv2d(FieldConv2d):
    """`FieldConv2d`, computed in the basis of D4's irreps where possible: for steerable filters, on a CPU.

    Inputs must be regular fields, or scalars that need no gradient; `FieldConv2d` computes all other cases.
    """

    def __init__(
        self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int, padding: int, full: bool = False
    ):
        super().__init__(group, inputs, fields, padding, full)
        is_scalar = not isinstance(inputs, int) and bool(np.all(inputs.round(DECIMALS) == np.eye(inputs.shape[-1])))
        is_possible = group == make_group("D4") and not full and (self.has_field_inputs or is_scalar)
        self._elements = (ORDER if self.has_field_inputs else 1) if is_possible else 0

    def forward(self, images: Tensor, pool: bool = False) -> Tensor:
        """Map (B, channels, H, W) to (B, G fields, H', W'); `pool` appends 2 x 2 max pooling and ReLU."""
        plan = self.plan(images, pool)
        if plan is None:
            return super().forward(images, pool)
        inputs = images.contiguous().view(len(images), plan.elements, -1, *images.shape[2:])
        values = _values(self.basis[0].numpy(), self.basis.numpy().dtype)
        out: Tensor = _Convolution.apply(  # type: ignore[no-untyped-call]
            inputs, *self.cached(self._transform), self.bias, plan, values
        )
        return out.flatten(1, 2)

    def _transform(self) -> tuple[Tensor, ...]:
        """Return the weights of the irreps of dimension 1 (4, fields, rows) and of dimension 2 (2 fields, rows)."""
        table = torch.from_numpy(irreps_from_functions(self._elements, self.weight.dtype))
        weight = self.weight.view(self.fields, self._elements, -1, FUNCTIONS).transpose(1, 2)
        weights, rows = weight.flatten(2) @ table, DIM1_ROWS[self._elements]
        dim1 = weights[..., : 4 * rows].reshape(self.fields, -1, 4).permute(2, 0, 1)
        dim2 = weights[..., 4 * rows :].reshape(self.fields, -1, 2).transpose(1, 2).flatten(0, 1)
        return dim1.contiguous(), dim2.contiguous()

    def plan(self, images: Tensor, pool: bool) -> Plan | None:
        """Return the plan of the computation in irreps, or None where the layer falls back to the dense convolution."""
        is_cpu = images.device.type == self.weight.device.type == "cpu" and images.dtype == self.weight.dtype
        is_eager = not (torch.compiler.is_compiling() or is_exporting() or torch.is_autocast_enabled("cpu"))
        is_float = images.dtype in (torch.float32, torch.float64)
        if not (is_cpu and is_eager and is_float) or not self._elements or images.ndim != 4:
            return None
        if self._elements == 1 and images.requires_grad and torch.is_grad_enabled():
            return None
        height, width = (side + 2 * self.padding - 2 for side in images.shape[2:])
        if min(height, width, len(images)) < 1 or (pool and (height % 2 or width % 2)):
            return None
        plan = Plan(images, self._elements, self.fields, self.padding, pool)
        return plan if plan.fits else None
