"""Group convolution of D4 on the processor, through the Fourier transform over the group.

A dense filter has 64 numbers for every pair of fields and steerable function, of which 8 are free. On the irreps of D4
a convolution is block-diagonal and takes 8 times fewer multiplications; the transform costs less by far. It runs in
blocks of pixels that fit in the cache. The backward pass expands the input again rather than keep what is 6 times its
size.
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

FUNCTIONS = 6
LINES, VECTORS = {ORDER: 6, 1: 4}, {ORDER: 12, 1: 1}  # per line of a field and of a scalar; per square
BLOCK_BYTES = 2**20  # of expanded pixels; a core's share of the cache
FEW_PIXELS = 128  # products of fewer are slow


class Block(NamedTuple):
    """Rows of some images."""

    first: int
    images: int
    row: int
    rows: int


class Plan:
    """Sizes of a layer, and how its output is cut into blocks.

    Args:
        images: (B, channels, H, W).
        elements: 8 if channels are fields, 1 if they are scalars.
        outputs: fields.
        padding: of the images.
        pool: whether 2 x 2 pixels become one.
    """

    def __init__(self, images: Tensor, elements: int, outputs: int, padding: int, pool: bool):
        self.batch, channels, height, width = images.shape
        inputs, self.elements = channels // elements, elements
        self.outputs, self.padding, self.pool, self.dtype = outputs, padding, pool, images.dtype
        self.lines, self.vectors = inputs * LINES[self.elements], inputs * VECTORS[self.elements]
        self.height, self.width = height + 2 * padding - 2, width + 2 * padding - 2
        threads, step = torch.get_num_threads(), 2 if pool else 1
        pixels = BLOCK_BYTES // ((4 * self.lines + 2 * self.vectors) * images.element_size())
        pixels = min(max(pixels, FEW_PIXELS), PIXELS)
        rows = min(pixels // self.width, PLANE // (self.width + 2) - 2, self.height)
        if self.batch < threads:  # they share an image
            rows = min(rows, max(-(-self.height // threads), FEW_PIXELS // (2 * self.width)))
        self.rows = max(rows // step, 1) * step
        padded = (self.rows + 2) * (self.width + 2)
        self.fits = self.rows * self.width <= PIXELS and padded <= PLANE  # or even the narrowest block is too large
        self.count = 1
        if self.rows == self.height and self.fits:
            self.count = max(1, min(pixels // (self.rows * self.width), PLANE // padded, -(-self.batch // threads)))

    def blocks(self) -> list[list[Block]]:
        """Return the blocks of every group of images."""
        rows = [(row, min(self.rows, self.height - row)) for row in range(0, self.height, self.rows)]
        starts = range(0, self.batch, self.count)
        return [[Block(first, min(self.count, self.batch - first), *span) for span in rows] for first in starts]

    def pixels(self, block: Block) -> int:
        """Return how many pixels a block has."""
        return block.images * block.rows * self.width


class Buffers:
    """What one thread works in: flat arrays for the kernels, and the same memory as matrices for torch."""

    def __init__(self, plan: Plan):
        def make(*shape: int) -> Tensor:
            return torch.empty(shape, dtype=plan.dtype)

        lines, square = make(plan.lines, 4, STRIDE), make(plan.vectors, 2, STRIDE)
        out_lines, out_square = make(plan.outputs, 4, STRIDE), make(2 * plan.outputs, 2, STRIDE)
        self._whole = [part.transpose(0, 1) for part in (lines, square, out_lines, out_square)]
        self._parts: dict[int, list[Tensor]] = {}
        self.expanded = lines.view(-1).numpy(), square.view(-1).numpy()
        self.products = out_lines.view(-1).numpy(), out_square.view(-1).numpy()
        self.planes, self.taps = make(ORDER * PLANE).numpy(), make(9 * PLANE).numpy()
        self.gradients = (
            torch.zeros(4, plan.outputs, plan.lines, dtype=plan.dtype),
            torch.zeros(2, 2 * plan.outputs, plan.vectors, dtype=plan.dtype),
            torch.zeros(plan.outputs, dtype=plan.dtype),
        )

    def matrices(self, pixels: int) -> list[Tensor]:
        """Return inputs and products, (4 or 2, rows, pixels) each: lines, vectors, lines, vectors."""
        if pixels not in self._parts:
            self._parts[pixels] = [part[..., :pixels] for part in self._whole]
        return self._parts[pixels]


class _Convolution(torch.autograd.Function):
    """Images (B, 8, fields, H, W), weights per irrep and a bias to images (B, 8, outputs, H', W').

    Weights are (4, outputs, lines) and (2 outputs, vectors), biases (outputs,). Images of scalars get no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, images: Tensor, lines: Tensor, square: Tensor, bias: Tensor, plan: Plan, values: tuple[Any, ...]
    ) -> Tensor:
        step = 2 if plan.pool else 1
        out = images.new_empty(plan.batch, ORDER, plan.outputs, plan.height // step, plan.width // step)
        chosen = torch.empty(out.shape if plan.pool else (0,) * out.ndim, dtype=torch.uint8)
        square = square.expand(2, -1, -1)
        source, biases, target, which = images.numpy(), bias.numpy(), out.numpy(), chosen.numpy()

        def work(buffers: Buffers, block: Block) -> None:
            expand(source, *block, plan.padding, values, buffers.planes, *buffers.expanded)
            line_inputs, square_inputs, line_outputs, square_outputs = buffers.matrices(plan.pixels(block))
            torch.bmm(lines, line_inputs, out=line_outputs)
            torch.bmm(square, square_inputs, out=square_outputs)
            collect(*buffers.products, biases, *block, plan.width, buffers.planes, plan.pool, target, which)

        in_threads(work, list(chain.from_iterable(plan.blocks())), lambda: Buffers(plan))
        ctx.save_for_backward(images, lines, square, chosen)
        ctx.plan, ctx.values = plan, values
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, lines, square, chosen = ctx.saved_tensors
        plan, values = ctx.plan, ctx.values
        image_gradient = torch.zeros_like(images) if ctx.needs_input_grad[0] else None
        source, given, which = images.numpy(), gradient.contiguous().numpy(), chosen.numpy()
        lines, square = lines.transpose(1, 2), square.transpose(1, 2)

        def work(buffers: Buffers, blocks: list[Block]) -> None:
            for block in blocks:
                spread(given, which, plan.pool, *block, plan.width, buffers.planes, *buffers.products)
                expand(source, *block, plan.padding, values, buffers.planes, *buffers.expanded)
                line_inputs, square_inputs, line_outputs, square_outputs = buffers.matrices(plan.pixels(block))
                line_gradient, square_gradient, bias_gradient = buffers.gradients
                line_gradient.baddbmm_(line_outputs, line_inputs.transpose(1, 2))
                square_gradient.baddbmm_(square_outputs, square_inputs.transpose(1, 2))
                bias_gradient += line_outputs[0].sum(1)  # the first line is the sum over the group
                if image_gradient is not None:
                    torch.bmm(lines, line_outputs, out=line_inputs)
                    torch.bmm(square, square_outputs, out=square_inputs)
                    target = image_gradient.numpy()
                    gather(*buffers.expanded, *block, plan.padding, values, buffers.taps, buffers.planes, target)

        parts = in_threads(work, plan.blocks(), lambda: Buffers(plan))
        line_gradient, square_gradient, bias_gradient = (
            torch.stack(found).sum(0) for found in zip(*(part.gradients for part in parts), strict=True)
        )
        return image_gradient, line_gradient, square_gradient.sum(0), bias_gradient, None, None


@lru_cache
def irreps_from_functions(elements: int, dtype: torch.dtype) -> NDArray[np.floating]:
    """Return the matrix from a filter's free weights (8 or 1, 6) to weights of lines (rows, 4) and vectors (rows, 2).

    A filter is the sum of all that `expand` makes of its input, each with a weight. Those are orthogonal, hence the
    weights are scalar products with what it makes of every function in every element.
    """
    functions = steerable_basis(make_group("D4"))[0]
    inputs = elements * FUNCTIONS
    images = np.zeros((1, elements, inputs, 3, 3), str(dtype).removeprefix("torch."))
    for i in range(inputs):
        images[0, i // FUNCTIONS, i] = functions[i % FUNCTIONS].reshape(3, 3)
    buffers = Buffers(Plan(torch.from_numpy(images).flatten(1, 2), elements, 1, 0, False))
    expand(images, 0, 1, 0, 1, 0, _values(functions, images.dtype), buffers.planes, *buffers.expanded)
    lines, square = (part.reshape(inputs, -1, STRIDE)[..., 0].round() for part in buffers.expanded)  # whole numbers
    table = np.concatenate([lines, square], axis=1)
    return table / np.maximum((table**2).sum(0), 1)


def _values(functions: NDArray[np.floating], dtype: np.dtype) -> tuple[Any, ...]:
    """Return the numbers that the functions (6, 9) consist of, as `expand` takes them."""
    centre, ring, x, cross, _, saddle = functions
    return tuple(np.array([centre[4], ring[1], ring[0], x[7], x[8], cross[1], saddle[8]], dtype))


class FourierConv2d(FieldConv2d):
    """`FieldConv2d`, computed on the irreps of D4 where that is possible: for steerable filters, on the processor.

    Inputs are fields, or scalars that need no gradient; the rest is left to `FieldConv2d`.
    """

    def __init__(
        self, group: PlanarGroup, inputs: int | NDArray[np.float64], fields: int, padding: int, full: bool = False
    ):
        super().__init__(group, inputs, fields, padding, full)
        is_scalar = not isinstance(inputs, int) and bool(np.all(inputs.round(DECIMALS) == np.eye(inputs.shape[-1])))
        is_possible = group == make_group("D4") and not full and (self.has_field_inputs or is_scalar)
        self._elements = (ORDER if self.has_field_inputs else 1) if is_possible else 0

    def forward(self, images: Tensor, pool: bool = False) -> Tensor:
        """Map (B, channels, H, W) to (B, G fields, H', W'); `pool` appends the maximum of 2 x 2 pixels and ReLU."""
        plan = self._plan(images, pool)
        if plan is None:
            return super().forward(images, pool)
        inputs = images.contiguous().view(len(images), plan.elements, -1, *images.shape[2:])
        values = _values(self.basis[0].numpy(), self.basis.numpy().dtype)
        out: Tensor = _Convolution.apply(  # type: ignore[no-untyped-call]
            inputs, *self.kept(self._transform), self.bias, plan, values
        )
        return out.flatten(1, 2)

    def _transform(self) -> tuple[Tensor, ...]:
        """Return weights of lines (4, fields, rows) and of vectors (2 fields, rows)."""
        table = torch.from_numpy(irreps_from_functions(self._elements, self.weight.dtype))
        weight = self.weight.view(self.fields, self._elements, -1, FUNCTIONS).transpose(1, 2)
        weights, rows = weight.flatten(2) @ table, LINES[self._elements]
        lines = weights[..., : 4 * rows].reshape(self.fields, -1, 4).permute(2, 0, 1)
        square = weights[..., 4 * rows :].reshape(self.fields, -1, 2).transpose(1, 2).flatten(0, 1)
        return lines.contiguous(), square.contiguous()

    def _plan(self, images: Tensor, pool: bool) -> Plan | None:
        """Return how to compute the convolution, or None if it is dense."""
        is_usual = images.device.type == self.weight.device.type == "cpu" and images.dtype == self.weight.dtype
        is_usual = is_usual and images.dtype in (torch.float32, torch.float64) and not torch.compiler.is_compiling()
        if not is_usual or not self._elements or torch.is_autocast_enabled("cpu") or images.ndim != 4:
            return None
        if self._elements == 1 and images.requires_grad and torch.is_grad_enabled():
            return None
        height, width = (side + 2 * self.padding - 2 for side in images.shape[2:])
        if min(height, width, len(images)) < 1 or (pool and (height % 2 or width % 2)):
            return None
        plan = Plan(images, self._elements, self.fields, self.padding, pool)
        return plan if plan.fits else None
